"""What a stress test runs: a scene with its surroundings, and anything that simulates it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from eslr_jax.config import ModelConfig, SimConfig
from eslr_jax.errors import EslrError, Status
from eslr_jax.evaluation.colliders import Collider
from eslr_jax.physics.problem import PhysicsParameters
from eslr_jax.rollout import more_room
from eslr_jax.simulation.scan import frame_inputs, join_frames, scan_frames
from eslr_jax.types import ClothState, Scene, Trajectory

_CHUNK = 10  # frames per call of the compiled scan, so that scenes of any length share it


@dataclasses.dataclass(frozen=True)
class StressScene:
    """A scene, and what its measures need to know about it."""

    scene: Scene
    body_faces: np.ndarray | None = None  # into the scene's body positions
    colliders: Callable[[int], Sequence[Collider]] | None = None  # what the body stands for, by frame
    parameters: PhysicsParameters = dataclasses.field(default_factory=PhysicsParameters)
    self_contact: bool = False  # layers must not pass through each other
    is_sharp: bool = False  # the body has tips finer than the cloth's mesh


@dataclasses.dataclass(frozen=True)
class Simulator:
    """Anything that simulates a scene; it may refuse by raising an `EslrError`."""

    name: str
    simulate: Callable[[StressScene], Trajectory]
    garment_options: dict[str, Any] = dataclasses.field(default_factory=dict)  # of `prepare_garment`


@dataclasses.dataclass(frozen=True)
class Run:
    """What came out of a scene; either a trajectory or a refusal."""

    stress: StressScene | None  # None: the scene itself was refused
    trajectory: Trajectory | None
    refusal: EslrError | None = None

    @property
    def positions(self) -> np.ndarray:
        """Positions of the real vertices, float64 [m], shape [frames, vertices, 3]."""
        assert self.trajectory is not None
        assert self.stress is not None
        is_real = np.asarray(self.stress.scene.garment.vertex_mask)
        return np.asarray(self.trajectory.positions, np.float64)[:, is_real]

    @property
    def faces(self) -> np.ndarray:
        """Faces that are no padding, shape [faces, 3]."""
        assert self.stress is not None
        garment = self.stress.scene.garment
        return np.asarray(garment.faces)[np.asarray(garment.rest_areas) > 0]

    @property
    def timestep(self) -> float:
        """Seconds between frames."""
        assert self.stress is not None
        return float(self.stress.scene.timestep)

    @property
    def status(self) -> Status:
        """What the simulator itself found wrong."""
        return Status.OK if self.trajectory is None else Status(int(self.trajectory.status))


def simulate(params: Any, stress: StressScene, config: SimConfig) -> Trajectory:
    """Simulate a scene with this package, again with larger buffers where they ran over, as `rollout` does.

    Args:
        params: Weights of the network; None for the physics simulator.
        stress: The scene.
        config: Which simulator, and how.
    """
    trajectory = _simulate(params, stress, config)
    while (larger := more_room(trajectory, config)) is not None:
        config = larger
        trajectory = _simulate(params, stress, config)
    return trajectory


def _simulate(params: Any, stress: StressScene, config: SimConfig) -> Trajectory:
    """Simulate a scene, a few frames at a time.

    Scenes whose arrays have the same shapes share one compiled function, whatever their length.
    """
    scene = stress.scene
    total = scene.num_frames - 1
    inputs = frame_inputs(scene)
    constant = dataclasses.replace(
        scene, body_positions=None, pin_targets=None, start=_blank(scene.start), num_frames=0
    )
    state, done, first = scene.start, [], 0
    for length in [_CHUNK] * (total // _CHUNK) + [1] * (total % _CHUNK):
        part = jax.tree.map(lambda leaf, rows=slice(first, first + length): leaf[rows], inputs)
        state, frames = _scan(params, constant, state, part, length, stress.parameters, config)
        done.append(frames)
        first += length
    joined = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *done)
    return join_frames(scene.start, joined, state)


_scan = jax.jit(scan_frames, static_argnames=("length", "config"))


def _blank(state: ClothState) -> ClothState:
    """Return a state of zeros: the scan doesn't read the scene's own."""
    return jax.tree.map(jnp.zeros_like, state)


def physics_simulator(
    *, iterations: int = 200, substeps: int = 1, tolerance: float = 0.0, self_contact: bool = True
) -> Simulator:
    """Return the L-BFGS solver as a simulator.

    Args:
        iterations: Per step, at most.
        substeps: Steps per frame.
        tolerance: See `SimConfig`.
        self_contact: Keep layers apart in scenes that ask for it.
    """

    def run(stress: StressScene) -> Trajectory:
        config = SimConfig(
            simulator="physics",
            solver_iterations=iterations,
            tolerance=tolerance,
            self_contact=self_contact and stress.self_contact,
            tip_contact=stress.is_sharp,
        )
        fine = dataclasses.replace(stress, scene=split_frames(stress.scene, substeps))
        return join_substeps(simulate(None, fine, config), substeps)

    return Simulator(f"physics, {iterations} iterations", run)


def network_simulator(
    params: Any,
    model: ModelConfig,
    *,
    name: str = "network",
    corrector_steps: int = 0,
    self_contact: bool = True,
) -> Simulator:
    """Return a network as a simulator.

    Args:
        params: Weights.
        model: Architecture.
        name: What tables call it.
        corrector_steps: Solver iterations behind it.
        self_contact: Keep layers apart in scenes that ask for it.
    """

    def run(stress: StressScene) -> Trajectory:
        config = SimConfig(
            simulator="network",
            model=model,
            corrector_steps=corrector_steps,
            self_contact=self_contact and stress.self_contact,
            tip_contact=stress.is_sharp,
        )
        return simulate(params, stress, config)

    options = {"embedding_size": model.embedding_size, "embedding_mode": model.embedding_mode}
    return Simulator(name, run, options)


def split_frames(scene: Scene, substeps: int) -> Scene:
    """Return a scene with `substeps` shorter frames in place of each one; surroundings move straight."""
    if substeps == 1:
        return scene

    def split(track):
        if track is None:
            return None
        share = jnp.arange(substeps, dtype=track.dtype) / substeps
        share = share.reshape(1, -1, *[1] * (track.ndim - 1))
        between = (1 - share) * track[:-1, None] + share * track[1:, None]
        return jnp.concatenate([between.reshape(-1, *track.shape[1:]), track[-1:]])

    return dataclasses.replace(
        scene,
        body_positions=split(scene.body_positions),
        pin_targets=split(scene.pin_targets),
        timestep=scene.timestep / substeps,
        num_frames=(scene.num_frames - 1) * substeps + 1,
    )


def join_substeps(trajectory: Trajectory, substeps: int) -> Trajectory:
    """Return the whole frames of a trajectory with substeps; iterations are added up."""
    if substeps == 1:
        return trajectory
    spent = trajectory.iterations[1:].reshape(-1, substeps).sum(axis=1)
    first_bad, needed = trajectory.first_bad_frame, trajectory.needed_capacity
    if needed is not None:
        most = jnp.max(needed[1:].reshape(-1, substeps, 2), axis=1)
        needed = jnp.concatenate([needed[:1], most])
    return dataclasses.replace(
        trajectory,
        positions=trajectory.positions[::substeps],
        velocities=trajectory.velocities[::substeps],
        residuals=trajectory.residuals[::substeps],
        iterations=jnp.concatenate([trajectory.iterations[:1], spent]),
        needed_capacity=needed,
        first_bad_frame=jnp.where(first_bad > 0, (first_bad + substeps - 1) // substeps, first_bad),
    )


def shorten(stress: StressScene, num_frames: int | None) -> StressScene:
    """Return the first frames of a scene."""
    scene = stress.scene
    if num_frames is None or num_frames >= scene.num_frames:
        return stress

    def head(track):
        return None if track is None else track[:num_frames]

    return dataclasses.replace(
        stress,
        scene=dataclasses.replace(
            scene,
            body_positions=head(scene.body_positions),
            pin_targets=head(scene.pin_targets),
            num_frames=num_frames,
        ),
    )


def run_scene(simulator: Simulator, stress: StressScene | EslrError) -> Run:
    """Simulate a scene; a refusal is a result too."""
    if isinstance(stress, EslrError):
        return Run(None, None, stress)
    try:
        return Run(stress, jax.block_until_ready(simulator.simulate(stress)))
    except EslrError as error:
        return Run(stress, None, error)
