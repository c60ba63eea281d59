"""Values over a garment to colour it by: stretch, energies, optimality gap, distance to the body."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial import cKDTree

from eslr_jax.errors import AssetError
from eslr_jax.evaluation.gap import map_frames, trajectory_states
from eslr_jax.evaluation.run_scene import run_garment, run_scene, run_trajectory
from eslr_jax.geometry.topology import vertex_normals
from eslr_jax.io.run import Run
from eslr_jax.numerics import product, scatter_corners
from eslr_jax.physics.membrane import principal_stretches
from eslr_jax.physics.potential import potential, potential_terms
from eslr_jax.physics.problem import FrameProblem, pushed_out_guess
from eslr_jax.physics.solve import Start, solve
from eslr_jax.simulation.frame import frame_inputs
from eslr_jax.types import (
    ClothState,
    Garment,
    Material,
    PotentialTerms,
    Scene,
)

# No file stores a user's own energies; energy lost to air and damping belongs to a frame, not to a shape.
_TERMS = tuple(term for term in PotentialTerms._fields if term not in ("air", "damping", "own"))
FIELDS = ("stretch", *(f"{term}-energy" for term in _TERMS), "gap", "distance")
_BODY_FIELDS = ("collision-energy", "friction-energy", "distance")
_CONTACT_FIELDS = ("collision-energy", "friction-energy", "repulsion-energy", "gap")
_ITERATIONS, _TOLERANCE = 500, 1e-3  # most of a frame's solver, and the share of its gain that it may leave
_QUADRATURE = 5  # places on the way to the optimum; two are exact for a membrane, contacts have kinks


class Field(NamedTuple):
    """A value per frame and vertex, with the range that a colour scale should span."""

    values: Float[np.ndarray, "frames vertices"]
    low: float
    high: float
    unit: str


def run_field(run: Run, name: str) -> Field:
    """Return a field of a run.

    `stretch` is the largest principal stretch, averaged over the faces around a vertex; energies and `gap`
    are those of the frame's minimisation problem, per area, see `energy_shares` and `gap_shares`; `distance`
    is to the tangent plane of the nearest body vertex.

    Args:
        run: Of `read_run`.
        name: One of `FIELDS`.

    Raises:
        AssetError: The field is unknown, or the run lacks what it needs.
    """
    if name not in FIELDS:
        raise AssetError(f"no field {name!r} to colour by: there are {', '.join(FIELDS)}")
    if name in _BODY_FIELDS and run.trajectory.body is None:
        raise AssetError(f"{run.name} has no body, and so no {name}; colour by something else")
    if name == "repulsion-energy" and not run.report.get("self_contact"):
        raise AssetError(f"{run.name} has no {name}: it was simulated without self-contact")
    if name == "distance":
        return _distances(run)
    garment, material = run_garment(run)
    if name == "stretch":
        values = np.asarray(_stretches(jnp.asarray(run.trajectory.positions), garment))
        return Field(values, 1.0, max(float(np.quantile(values, 0.999)), 1.05), "")
    values = _problem_values(run, name, garment, material)
    values = values / np.maximum(np.asarray(garment.vertex_areas), 1e-12)
    # A few vertices in hard contact hold a hundred times what others do, and shares of gap may be negative.
    low, high = (
        (0.0, np.quantile(values, 0.99)) if name in _CONTACT_FIELDS else np.quantile(values, [0.001, 0.999])
    )
    return Field(values, min(float(low), 0.0), max(float(high), 1e-6), "J/m2")


@jax.jit
def _stretches(
    positions: Float[Array, "frames vertices 3"], garment: Garment
) -> Float[Array, "frames vertices"]:
    """Return the mean over a vertex' faces of their larger principal stretch, weighted by area."""

    def frame(position: Float[Array, "vertices 3"]) -> Float[Array, " vertices"]:
        larger, _ = principal_stretches(position, garment)
        weights = garment.rest_areas[:, None] * jnp.ones((1, 3))
        total = scatter_corners(weights, garment.face_incidence)
        return scatter_corners(weights * larger[:, None], garment.face_incidence) / jnp.maximum(total, 1e-12)

    return jax.lax.map(frame, positions)


def _problem_values(
    run: Run, name: str, garment: Garment, material: Material
) -> Float[np.ndarray, "frames vertices"]:
    """Return a value [J] of the frames' minimisation problems; the first frame has none."""
    scene = run_scene(run, garment, material, has_contact=name in _CONTACT_FIELDS)
    trajectory = run_trajectory(run, scene)
    states, _ = trajectory_states(trajectory, scene)
    values = np.asarray(_every_frame(name, trajectory.positions[1:], states, scene))
    return np.concatenate([np.zeros_like(values[:1]), values])


