"""Repulsion: a one-sided barrier between layers of cloth, or between cloth and tips of the body.

It is cubic, but between layers linear once they have passed through each other. Two limbs that intersect force
the layers between them through each other, and no force can keep these layers apart. A force without a bound
grew to 100,000 times the weight of the cloth, and tore it.

Layers are vertices over faces and edges over edges (`LayerPairs`). Tips are vertices of the body over faces of
the cloth (`TipPairs`); they don't give way.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from eslr_jax.contact.layer_edges import LayerPairs, layer_heights
from eslr_jax.contact.self_contact import TipPairs
from eslr_jax.numerics import (
    Vector3,
    components,
    cross3,
    dot3,
    in_memory,
    safe_normalize,
    segment_sum,
    sub3,
    take3,
)
from eslr_jax.terms.problem import FrameProblem
from eslr_jax.terms.term import Elements, Term
from eslr_jax.types import Garment

Pairs = LayerPairs | TipPairs
_SWEEPS = 4  # of `push_apart`


@struct.dataclass
class Repulsion(Term):
    """Layers of cloth keep apart."""

    name = "repulsion"

    def elements(self, x: Vector3, problem: FrameProblem, data: Any) -> tuple[Elements, ...]:
        """Return the energy of every pair [J]; see `repulsion_energies`."""
        return (_elements(x, *_layers(problem)),)

    def diagonal(self, x: Vector3, problem: FrameProblem, data: Any) -> Float[Array, " vertices"]:
        """Return an estimate of the curvature [N/m]; see `repulsion_diagonal`."""
        return repulsion_diagonal(x, *_layers(problem))

    def describe(self, garment: Garment) -> str:
        """Return what touches what."""
        return "layers of cloth"


def _layers(problem: FrameProblem) -> tuple[Pairs, Any, Any, Any]:
    """Return the pairs of layers with stiffness, thickness and limit; a scene with their term has found them."""
    layers: Any = problem.layers
    return layers.pairs, problem.constants.repulsion_stiffness, layers.thickness, layers.limit


@struct.dataclass
class TipCollision(Term):
    """Tips of the body that are finer than the cloth's mesh against its faces."""

    name = "collision"

    def elements(self, x: Vector3, problem: FrameProblem, data: Any) -> tuple[Elements, ...]:
        """Return the energy of every tip [J]; see `repulsion_energies`."""
        constants, tips = problem.constants, problem.body.tips  # type: ignore[union-attr]
        return (_elements(x, tips, constants.collision_stiffness, constants.collision_thickness),)

    def diagonal(self, x: Vector3, problem: FrameProblem, data: Any) -> Float[Array, " vertices"]:
        """Return an estimate of the curvature [N/m]; see `repulsion_diagonal`."""
        constants, tips = problem.constants, problem.body.tips  # type: ignore[union-attr]
        return repulsion_diagonal(x, tips, constants.collision_stiffness, constants.collision_thickness)

    def describe(self, garment: Garment) -> str:
        """Return what touches what."""
        return "faces off the body's tips"


def _elements(x: Vector3, pairs: Pairs, *distances: Any) -> Elements:
    return Elements(repulsion_energies(x, pairs, *distances), pairs.corners)


def pair_heights(
    position: Float[Array, "vertices 3"] | Vector3,
    pairs: Pairs,
) -> tuple[Float[Array, " pairs"], Vector3]:
    """Return the height d of every pair's first place over its second one [m], and the direction of that height.

    For a tip x_p, d = side (x_p + sum_k w_k x_k) . n with the face's unit normal n at `position`; for layers see
    `layer_heights`. An energy of d does not change when the cloth turns, so the forces between layers have no
    resultant and no moment. Unused rows give zero.
    """
    x = components(position)
    if isinstance(pairs, LayerPairs):
        return layer_heights(x, pairs)
    point, places = components(pairs.next_points), take3(x, pairs.corners.T)
    corners = [tuple(c[k] for c in places) for k in range(3)]
    weights = [pairs.weights[:, k] for k in range(3)]
    offset = tuple(point[axis] + sum(weights[k] * corners[k][axis] for k in range(3)) for axis in range(3))
    normal = cross3(sub3(corners[1], corners[0]), sub3(corners[2], corners[0]))  # type: ignore[arg-type]
    unit = safe_normalize(jnp.stack(normal, axis=0), axis=0)
    direction = (pairs.side * unit[0], pairs.side * unit[1], pairs.side * unit[2])
    return dot3(offset, direction), direction  # type: ignore[arg-type]


