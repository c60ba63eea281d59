"""Rollouts: one scan over frames. Everything here is pure, for `jax.jit`, `jax.vmap` and `jax.grad`."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from eslr_jax.config import SimConfig
from eslr_jax.networks.network import Network, check_network
from eslr_jax.simulation.frame import FrameInput, frame_inputs, frame_problem, part_of_frame
from eslr_jax.simulation.scene import Integrator, build_scene, worn_material
from eslr_jax.simulation.stepper import FrameReport, Stepper, make_stepper, past_state
from eslr_jax.solver.solve import SOLUTION
from eslr_jax.terms import Contact, Ground, Term, scene_terms
from eslr_jax.types import BodyMotion, ClothState, Garment, Material, Scene, Trajectory


def rollout(
    params: Network | None,
    garment: Garment,
    poses: BodyMotion,
    *,
    config: SimConfig | None = None,
    material: Material | None = None,
    terms: tuple[Term, ...] | None = None,
    integrator: Integrator = "euler",
    substeps: int = 1,
) -> Trajectory:
    """Simulate a garment on a moving body.

    A pure function: it compiles under `jax.jit` (`config` is static), maps under `jax.vmap` and differentiates
    under `jax.grad`. It checks shapes alone and raises nothing for what happens in a frame: see the trajectory's
    `status`, or `simulate`, which checks values, shows progress and raises.

    Args:
        params: A network, of `load_model`; None without one.
        garment: Of `load_garment` or `prepare_garment`.
        poses: Of `pose_body`.
        config: Iterations and tolerance; the solver alone by default.
        material: Fabric; by default the garment's own, of its file, or else cotton.
        terms: What is modelled, of `plan_scene`, which looks at values and leaves out what they don't need. By
            default there is no ground, and layers of cloth pass through each other.
        integrator: How time is stepped; static.
        substeps: Number of equal parts in which a frame is simulated; static.

    Returns:
        The trajectory; frame 0 is the garment skinned to the first pose and pushed out of the body.

    Raises:
        ConfigError: `params` is no network.
        CheckpointError: Its weights are for another architecture.
    """
    config = config or SimConfig()
    check_network(params)
    if terms is None:
        terms = scene_terms(without=(Ground, Contact))
    worn = garment, poses, worn_material(garment, material)
    scene = build_scene(*worn, terms, integrator=integrator, substeps=substeps)
    return rollout_scene(params, scene, config)


@partial(jax.jit, static_argnames="config")
def rollout_scene(
    params: Network | None, scene: Scene, config: SimConfig, iterations: Int[Array, ""] | int | None = None
) -> Trajectory:
    """Simulate every frame of a scene; pure.

    Args:
        params: A network, or None.
        scene: Of `build_scene` or `prepare_scene`.
        config: Iterations and tolerance; static.
        iterations: Bound of iterations in place of the configuration's, see `make_stepper`.
    """
    stepper = make_stepper(params, config, iterations)
    end, frames = scan_frames(stepper, scene, scene.initial_state, frame_inputs(scene))
    return join_frames(scene.initial_state, frames, end)


class Frames(NamedTuple):
    """What a scan leaves behind, frame by frame, along a leading axis."""

    positions: Float[Array, "frames vertices 3"]  # [m]
    velocities: Float[Array, "frames vertices 3"]  # [m/s]
    friction_loads: Float[Array, "frames vertices"]  # [N]
    reports: FrameReport


def scan_frames(
    stepper: Stepper, scene: Scene, state: ClothState, inputs: FrameInput
) -> tuple[ClothState, Frames]:
    """Simulate the frames of `inputs` from `state`.

    Args:
        stepper: Of `make_stepper`.
        scene: Its constant parts.
        state: Where to begin.
        inputs: Motion of body and pins, along a leading axis of frames. Without body and pins it is empty, and
            `scene.num_frames - 1` frames are simulated.

    Returns:
        The last state, and what every frame left behind.
    """

    def advance(state: ClothState, frame: FrameInput) -> tuple[ClothState, Frames]:
        state, report = step_frame(stepper, scene, state, frame)
        return state, Frames(state.position, state.velocity, state.friction_load, report)

    # A derivative through time keeps each frame's state and solution, and does the rest of it again.
    policy = jax.checkpoint_policies.save_only_these_names(SOLUTION)
    advance = jax.checkpoint(advance, prevent_cse=False, policy=policy)
    has_tracks = bool(jax.tree.leaves(inputs))
    return jax.lax.scan(advance, state, inputs, length=None if has_tracks else scene.num_frames - 1)


def step(
    params: Network | None,
    scene: Scene,
    state: ClothState,
    frame: Int[Array, ""] | int,
    *,
    config: SimConfig | None = None,
) -> tuple[ClothState, FrameReport]:
    """Simulate one frame of a scene; pure, as `rollout`, which repeats it.

    Args:
        params: A network, of `load_model`; None without one.
        scene: Of `prepare_scene`.
        state: Cloth at that frame; `scene.initial_state` at the first one.
        frame: Frame of the scene's motion at which the cloth is; the body moves from it to the next one.
        config: Iterations and tolerance; the solver alone by default.

    Returns:
        The cloth at the next frame, and how the frame went.

    Raises:
        ConfigError: `params` is no network.
        CheckpointError: Its weights are for another architecture.
    """
    config = config or SimConfig()
    check_network(params)
    moving = jax.tree.map(lambda leaf: leaf[frame], frame_inputs(scene))
    return step_frame(make_stepper(params, config), scene, state, moving)


def step_frame(
    stepper: Stepper, scene: Scene, state: ClothState, frame: FrameInput
) -> tuple[ClothState, FrameReport]:
    """Simulate one frame, in the substeps that the scene asks for.

    Args:
        stepper: Of `make_stepper`.
        scene: Its constant parts.
        state: Cloth at t.
        frame: The outside world from t to t + 1.
    """
    if scene.substeps == 1:
        return stepper(frame_problem(scene, state, frame), state)
    part = scene.replace(timestep=scene.timestep / scene.substeps)

    def substep(now: ClothState, row: Int[Array, ""]) -> tuple[ClothState, FrameReport]:
        return stepper(frame_problem(part, now, part_of_frame(state, frame, row, scene.substeps)), now)

    # Counted in substeps, so that gusts see the time.
    begin = state.replace(frame=scene.substeps * state.frame)
    end, reports = jax.lax.scan(substep, begin, jnp.arange(scene.substeps, dtype=jnp.int32))
    residual, number = jnp.max(reports.residual), state.frame + 1
    past = None if state.past is None else past_state(state, scene.timestep, residual)
    is_first_bad = (state.status == 0) & (end.status != 0)
    bad_frame = jnp.where(is_first_bad, number, state.first_bad_frame)
    end = end.replace(frame=number, first_bad_frame=bad_frame, past=past)
    return end, FrameReport(
        energies=jax.tree.map(lambda values: values[-1], reports.energies),
        residual=residual,
        iterations=jnp.max(reports.iterations),
        gap_bound=jnp.max(reports.gap_bound),
        demands=jax.tree.map(jnp.max, reports.demands),
        is_passed=jax.tree.map(jnp.any, reports.is_passed),
    )


def join_frames(start: ClothState, frames: Frames, end: ClothState) -> Trajectory:
    """Return the trajectory of an initial state, the frames after it, and the state it ended in."""

    def with_start(first: Array, values: Array) -> Array:
        return jnp.concatenate([first[None], values])

    reports = jax.tree.map(
        lambda leaf: with_start(jnp.zeros(leaf.shape[1:], leaf.dtype), leaf), frames.reports
    )
    is_good = end.first_bad_frame < 0
    return Trajectory(
        positions=with_start(start.position, frames.positions),
        velocities=with_start(start.velocity, frames.velocities),
        friction_loads=with_start(start.friction_load, frames.friction_loads),
        energies=reports.energies,
        residuals=reports.residual,
        gap_bounds=reports.gap_bound,
        iterations=reports.iterations,
        demands=reports.demands,
        is_passed=reports.is_passed,
        status=end.status,
        first_bad_frame=jnp.where(is_good, -1, end.first_bad_frame - start.frame),
    )
