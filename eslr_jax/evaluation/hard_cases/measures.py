"""What is measured in a hard case; every value is better when smaller and passes at or below its bar."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from eslr_jax.evaluation.colliders import triangle_distances
from eslr_jax.evaluation.gap import trajectory_states
from eslr_jax.evaluation.hard_cases.simulators import Run, StressScene
from eslr_jax.evaluation.referee import Referee, Verdict
from eslr_jax.physics.bending import bending_energy
from eslr_jax.physics.inertia import vertex_masses
from eslr_jax.physics.lbfgs import minimize
from eslr_jax.physics.membrane import principal_stretches, stretch_energy
from eslr_jax.physics.potential import potential
from eslr_jax.physics.preconditioner import hessian_diagonal
from eslr_jax.physics.problem import FrameProblem, PhysicsParameters, make_problem, pin, start_guess
from eslr_jax.simulation.step import frame_problem, solve
from eslr_jax.types import Garment, Material

MM = 1e3  # millimetres per metre
_SETTLED = 1e4  # [s], a step so long that inertia is nothing: its minimum is the equilibrium
_REFERENCE_ITERATIONS = 500  # leave 1e-5 of the drop
_SETTLE_ITERATIONS = 3000
_TRIANGLE_MARGIN = 0.06  # [m] from the collider within which triangles are looked at exactly


class Measure(NamedTuple):
    """One figure and its bar."""

    name: str  # with the unit
    value: float
    bar: float | None  # passes at or below; None is for information alone

    @property
    def is_passed(self) -> bool:
        """Whether the value is a number at or below the bar."""
        return self.bar is None or bool(np.isfinite(self.value) and self.value <= self.bar)


def not_finite(run: Run) -> float:
    """Return the number of frames that hold NaN or infinity."""
    return float(np.sum(~np.isfinite(run.positions).all(axis=(1, 2))))


def largest_stretch(run: Run, first: int = 0) -> float:
    """Return the largest principal stretch from a frame on."""
    assert run.trajectory is not None
    assert run.stress is not None
    positions = run.trajectory.positions[min(first, run.trajectory.num_frames - 1) :]
    return float(np.max(_stretches(positions, run.stress.scene.garment)))


@jax.jit
def _stretches(positions: Float[Array, "frames vertices 3"], garment: Garment) -> Float[Array, " frames"]:
    return jax.lax.map(lambda x: jnp.max(principal_stretches(x, garment)[0]), positions)


def depths(run: Run, *, exact: bool = False) -> Float[np.ndarray, "frames items"]:
    """Return how deep every vertex, or triangle, is in the colliders, in every frame [mm].

    Args:
        run: Of a scene with colliders.
        exact: Over triangles, which see a tip between vertices.
    """
    assert run.stress is not None
    assert run.stress.colliders is not None
    rows = []
    for frame, position in enumerate(run.positions):
        items = position[run.faces] if exact else position
        distance = np.full(len(items), np.inf)
        for collider in run.stress.colliders(frame):
            if not exact:
                distance = np.minimum(distance, collider.distance(items))
                continue
            is_near = np.min(collider.distance(items), axis=1) < _TRIANGLE_MARGIN
            distance[is_near] = np.minimum(distance[is_near], triangle_distances(collider, items[is_near]))
        rows.append(-MM * distance)
    return np.stack(rows)


def quantile_depth(run: Run, share: float = 0.999) -> float:
    """Return a quantile of the vertices' depth over all frames [mm]; zero if they are outside."""
    values = depths(run)
    return float(max(np.quantile(values, share), 0.0)) if np.isfinite(values).all() else float("nan")


def speeds(run: Run) -> Float[np.ndarray, "frames vertices"]:
    """Return the speed of every vertex in every frame but the first [m/s]."""
    return np.linalg.norm(np.diff(run.positions, axis=0), axis=-1) / run.timestep


def rms_speed(run: Run, first: int = 0) -> float:
    """Return the root mean square vertex speed from a frame on [m/s]."""
    values = speeds(run)[min(first, len(run.positions) - 2) :]
    return float(np.sqrt(np.mean(values**2)))


def center(run: Run) -> Float[np.ndarray, "frames 3"]:
    """Return the centre of mass in every frame [m]."""
    assert run.stress is not None
    masses = _real_masses(run)
    return np.einsum("fvx,v->fx", run.positions, masses) / masses.sum()


def _real_masses(run: Run) -> np.ndarray:
    assert run.stress is not None
    scene = run.stress.scene
    masses = np.asarray(vertex_masses(scene.garment, scene.material), np.float64)
    return masses[np.asarray(scene.garment.vertex_mask)]