def overlaps(
    position: Float[Array, "vertices 3"] | Vector3,
    pairs: Pairs,
    thickness: Float[Array, " pairs"] | Float[Array, ""] | float,
) -> Float[Array, " pairs"]:
    """Return max(thickness - d, 0) per pair [m]; zero where a row is not used."""
    height, _ = pair_heights(position, pairs)
    return jnp.where(pairs.side != 0, jnp.maximum(thickness - height, 0.0), 0.0)


def repulsion_energies(
    position: Float[Array, "vertices 3"] | Vector3,
    pairs: Pairs,
    stiffness: Float[Array, ""] | float,
    thickness: Float[Array, " pairs"] | Float[Array, ""] | float,
    limit: Float[Array, ""] | float | None = None,
) -> Float[Array, " pairs"]:
    """Return stiffness a_p f(max(thickness - d, 0)) of every pair [J]; f(x) = x^3, and linear beyond the limit.

    Args:
        position: Cloth vertices at t + 1 [m].
        pairs: Places that are close at t, with the areas a_p.
        stiffness: [J/m^5].
        thickness: Distance kept [m].
        limit: Overlap beyond which the force grows no further [m]; None: it always grows.

    Source: ContourCraft (arXiv 2405.09522), its repulsion loss, with areas in place of its count of vertices
        and the nearest place on the face in place of a corner.
    """
    depth = overlaps(position, pairs, thickness)
    (areas,) = in_memory(stiffness * pairs.areas)
    barrier = areas * depth * depth * depth
    if limit is not None:
        linear = areas * limit * limit * (3.0 * depth - 2.0 * limit)
        barrier = jnp.where(depth < limit, barrier, linear)
    return barrier


def repulsion_diagonal(
    position: Float[Array, "vertices 3"] | Vector3,
    pairs: Pairs,
    stiffness: Float[Array, ""] | float,
    thickness: Float[Array, " pairs"] | Float[Array, ""] | float,
    limit: Float[Array, ""] | float | None = None,
) -> Float[Array, " vertices"]:
    """Return an estimate of the energy's curvature per vertex [N/m], a third of that along the normal.

    Beyond the limit, where the energy has none, it is that at the limit.
    """
    depth = overlaps(position, pairs, thickness)
    if limit is not None:
        depth = jnp.minimum(depth, limit)
    curvature = 2.0 * stiffness * pairs.areas * depth
    weights = pairs.weights.T
    num_vertices = components(position)[0].shape[0]
    return segment_sum((weights**2 * curvature[None]).ravel(), pairs.corners.T.ravel(), num_vertices)


def push_apart(
    position: Float[Array, "vertices 3"],
    pairs: Pairs,
    thickness: Float[Array, " pairs"] | Float[Array, ""] | float,
) -> Float[Array, "vertices 3"]:
    """Move overlapping pairs apart, a few times: layers by half the overlap each, cloth off a tip by all of it.

    Like pushing cloth out of the body, this saves the slow first iterations that the barrier would take. A vertex
    of several pairs moves by the mean of their moves.
    """
    num_vertices = position.shape[0]
    share = 0.5 if isinstance(pairs, LayerPairs) else 1.0
    ids, weights = pairs.corners.T, pairs.weights.T
    # A place moves by one if corner k of it moves by w_k / |w|^2. The sign of a weight doesn't say whose it is:
    # rounding makes some of a face's a little negative.
    is_first = _are_first(pairs)
    first, second = (jnp.sum(jnp.where(own, weights**2, 0.0), axis=0) for own in (is_first, ~is_first))
    size = jnp.where(is_first, first, second)
    scale = share * weights / jnp.where(size > 0, size, 1.0)

    def sweep(_, position: Float[Array, "vertices 3"]) -> Float[Array, "vertices 3"]:
        height, direction = pair_heights(position, pairs)
        depth = jnp.where(pairs.side != 0, jnp.maximum(thickness - height, 0.0), 0.0)
        touched = ((weights != 0) & (depth > 0)[None]).astype(position.dtype)
        lift = depth[:, None] * jnp.stack(direction, axis=-1)
        moves = jnp.concatenate([scale[:, :, None] * lift[None], touched[:, :, None]], axis=2)
        moved = segment_sum(moves.reshape(-1, 4), ids.ravel(), num_vertices)
        return position + moved[:, :3] / jnp.maximum(moved[:, 3:], 1.0)

    return jax.lax.fori_loop(0, _SWEEPS, sweep, position)  # a loop: unrolled, every sweep is compiled anew


def _are_first(pairs: Pairs) -> Bool[Array, "corners pairs"]:
    """Return which corners belong to the first place of their pair; none where that is a tip of the body."""
    if isinstance(pairs, LayerPairs):
        is_edge = pairs.is_edge
        return jnp.stack([jnp.ones_like(is_edge), is_edge, jnp.zeros_like(is_edge), jnp.zeros_like(is_edge)])
    return jnp.zeros(pairs.corners.T.shape, bool)
