"""Score anybody's trajectory by the measures that our own is reported with (host)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from eslr_jax.errors import ConfigError, MissingExtraError, MotionError, NonFiniteError
from eslr_jax.numerics import safe_norm
from eslr_jax.pipeline.formats.garment import split_outfit
from eslr_jax.pipeline.report.crossing import intersecting_pairs
from eslr_jax.pipeline.report.gap import gap_medians, map_frames, past_states, trajectory_gap
from eslr_jax.pipeline.report.metrics import face_stretches
from eslr_jax.pipeline.report.report import Parts, trajectory_report
from eslr_jax.pipeline.report.wear import wear_report
from eslr_jax.pose.lbs import skin_garment
from eslr_jax.simulation.frame import frame_inputs, frame_problem
from eslr_jax.simulation.simulate import enlarge_buffers
from eslr_jax.simulation.stepper import buffer_demands
from eslr_jax.solver.potential import contact_load, evaluate, potential_terms
from eslr_jax.terms.term import FrameProblem, weight_norm
from eslr_jax.types import BodyMotion, Scene, Trajectory


def foreign_trajectory(
    positions: Float[ArrayLike, "frames vertices 3"],
    scene: Scene,
    *,
    velocities: Float[ArrayLike, "frames vertices 3"] | None = None,
    friction_loads: Float[ArrayLike, "frames vertices"] | None = None,
    iterations: int = 0,
) -> Trajectory:
    """Return the trajectory of another simulator; what it does not tell, such as energies and residuals, is NaN.

    Args:
        positions: Vertex positions [m], shape [frames, vertices, 3].
        scene: The scene that was simulated.
        velocities: Vertex velocities [m/s], shape [frames, vertices, 3]; by default the scene's own in frame 0,
            and then what its integrator makes of the positions.
        friction_loads: Normal forces that load friction [N], shape [frames, vertices]; by default those of our
            contacts.
        iterations: Iterations that it spent on every frame.
    """
    x = jnp.asarray(positions, jnp.float32)
    if velocities is None:
        # Implicit Euler: (x_t - x_{t-1}) / dt. BDF2, from frame 2 on: (3 x_t - 4 x_{t-1} + x_{t-2}) / (2 dt).
        moved = jnp.diff(x, axis=0) / scene.timestep
        if scene.initial_state.past is not None:
            moved = jnp.concatenate([moved[:1], 1.5 * moved[1:] - 0.5 * moved[:-1]])
        v = jnp.concatenate([scene.initial_state.velocity[None], moved])
    else:
        v = jnp.asarray(velocities, jnp.float32)
    loads = find_friction_loads(x, v, scene) if friction_loads is None else jnp.asarray(friction_loads)
    unknown = jnp.full(len(x), jnp.nan)
    return Trajectory(
        positions=x,
        velocities=v,
        friction_loads=loads,
        energies={term.name: unknown for term in scene.terms},
        residuals=unknown,
        gap_bounds=unknown,
        iterations=jnp.full(len(x), iterations, jnp.int32).at[0].set(0),
        status=jnp.int32(0),
        first_bad_frame=jnp.int32(-1),
    )


@jax.jit
def find_friction_loads(
    positions: Float[Array, "frames vertices 3"], velocities: Float[Array, "frames vertices 3"], scene: Scene
) -> Float[Array, "frames vertices"]:
    """Return the friction loads [N] of a trajectory that does not tell them; it is in m and m/s."""

    def advance(load, frame):
        position, velocity, past, reached, inputs = frame
        state = scene.initial_state.replace(
            position=position, velocity=velocity, friction_load=load, past=past
        )
        load = contact_load(reached, frame_problem(scene, state, inputs))
        return load, load

    first = scene.initial_state.friction_load
    past = past_states(positions, velocities, scene)
    frames = (positions[:-1], velocities[:-1], past, positions[1:], frame_inputs(scene))
    _, loads = jax.lax.scan(advance, first, frames)
    return jnp.concatenate([first[None], loads])


@jax.jit
def with_energies(trajectory: Trajectory, scene: Scene) -> Trajectory:
    """Return a trajectory with energies, residuals and pairs of cloth at its positions; frame 0 has none.

    Those of the simulator that it is of are replaced by ours.
    """

    def measure(
        position: Float[Array, "vertices 3"], problem: FrameProblem
    ) -> tuple[dict[str, Array], Float[Array, ""], dict[str, Array]]:
        gradient = evaluate(position, problem).gradient
        residual = safe_norm(gradient.reshape(-1)) / weight_norm(problem)
        return potential_terms(position, problem), residual, buffer_demands(problem)

    energies, residuals, demands = jax.tree.map(
        lambda track: jnp.concatenate([jnp.zeros_like(track[:1]), track]),
        map_frames(measure, trajectory, scene),
    )
    return trajectory.replace(energies=energies, residuals=residuals, demands=demands)


EVERY = 4  # frames between those whose gap and intersections are measured, as in `eslr evaluate`
# The gap is measured from the second simulated frame on: the first one's velocity is guessed.
_LEAST_FRAMES = 3
_INTERSECTIONS = (
    "intersections_cloth",
    "intersections_cloth_max",
    "intersections_body",
    "intersections_body_max",
)


def score_trajectory(
    trajectory: Trajectory | Float[ArrayLike, "frames vertices 3"],
    scene: Scene,
    *,
    poses: BodyMotion | None = None,
    parts: Parts = (None, ()),
    outfit: Mapping[str, int] | None = None,
    every: int = EVERY,
) -> dict[str, Any]:
    """Score a trajectory of any simulator.

    Args:
        trajectory: Vertex positions [m], shape [frames, vertices, 3], in the order of the scene's garment; or a
            trajectory, whose velocities and friction loads then count.
        scene: What was simulated, of `prepare_scene`; it has as many frames.
        poses: The whole body, see `trajectory_report`. If given, `wear_report` measures how the garment sits.
        parts: Parts of the garment, see `trajectory_report`.
        outfit: Garments that are worn together, see `trajectory_report`.
        every: Frames between those whose gap and intersections are measured.

    Returns:
        Plain values: those of `trajectory_report` without `iterations_mean`, with `poses` those of `wear_report`,
        and
        - `pooled_stretch_p99`: the principal stretch that 99 % of the faces of all frames stay below;
        - `gap_relative_median`, `gap_relative_max`: the optimality gap in our energy, from the trajectory's own
          states, relative to the initial gap; `gap_median_j`, `gap_mean_j` and `gap_p90_j` in joules;
          `gap_frames`, the number of frames in which the gap was measured;
        - `intersections_cloth`, `intersections_body`: pairs of triangles that intersect in the last frame, and,
          ending in `_max`, in the worst of the frames measured. None without the extra `score`. `garments` has
          those of the last frame that a garment takes part in.

    Raises:
        ConfigError: `every` is less than one.
        MotionError: There are fewer than three frames, or another number of frames or vertices than in the scene.
        NonFiniteError: A position is NaN or infinite.
    """
    positions = np.asarray(trajectory.positions if isinstance(trajectory, Trajectory) else trajectory)
    if every < 1:
        raise ConfigError(f"every = {every}: give a number of frames, 1 or more")
    expected = (scene.num_frames, *scene.initial_state.position.shape)
    if positions.shape != expected:
        raise MotionError(
            f"positions {positions.shape} are not those of the scene, which has {list(expected)}: frames, "
            "vertices and 3; give a trajectory of this garment and of all frames"
        )
    if len(positions) < _LEAST_FRAMES:
        raise MotionError(f"{len(positions)} frames are too few to score; give {_LEAST_FRAMES} or more")
    is_finite = np.isfinite(positions).all(axis=(1, 2))
    if not is_finite.all():
        raise NonFiniteError(f"frame {np.argmin(is_finite)} is not finite; cut the trajectory before it")
    if not isinstance(trajectory, Trajectory):
        trajectory = foreign_trajectory(positions, scene)
    before = trajectory
    trajectory = with_energies(before, scene)
    # Those that `simulate` begins with are small.
    if (larger := enlarge_buffers(scene, trajectory.demands)) is not None:
        scene = larger
        trajectory = with_energies(before, scene)
    report = trajectory_report(trajectory, scene, parts=parts, poses=poses, outfit=outfit)
    del report["iterations_mean"]  # another simulator's are not ours
    if poses is not None:
        skinned = jax.jit(skin_garment)(scene.garment, poses.joint_transforms)
        report |= wear_report(positions, scene.garment, skinned, poses, parts=parts)
    # BDF2 goes on by the residuals, if they are known; here as in the energies.
    ends = jax.device_get(trajectory_gap(before, scene, every=every))
    is_face = np.asarray(scene.garment.rest_areas) > 0
    stretches = np.asarray(face_stretches(trajectory.positions[1:], scene.garment))[:, is_face]
    return report | {
        "pooled_stretch_p99": float(np.quantile(stretches, 0.99)),
        "gap_frames": len(ends.reached),
        **gap_medians(ends, ends.reached),
        "gap_relative_max": float(np.max(ends.share(ends.reached))),
        **_count_intersections(positions, scene, every, report["garments"]),
    }


def _count_intersections(
    positions: np.ndarray, scene: Scene, every: int, garments: dict[str, dict[str, Any]] | None
) -> dict[str, int | None]:
    """Return the numbers of intersecting pairs of triangles in the last frame, and in the worst measured frame.

    Every entry of `garments` gets the number of pairs in the last frame that involve this garment.
    """
    faces = np.asarray(scene.garment.faces)[np.asarray(scene.garment.rest_areas) > 0]
    body, body_faces = None, None
    if scene.body is not None:
        body, body_faces = np.asarray(scene.body.positions), np.asarray(scene.body.surface.faces)
    frames = sorted({*range(2, len(positions), every), len(positions) - 1})
    try:
        pairs = [
            intersecting_pairs(positions[frame], faces, None if body is None else body[frame], body_faces)
            for frame in frames
        ]
    except MissingExtraError:
        return dict.fromkeys(_INTERSECTIONS)
    is_body = [(found >= len(faces)).any(axis=1) for found in pairs]
    with_body = [int(is_its.sum()) for is_its in is_body]
    cloth = [len(is_its) - count for is_its, count in zip(is_body, with_body, strict=True)]
    rows = garments or {}
    for name, _, is_own in split_outfit(faces, {name: row["num_vertices"] for name, row in rows.items()}):
        takes_part = np.isin(pairs[-1], np.flatnonzero(is_own)).any(axis=1)
        rows[name]["intersections_cloth"] = int(np.sum(takes_part & ~is_body[-1]))
        rows[name]["intersections_body"] = int(np.sum(takes_part & is_body[-1]))
    return dict(zip(_INTERSECTIONS, (cloth[-1], max(cloth), with_body[-1], max(with_body)), strict=True))