@partial(jax.jit, static_argnames="name")
def _every_frame(
    name: str, reached: Float[Array, "frames vertices 3"], states: ClothState, scene: Scene
) -> Float[Array, "frames vertices"]:
    """State the problem of every frame and return a value of where the cloth went [J]."""

    def measure(position: Float[Array, "vertices 3"], problem: FrameProblem) -> Float[Array, " vertices"]:
        if name == "gap":
            return gap_shares(position, problem)
        return energy_shares(name.removesuffix("-energy"), position, problem)

    return map_frames(measure, reached, states, frame_inputs(scene), scene)


def energy_shares(
    term: str, position: Float[Array, "vertices 3"], problem: FrameProblem
) -> Float[Array, " vertices"]:
    """Share one term of the potential out over the vertices [J]; the shares add up to it.

    Every term is a sum over faces, hinges, vertices or pairs. Each summand is scaled by the mean of factors at
    its vertices; the term is linear in these factors, and its gradient by them gives the share of each vertex.

    Args:
        term: Name of an entry of `PotentialTerms`.
        position: Positions at t + 1 [m], shape [vertices, 3].
        problem: The frame's problem.
    """
    garment, material = problem.garment, problem.material

    def total(factors: Float[Array, " vertices"]) -> Float[Array, ""]:
        on_faces, on_hinges = (factors[rows].mean(axis=1) for rows in (garment.faces, garment.hinges))
        scaled = problem.replace(
            garment=garment.replace(
                vertex_areas=garment.vertex_areas * factors, rest_areas=garment.rest_areas * on_faces
            ),
            material=material.replace(bending_stiffness=material.bending_stiffness * on_hinges),
        )
        if material.plate is not None:  # its energy goes with the square of its rows
            plate = material.plate.replace(rows=material.plate.rows * jnp.sqrt(on_faces))
            scaled = scaled.replace(material=scaled.material.replace(plate=plate))
        if problem.body is not None:
            body = problem.body.replace(friction_load=problem.body.friction_load * factors)
            rows = {name: _weigh(getattr(body, name), factors) for name in ("skin", "tips")}
            scaled = scaled.replace(body=body.replace(**rows))
        if problem.ground is not None:
            load = problem.ground.friction_load * factors
            scaled = scaled.replace(ground=problem.ground.replace(friction_load=load))
        if problem.layers is not None:
            scaled = scaled.replace(
                layers=problem.layers.replace(pairs=_weigh(problem.layers.pairs, factors))
            )
        return getattr(potential_terms(position, scaled), term)

    return jax.grad(total)(jnp.ones_like(garment.vertex_areas))


def _weigh(rows: Any, factors: Float[Array, " vertices"]) -> Any:
    """Return contacts of faces with their areas scaled by the mean factor of their corners; None stays None."""
    return None if rows is None else rows.replace(areas=rows.areas * factors[rows.corners].mean(axis=1))


def gap_shares(position: Float[Array, "vertices 3"], problem: FrameProblem) -> Float[Array, " vertices"]:
    """Share the optimality gap out over the vertices [J]; the shares add up to it.

    The share of a vertex is the work of the remaining force at it along its straight way x* + s (x - x*) to the
    optimum, which is the integral of grad P . (x - x*) over s. The differences of `energy_shares` at x and x*
    also add up to the gap. But they show the energy that the terms exchange, which is of first order in x - x*,
    while the gap is of second order.

    Args:
        position: Any stepper's positions at t + 1 [m], shape [vertices, 3].
        problem: The frame's problem.
    """
    start = Start(position, potential(pushed_out_guess(problem), problem))
    minimum = solve(problem, start, iterations=_ITERATIONS, tolerance=_TOLERANCE)
    way = position - minimum.position
    places, weights = np.polynomial.legendre.leggauss(_QUADRATURE)

    def work(place: Float[Array, ""]) -> Float[Array, " vertices"]:
        gradient = jax.grad(potential)(minimum.position + place * way, problem)
        return jnp.sum(gradient * way, axis=-1)

    works = jax.lax.map(work, jnp.asarray(0.5 * (places + 1.0), position.dtype))
    return product(jnp.asarray(0.5 * weights, position.dtype), works)


def _distances(run: Run) -> Field:
    """Return the height of every vertex over the tangent plane of the nearest body vertex [m]."""
    trajectory = run.trajectory
    if trajectory.body is None:
        raise AssetError(f"{run.name} has no body, and so no distance to it")
    values = np.empty(trajectory.positions.shape[:2], np.float32)
    faces = trajectory.body.faces
    for frame, (cloth, body) in enumerate(zip(trajectory.positions, trajectory.body.positions, strict=True)):
        normals = vertex_normals(body, faces)
        _, nearest = cKDTree(body).query(cloth)
        values[frame] = np.einsum("vx,vx->v", cloth - body[nearest], normals[nearest])
    return Field(values, 0.0, 0.06, "m")
