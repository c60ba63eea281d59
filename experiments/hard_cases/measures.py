"""What is measured in a hard case; every value is better when smaller."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from eslr_jax.pipeline.report.crossing import intersecting_pairs
from eslr_jax.pipeline.report.gap import trajectory_states
from eslr_jax.simulation.frame import frame_problem
from eslr_jax.solver.guess import Start, initial_guess
from eslr_jax.solver.potential import potential
from eslr_jax.solver.solve import solve
from eslr_jax.terms import Bending, Gravity, Inertia, Stretch
from eslr_jax.terms.bending import bending_energy
from eslr_jax.terms.stretch import principal_stretches, stretch_energy
from eslr_jax.terms.term import FrameProblem, pin, vertex_masses, with_terms
from eslr_jax.types import Scene, Trajectory
from hard_cases.case import Run
from hard_cases.colliders import triangle_distances

MM = 1e3  # millimetres per metre
_SETTLED = 1e4  # [s], a step so long that inertia is nothing: its minimum is the equilibrium
_OPTIMUM_ITERATIONS = 500  # leave 1e-5 of the initial gap
_SETTLE_ITERATIONS = 3000
_TRIANGLE_MARGIN = 0.06  # [m] from the collider within which triangles are looked at exactly


def largest_stretch(run: Run, first: int = 0) -> float:
    """Return the largest principal stretch from a frame on."""
    return float(np.max(_stretches(run.trajectory.positions[first:], run.scene)))


@jax.jit
def _stretches(positions: Float[Array, "frames vertices 3"], scene: Scene) -> Float[Array, " frames"]:
    return jax.lax.map(lambda x: jnp.max(principal_stretches(x, scene.garment)[0]), positions)


def depths(run: Run) -> Float[np.ndarray, "frames vertices"]:
    """Return how deep every vertex is in the colliders [mm], shape [frames, vertices]; negative outside."""
    return -MM * np.stack(
        [
            np.min([collider.distance(position) for collider in run.colliders(frame)], axis=0)
            for frame, position in enumerate(run.positions)
        ]
    )


def triangle_depths(run: Run) -> Float[np.ndarray, "frames faces"]:
    """Return how deep every triangle is in the colliders [mm], shape [frames, faces]; sees tips between vertices.

    Triangles far from the colliders get minus infinity.
    """
    distances = np.full((len(run.positions), len(run.faces)), np.inf)
    for frame, position in enumerate(run.positions):
        corners = position[run.faces]
        for collider in run.colliders(frame):
            is_near = np.min(collider.distance(corners), axis=1) < _TRIANGLE_MARGIN
            found = triangle_distances(collider, corners[is_near])
            distances[frame, is_near] = np.minimum(distances[frame, is_near], found)
    return -MM * distances


def quantile_depth(values: Float[np.ndarray, "frames vertices"]) -> float:
    """Return the depth that 99.9 % of the vertices keep [mm]; zero if they are outside."""
    return float(max(np.quantile(values, 0.999), 0.0))


def speeds(run: Run) -> Float[np.ndarray, "frames vertices"]:
    """Return the speed of every vertex in every frame but the first [m/s], shape [frames - 1, vertices]."""
    return np.linalg.norm(np.diff(run.positions, axis=0), axis=-1) / run.timestep


def rms(values: np.ndarray) -> float:
    """Return the root mean square of values."""
    return float(np.sqrt(np.mean(values**2)))


def center(run: Run) -> Float[np.ndarray, "frames 3"]:
    """Return the centre of mass in every frame [m], shape [frames, 3]."""
    masses = _masses(run.scene)
    return np.einsum("fvx,v->fx", np.asarray(run.trajectory.positions, np.float64), masses) / masses.sum()


def _masses(scene: Scene) -> Float[np.ndarray, " vertices"]:
    """Return the vertices' masses [kg], shape [vertices]; zero where padded."""
    return np.asarray(vertex_masses(scene.garment, scene.material), np.float64)