def mechanical_energy(run: Run) -> Float[np.ndarray, " frames"]:
    """Return stretch, bending, gravitational and kinetic energy in every frame [J]."""
    assert run.trajectory is not None
    assert run.stress is not None
    scene = run.stress.scene
    elastic = np.asarray(_elastic(run.trajectory.positions, scene.garment, scene.material), np.float64)
    masses = _real_masses(run)
    height = run.positions[..., 1] @ masses
    velocities = np.asarray(run.trajectory.velocities, np.float64)[:, np.asarray(scene.garment.vertex_mask)]
    kinetic = 0.5 * np.sum(velocities**2, axis=-1) @ masses
    return elastic + float(run.stress.parameters.gravity) * height + kinetic


@jax.jit
def _elastic(positions: Array, garment: Garment, material: Material) -> Float[Array, " frames"]:
    def energy(position):
        return stretch_energy(position, garment, material) + bending_energy(position, garment, material)

    return jax.lax.map(energy, positions)


def largest_rise(energy: Float[np.ndarray, " frames"]) -> float:
    """Return the largest rise of an energy over its lowest value so far [J]."""
    return float(np.max(energy - np.minimum.accumulate(energy)))


@jax.jit
def _settle(position: Array, problem: FrameProblem, garment: Garment, material: Material) -> Array:
    minimum = minimize(
        lambda x: potential(x, problem, garment, material),
        position,
        hessian_diagonal(problem, garment, material, position),
        iterations=_SETTLE_ITERATIONS,
        memory=16,
    )
    return pin(problem, garment, minimum.position)


def settle(
    stress: StressScene, position: Float[np.ndarray, "vertices 3"], pins: np.ndarray | None = None
) -> np.ndarray:
    """Return the equilibrium near some positions, without a body [m].

    Args:
        stress: Cloth, fabric and gravity.
        position: Where to start [m].
        pins: Targets of pinned vertices; the scene's last if not given [m].
    """
    scene = stress.scene
    if pins is None and scene.pin_targets is not None:
        pins = np.asarray(scene.pin_targets[-1])
    x = jnp.asarray(position, jnp.float32)
    state = dataclasses.replace(scene.start, position=x, velocity=jnp.zeros_like(x))
    targets = None if pins is None else jnp.asarray(pins, jnp.float32)
    problem = make_problem(scene.garment, state, None, targets, jnp.float32(_SETTLED), stress.parameters)
    return np.asarray(_settle(x, problem, scene.garment, scene.material))


class Gaps(NamedTuple):
    """How far answers are from the optimum of their own frame."""

    gap: np.ndarray  # [J]
    share: np.ndarray  # of the drop from the pushed-out inertial guess to the optimum


def own_gaps(run: Run, every: int) -> Gaps:
    """Compare some of a trajectory's frames with the optimum from the same state, without self-contact."""
    assert run.trajectory is not None
    assert run.stress is not None
    answer, start, best = jax.device_get(
        _gaps(run.trajectory, run.stress.scene, run.stress.parameters, every)
    )
    drop = np.maximum(start - best, 1e-9)
    return Gaps(answer - best, (answer - best) / drop)


@partial(jax.jit, static_argnames="every")
def _gaps(trajectory, scene, parameters: PhysicsParameters, every: int):
    states, inputs = trajectory_states(trajectory, scene, parameters)
    answers = trajectory.positions[1:]
    garment, material = scene.garment, scene.material
    taken = jax.tree.map(lambda leaf: leaf[every - 1 :: every], (states, inputs, answers))

    def compare(frame):
        state, inputs, answer = frame
        problem = frame_problem(garment, state, inputs, scene.surface, scene.timestep, parameters)
        start = start_guess(problem, garment)
        best = [
            solve(
                problem, garment, material, x, iterations=_REFERENCE_ITERATIONS, memory=16, tolerance=0.0
            ).value
            for x in (start, answer)
        ]
        value = potential(answer, problem, garment, material)
        guess = potential(start, problem, garment, material)
        return value, guess, jnp.minimum(*best)

    return jax.lax.map(compare, taken)


def judge_frames(run: Run, frames: list[int]) -> list[Verdict]:
    """Ask the referee about some frames; negative frames count from the end."""
    assert run.stress is not None
    positions = run.positions
    body = run.stress.scene.body_positions
    body = None if body is None else np.asarray(body)
    referee = Referee(
        run.faces, positions.shape[1], run.stress.body_faces, 0 if body is None else body.shape[1]
    )
    return [referee.judge(positions[frame], None if body is None else body[frame]) for frame in frames]
