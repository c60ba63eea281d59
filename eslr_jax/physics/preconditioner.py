"""Estimates of the potential's Hessian that are cheap to invert: a diagonal, and one with springs."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int

from eslr_jax.numerics import Vector3, components, scatter_corners
from eslr_jax.physics.collision import penetration, skin_diagonal
from eslr_jax.physics.problem import FrameProblem
from eslr_jax.physics.repulsion import repulsion_diagonal
from eslr_jax.types import Garment, Material

_TERMS = 4  # of the Chebyshev series; more measured no better per second (experiments/tried.md)
_REACH = 0.9  # share of every spring that is inverted; one is exact and needs many terms
# Share of its stiffness at rest that a spring keeps where its edge has collapsed, to under a third of its length.
# Without it, the energy of cloth that starts flat on a line rises by 0.5 % of its drop (hard case `bad_start`).
_LEAST_SPRING = 0.1


@struct.dataclass
class Stiffness:
    """A matrix that stands for the Hessian: springs between neighbours, alike along every axis."""

    diagonal: Float[Array, " vertices"]  # [N/m], no smaller than the sum of the row's springs
    neighbors: Int[Array, "vertices degree"]  # padded with the vertex itself
    springs: Float[Array, "vertices degree"]  # [N/m], the same both ways; zero where padded or pinned


def stretch_diagonal(garment: Garment, material: Material) -> Float[Array, " vertices"]:
    """Return the membrane's stiffness per vertex at rest [N/m], averaged over the triangle's plane.

    Moving one corner along its height changes the strain by 1/height, so the curvature is A h (lambda + 2 mu)
    / height^2 = h (lambda + 2 mu) |opposite edge|^2 / (4 A); with threads their mean stiffness.
    """
    corners = garment.sewn_positions[garment.faces]
    opposite = corners[:, [2, 0, 1]] - corners[:, [1, 2, 0]]
    squared = jnp.sum(opposite * opposite, axis=-1)
    if material.threads is None:
        modulus = material.thickness * (material.lame_lambda + 2.0 * material.lame_mu)
    else:  # averaged over the plane as well
        modulus = 0.5 * (material.threads.stiffness[0] + material.threads.stiffness[1])
    is_real = garment.rest_areas > 0
    scale = jnp.where(is_real, modulus / (4.0 * jnp.where(is_real, garment.rest_areas, 1.0)), 0.0)
    return scatter_corners(scale[:, None] * squared, garment.face_incidence)


def hessian_diagonal(
    problem: FrameProblem, position: Float[Array, "vertices 3"]
) -> Float[Array, " vertices"]:
    """Return a positive stiffness per vertex [N/m]: inertia, stretch, contacts and friction at `position`.

    Padded vertices get one, so that dividing by it is safe.

    Args:
        problem: The frame's problem.
        position: Where contact and friction are linearised [m], shape [vertices, 3].
    """
    garment = problem.garment
    diagonal = problem.masses / problem.inertial_timestep**2 + _membrane_diagonal(problem)
    if problem.body is not None:
        body = problem.body
        depth = penetration(position, body.nearest, body.thickness)
        depth = depth + penetration(position, body.opposing, body.thickness)
        diagonal = diagonal + _touch_diagonal(problem, depth, body.friction_load)
    if problem.ground is not None:
        ground = problem.ground
        depth = penetration(position, ground.contacts, ground.thickness)
        diagonal = diagonal + _touch_diagonal(problem, depth, ground.friction_load)
    diagonal = diagonal + pair_diagonal(problem, position)
    return jnp.where(garment.vertex_mask, diagonal, 1.0)


def _touch_diagonal(
    problem: FrameProblem, depth: Float[Array, " vertices"], load: Float[Array, " vertices"]
) -> Float[Array, " vertices"]:
    """Return the stiffness per vertex [N/m] of a contact so deep [m], with friction under a normal force [N].

    The contact's curvature acts along one of three axes, that of friction along two.
    """
    constants = problem.constants
    slip = constants.friction_speed * problem.timestep
    touch = 2.0 * constants.collision_stiffness * problem.garment.vertex_areas * depth
    return touch + constants.friction_coefficient * load / (3.0 * slip)


def _membrane_diagonal(problem: FrameProblem) -> Float[Array, " vertices"]:
    """Return the stiffness per vertex of the strain and of its change [N/m]."""
    diagonal = stretch_diagonal(problem.garment, problem.material)
    return diagonal if problem.strain is None else (1.0 + problem.strain.rate) * diagonal


def pair_diagonal(problem: FrameProblem, position: Float[Array, "vertices 3"]) -> Float[Array, " vertices"]:
    """Return the stiffness per vertex [N/m] of contact between faces and points, at positions [m]."""
    constants, diagonal = problem.constants, jnp.zeros(position.shape[0], position.dtype)
    if problem.body is not None:
        skin, tips = problem.body.skin, problem.body.tips
        stiffness, thickness = constants.collision_stiffness, constants.collision_thickness
        if skin is not None:
            diagonal += skin_diagonal(position, skin, stiffness, thickness)
        if tips is not None:
            diagonal += repulsion_diagonal(position, tips, stiffness, thickness)
    if problem.layers is not None:
        layers, stiffness = problem.layers, constants.repulsion_stiffness
        diagonal += repulsion_diagonal(position, layers.pairs, stiffness, layers.thickness, layers.limit)
    return diagonal


def stiffness(problem: FrameProblem, position: Float[Array, "vertices 3"]) -> Stiffness:
    """Return the diagonal at `position` with the springs that share out its membrane part.

    Every edge gets the smaller of what its two ends can give, so the matrix is symmetric and diagonally
    dominant. A cotangent Laplacian measured no better, and can lose definiteness on obtuse triangles.

    Args:
        problem: The frame's problem.
        position: Where contact and friction are linearised [m], shape [vertices, 3].
    """
    garment = problem.garment
    is_free = garment.vertex_mask
    if problem.pin_targets is not None:
        is_free = is_free & ~garment.is_pinned
    degree = jnp.maximum(jnp.sum(garment.neighbor_mask, axis=1, dtype=garment.rest_areas.dtype), 1)
    share = jnp.where(is_free, _membrane_diagonal(problem) / degree, 0.0)
    springs = jnp.minimum(share[:, None], share[garment.neighbors])
    return Stiffness(
        diagonal=hessian_diagonal(problem, position),
        neighbors=garment.neighbors,
        springs=jnp.where(garment.neighbor_mask, springs, 0.0),
    )


def stretched_stiffness(problem: FrameProblem, position: Float[Array, "vertices 3"]) -> Stiffness:
    """Return the stiffness that the solver starts from: springs as they are stretched at `position`.

    A spring of the St. Venant-Kirchhoff membrane stiffens with the square of its stretch. The diagonal changes by
    the sum of the changes of a vertex's springs, and no more: with a larger diagonal long waves converge slowly
    (experiments/tried.md). Networks take `stiffness`, which they were trained with.

    Args:
        problem: The frame's problem.
        position: Where springs, contact and friction are linearised [m], shape [vertices, 3].
    """
    matrix = stiffness(problem, position)
    squared, rest = (
        _squared_lengths(points, matrix.neighbors) for points in (position, problem.garment.sewn_positions)
    )
    is_spring = matrix.springs > 0
    stretched = jnp.where(is_spring, squared, 0.0) / jnp.where(is_spring, rest, 1.0)
    springs = matrix.springs * jnp.maximum(stretched, _LEAST_SPRING)
    added = jnp.sum(springs - matrix.springs, axis=1)
    return matrix.replace(springs=springs, diagonal=matrix.diagonal + added)


def _squared_lengths(
    points: Float[Array, "vertices 3"], neighbors: Int[Array, "vertices degree"]
) -> Float[Array, "vertices degree"]:
    """Return the squared distances of vertices from their neighbours [m^2]."""
    return sum((part[neighbors] - part[:, None]) ** 2 for part in points.T)  # type: ignore[return-value]


def solve_stiffness(matrix: Stiffness, force: Float[Array, "vertices 3"]) -> Float[Array, "vertices 3"]:
    """Return displacements [m] that nearly balance a force [N]; see `stiffness_inverse`."""
    return stiffness_inverse(matrix)(force)


def stiffness_inverse(
    matrix: Stiffness,
) -> Callable[[Float[Array, "vertices 3"]], Float[Array, "vertices 3"]]:
    """Return a map from forces [N] to displacements [m] that nearly balance them, a polynomial in D^-1 W.

    Four terms of the Chebyshev semi-iteration on D - reach W, with diagonal D and springs W. The eigenvalues
    of D^-1 W lie in [-1, 1], so the polynomial is positive: the map is linear, symmetric and positive
    definite, as L-BFGS needs. Outside a loop, its coefficients are computed once.

    Source: Golub and Varga 1961, doi 10.1007/BF01386013.
    """
    inverse_diagonal = 1.0 / matrix.diagonal
    weights = (_REACH * inverse_diagonal[:, None] * matrix.springs).T
    neighbors = matrix.neighbors.T
    factors = jnp.asarray(_chebyshev_factors(), matrix.diagonal.dtype)

    def smooth(x: Array) -> Array:
        return sum(weight * x[neighbor] for weight, neighbor in zip(weights, neighbors, strict=True))  # type: ignore[return-value]

    def add_term(term: Array, carry: tuple[Vector3, Vector3, Vector3]):
        update, total, residual = (list(part) for part in carry)
        for axis in range(3):
            residual[axis] = residual[axis] - update[axis] + smooth(update[axis])
            update[axis] = factors[term, 0] * update[axis] + factors[term, 1] * residual[axis]
            total[axis] = total[axis] + update[axis]
        return tuple(update), tuple(total), tuple(residual)

    def solve(force: Float[Array, "vertices 3"]) -> Float[Array, "vertices 3"]:
        first = components(inverse_diagonal[:, None] * force)
        # A loop, although its length is fixed: unrolled, XLA computes a term anew for each of its neighbours.
        _, total, _ = jax.lax.fori_loop(0, _TERMS - 1, add_term, (first, first, first))
        return jnp.stack(total, axis=-1)

    return solve


def _chebyshev_factors() -> np.ndarray:
    """Return what each term keeps of the last update, and its share of the residual."""
    factors, ratio = [], _REACH
    for _ in range(_TERMS - 1):
        next_ratio = 1.0 / (2.0 / _REACH - ratio)
        factors.append((next_ratio * ratio, 2.0 * next_ratio / _REACH))
        ratio = next_ratio
    return np.array(factors)