def weight(scene: Scene) -> float:
    """Return the cloth's weight [N]."""
    return float(scene.term(Gravity).acceleration) * float(_masses(scene).sum())


def mechanical_energy(run: Run) -> Float[np.ndarray, " frames"]:
    """Return stretch, bending, gravitational and kinetic energy in every frame [J], shape [frames]."""
    return _energy(run.scene, run.trajectory.positions, run.trajectory.velocities)


def energy_at_rest(scene: Scene, position: Float[Array, "vertices 3"]) -> float:
    """Return the mechanical energy [J] of cloth that stands still at positions [m], shape [vertices, 3]."""
    return float(_energy(scene, position[None], jnp.zeros_like(position)[None])[0])


def _energy(scene: Scene, positions: Array, velocities: Array) -> Float[np.ndarray, " frames"]:
    masses = _masses(scene)
    height = np.asarray(positions, np.float64)[..., 1] @ masses
    kinetic = 0.5 * np.sum(np.asarray(velocities, np.float64) ** 2, axis=-1) @ masses
    elastic = np.asarray(_elastic(positions, scene), np.float64)
    return elastic + float(scene.term(Gravity).acceleration) * height + kinetic


@jax.jit
def _elastic(positions: Float[Array, "frames vertices 3"], scene: Scene) -> Float[Array, " frames"]:
    def energy(position):
        stretch = stretch_energy(position, scene.garment, scene.material)
        return stretch + bending_energy(position, scene.garment, scene.material)

    return jax.lax.map(energy, positions)


def largest_rise(energy: Float[np.ndarray, " frames"]) -> float:
    """Return the largest rise of an energy over its lowest value so far [J]."""
    return float(np.max(energy - np.minimum.accumulate(energy)))


@jax.jit
def settle(
    scene: Scene, position: Float[Array, "vertices 3"], pin_targets: Float[Array, "vertices 3"]
) -> Float[Array, "vertices 3"]:
    """Return the equilibrium near some positions, without a body and with pins at their targets [m]."""
    problem = FrameProblem(
        garment=scene.garment,
        material=scene.material,
        timestep=jnp.float32(_SETTLED),
        position=position,
        inertial_guess=position,
        pin_targets=pin_targets,
    )
    problem = with_terms(problem, (Stretch(), Bending(), Inertia(), Gravity()))
    start = Start(position, jnp.float32(0.0))
    return pin(problem, solve(problem, start, iterations=_SETTLE_ITERATIONS, memory=16).position)


def optimality_gaps(run: Run, every: int) -> Float[np.ndarray, " frames"]:
    """Return the gap of every so many frames [J]: the potential reached minus its minimum from the same state."""
    return np.asarray(_gaps(run.trajectory, run.scene, every))


@partial(jax.jit, static_argnames="every")
def _gaps(trajectory: Trajectory, scene: Scene, every: int) -> Float[Array, " frames"]:
    """Return the gaps; unlike `measure_gap`, this also looks below where the simulator went, and at frame 1."""
    states, inputs = trajectory_states(trajectory, scene)
    frames = (states, inputs, trajectory.positions[1:])

    def compare(frame):
        state, inputs, reached = frame
        problem = frame_problem(scene, state, inputs)

        def descend(position):
            start = Start(position, jnp.float32(0.0))
            return solve(problem, start, iterations=_OPTIMUM_ITERATIONS, memory=16).value

        optima = jax.lax.map(descend, jnp.stack([initial_guess(problem).position, reached]))
        return potential(reached, problem) - jnp.min(optima)

    return jax.lax.map(compare, jax.tree.map(lambda leaf: leaf[every - 1 :: every], frames))


def count_crossings(run: Run, frames: list[int]) -> list[int]:
    """Return how many pairs of cloth triangles intersect in some frames."""
    return [len(intersecting_pairs(run.positions[frame], run.faces)) for frame in frames]
