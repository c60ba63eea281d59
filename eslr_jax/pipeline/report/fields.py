"""Values over a garment to colour it by: stretch, energies, optimality gap, distance to the body."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial import cKDTree

from eslr_jax.errors import AssetError
from eslr_jax.mesh.topology import vertex_areas, vertex_normals
from eslr_jax.numerics import components, product
from eslr_jax.pipeline.report.gap import map_frames
from eslr_jax.pipeline.report.metrics import face_stretches
from eslr_jax.pipeline.report.run import Run, run_trajectory
from eslr_jax.solver.guess import Start, pushed_out_guess
from eslr_jax.solver.potential import potential
from eslr_jax.solver.solve import solve
from eslr_jax.terms.term import FrameProblem, pin, vertex_shares
from eslr_jax.types import Scene, Trajectory

# Energy lost to air and damping belongs to a frame, not to a shape.
_TERMS = ("stretch", "bending", "inertia", "gravity", "collision", "friction")
FIELDS = ("stretch", *(f"{term}-energy" for term in _TERMS), "gap", "distance")
_BODY_FIELDS = ("collision-energy", "friction-energy", "distance")
_CONTACT_FIELDS = ("collision-energy", "friction-energy", "gap")
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

    `stretch` is the largest principal stretch, averaged over the area of faces around a vertex; energies, `gap`
    are those of the frame's minimisation problem, per area, see `energy_shares` and `gap_shares`; `distance`
    is to the tangent plane of the nearest body vertex.

    Raises:
        AssetError: The field is unknown, or the run lacks what it needs.
    """
    if name not in FIELDS:
        raise AssetError(f"no field {name!r} to colour by: there are {', '.join(FIELDS)}")
    if name in _BODY_FIELDS and run.trajectory.body is None:
        raise AssetError(f"{run.name} has no body, and so no {name}; colour by something else")
    if name == "distance":
        trajectory = run.trajectory
        assert trajectory.body is not None
        values = np.empty(trajectory.positions.shape[:2], np.float32)
        faces = trajectory.body.faces
        tracks = zip(trajectory.positions, trajectory.body.positions, strict=True)
        for frame, (cloth, body) in enumerate(tracks):
            normals = vertex_normals(body, faces)
            _, nearest = cKDTree(body).query(cloth)
            values[frame] = np.einsum("vx,vx->v", cloth - body[nearest], normals[nearest])
        return Field(values, 0.0, 0.06, "m")
    garment = run.scene.garment
    if name == "stretch":
        stretches = np.asarray(face_stretches(jnp.asarray(run.trajectory.positions), garment))
        areas, faces = np.asarray(garment.rest_areas, np.float64), np.asarray(garment.faces)
        count = len(garment.rest_positions)
        values = np.stack([vertex_areas(areas * row, faces, count) for row in stretches])
        values /= np.maximum(vertex_areas(areas, faces, count), 1e-12)
        return Field(values, 1.0, max(float(np.quantile(values, 0.999)), 1.05), "")
    values = np.asarray(_every_frame(name, run_trajectory(run), run.scene))
    values = np.concatenate([np.zeros_like(values[:1]), values])
    values = values / np.maximum(np.asarray(garment.vertex_areas), 1e-12)
    # A few vertices in hard contact hold a hundred times what others do, and shares of gap may be negative.
    low, high = (
        (0.0, np.quantile(values, 0.99)) if name in _CONTACT_FIELDS else np.quantile(values, [0.001, 0.999])
    )
    return Field(values, min(float(low), 0.0), max(float(high), 1e-6), "J/m2")


@partial(jax.jit, static_argnames="name")
def _every_frame(name: str, trajectory: Trajectory, scene: Scene) -> Float[Array, "frames vertices"]:
    """State the problem of every frame and return a value of where the cloth went [J]."""
    measure = gap_shares if name == "gap" else partial(energy_shares, name.removesuffix("-energy"))
    return map_frames(measure, trajectory, scene)


def energy_shares(
    name: str, position: Float[Array, "vertices 3"], problem: FrameProblem
) -> Float[Array, " vertices"]:
    """Share the energy of the terms of one name out over the vertices [J]; the shares add up to it.

    The frame's problem has these terms, and the cloth is at the position at t + 1 [m].
    """
    x = components(pin(problem, position))
    parts = [
        part for term, data in problem.parts if term.name == name for part in term.elements(x, problem, data)
    ]
    return vertex_shares(tuple(parts), x[0].shape[0])


def gap_shares(position: Float[Array, "vertices 3"], problem: FrameProblem) -> Float[Array, " vertices"]:
    """Share the optimality gap out over the vertices [J]; the shares add up to it.

    The share of a vertex is the work of the remaining force at it along its straight way x* + s (x - x*) to the
    optimum, which is the integral of grad P . (x - x*) over s. The differences of `energy_shares` at x and x*
    also add up to the gap. But they show the energy that the terms exchange, which is of first order in x - x*,
    while the gap is of second order. The position is any stepper's at t + 1 [m].
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
