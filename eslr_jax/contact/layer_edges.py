"""Contacts between edges of two layers of cloth, which contacts of vertices and faces miss."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from eslr_jax.contact.lines import cross_lines
from eslr_jax.contact.self_contact import FacePairs
from eslr_jax.numerics import Vector3, cross3, dot3, safe_normalize, sub3, sum_products, take3
from eslr_jax.types import Garment

# [m] between two edges at t or at t + 1, within which they are paired: three times the thickness of repulsion.
_NEAR = 0.01
_LEAST_COSINE = 0.5  # between the common normal of two edges and the normal of the face that told their side


@struct.dataclass
class LayerPairs:
    """Pairs of places of the cloth that are close at t: a vertex and a face, or two edges that cross.

    A row that is not used has `side` zero.
    """

    corners: Int[Array, "pairs 4"]  # a vertex and the face's three, or both ends of one edge and of the other
    # Weights of the corners in the offset between the two nearest places at t: those of the vertex or of the
    # first edge add up to one, those of the face or of the second edge to minus one.
    weights: Float[Array, "pairs 4"]
    side: Float[Array, " pairs"]  # 1 where the first place is kept along the normal, -1 against it
    areas: Float[Array, " pairs"]  # of cloth that a pair stands for [m^2]
    is_edge: Bool[Array, " pairs"]
    count: Int[Array, ""]  # pairs of a vertex and a face found, perhaps more than there are rows
    status: Int[Array, ""]  # Status.SELF_CONTACT_OVERFLOW if a capacity was too small


def with_edges(
    position: Float[Array, "vertices 3"],
    predicted: Float[Array, "vertices 3"],
    faces: FacePairs,
    garment: Garment,
) -> LayerPairs:
    """Return pairs of vertices and faces, followed by pairs of edges that cross.

    Pairs of vertices and faces don't keep two edges apart. The edges around each vertex are tested against the
    three edges of the face that it is paired with, and take the side of that pair. There are half as many rows of
    edges as of vertices and faces. They hold the pairs with the least height; pairs beyond them are left out, and
    no status tells it. So larger buffers can hold more pairs of edges.

    Args:
        position: Vertices at t [m], shape [vertices, 3].
        predicted: A guess of the vertices at t + 1 [m], shape [vertices, 3].
        faces: Pairs of vertices and faces.
        garment: Rest mesh.
    """
    count = faces.side.shape[0] // 2
    now, ahead = jax.lax.stop_gradient((position.T, predicted.T))
    vertices, corners, side = _lowest(now, faces, count)
    others = garment.neighbors[vertices]  # [starts, degree]
    is_apart = garment.neighbor_mask[vertices][:, :, None] & ~jnp.any(
        others[:, :, None] == corners[:, None, :], axis=2, keepdims=True
    )
    ends = (
        vertices[:, None, None],
        others[:, :, None],
        corners[:, None, :],
        jnp.roll(corners, -1, axis=1)[:, None, :],
    )
    up = side[None] * jnp.stack(_normal(now, corners))
    clearance, _, _ = _over(now, ahead, ends, up[:, :, None, None])
    clearance = jnp.where(is_apart, clearance, jnp.inf)
    lowest_clearance, lowest = jax.lax.top_k(-clearance.ravel(), count)
    rows = jnp.stack([jnp.broadcast_to(end, clearance.shape).ravel()[lowest] for end in ends])
    start = lowest // (clearance.shape[1] * clearance.shape[2])
    _, weights, sign = _over(position.T, predicted.T, tuple(rows), up[:, start])
    is_used = (-lowest_clearance < _NEAR) & ~_are_repeated(rows)
    edges = LayerPairs(
        corners=jnp.where(is_used, rows, position.shape[0] - 1).T,
        weights=jnp.where(is_used, weights, 0.0).T,
        side=jnp.where(is_used, sign, 0.0),
        # Of all four ends: a pair is found from several of them, and rounding says from which first.
        areas=jnp.where(is_used, jnp.mean(garment.vertex_areas[rows], axis=0), 0.0),
        is_edge=jnp.ones(count, bool),
        count=faces.count,
        status=faces.status,
    )
    return jax.tree.map(
        lambda face, edge: jnp.concatenate([face, edge]) if face.ndim else face, without_edges(faces), edges
    )


def without_edges(faces: FacePairs) -> LayerPairs:
    """Return pairs of vertices and faces of the cloth as pairs of layers."""
    return LayerPairs(
        corners=jnp.concatenate([faces.vertices[:, None], faces.corners], axis=1),
        weights=jnp.pad(-faces.weights, ((0, 0), (1, 0)), constant_values=1.0),
        side=faces.side,
        areas=faces.areas,
        is_edge=jnp.zeros(faces.side.shape, bool),
        count=faces.count,
        status=faces.status,
    )


def layer_heights(position: Vector3, pairs: LayerPairs) -> tuple[Float[Array, " pairs"], Vector3]:
    """Return how high first places are over second ones [m], and the direction that it is measured in.

    d = side sum_k w_k x_k . n, with n the unit normal of the face, or across both edges, at `position`.

    Args:
        position: Vertices [m], by components.
        pairs: Corners, and places on them.
    """
    read = take3(position, pairs.corners.T)
    a, b, c, d = (tuple(axis[k] for axis in read) for k in range(4))

    def choose(edge: Vector3, face: Vector3) -> Vector3:
        return tuple(jnp.where(pairs.is_edge, x, y) for x, y in zip(edge, face, strict=True))  # type: ignore[return-value]

    # One edge and the other, or the face's sides from its first corner.
    unit = _across(choose(sub3(b, a), sub3(c, b)), choose(sub3(d, c), sub3(d, b)))  # type: ignore[arg-type]
    direction = (pairs.side * unit[0], pairs.side * unit[1], pairs.side * unit[2])
    return dot3(_offset((a, b, c, d), pairs.weights.T), direction), direction  # type: ignore[arg-type]


def _lowest(
    now: Float[Array, "3 vertices"], faces: FacePairs, count: int
) -> tuple[Int[Array, " starts"], Int[Array, "starts 3"], Float[Array, " starts"]]:
    """Return vertices, corners and sides of the pairs of a vertex and a face that are closest at t."""
    place = sum_products("pk,xpk->xp", jax.lax.stop_gradient(faces.weights), now[:, faces.corners])
    squared = jnp.sum(jnp.square(now[:, faces.vertices] - place), axis=0)
    _, lowest = jax.lax.top_k(-jnp.where(faces.side != 0, squared, jnp.inf), count)
    return faces.vertices[lowest], faces.corners[lowest], faces.side[lowest]


def _normal(now: Float[Array, "3 vertices"], corners: Int[Array, "rows 3"]) -> Vector3:
    """Return unit normals of faces."""
    a, b, c = (tuple(now[:, corners[:, k]]) for k in range(3))
    return _across(sub3(b, a), sub3(c, a))  # type: ignore[arg-type]


def _over(
    now: Float[Array, "3 vertices"],
    ahead: Float[Array, "3 vertices"],
    ends: tuple[Int[Array, ...], ...],
    up: Float[Array, "3 ..."],
) -> tuple[Float[Array, ...], Float[Array, "4 ..."], Float[Array, ...]]:
    """Return heights of edges over others [m], the lower of t and t + 1, weights of the ends, and sides.

    The height is infinite where two edges don't cross or are far apart, and where their common normal is far from
    `up`.

    Args:
        now: Vertices at t [m], by components.
        ahead: At t + 1.
        ends: Vertices: both ends of the first edge, then both ends of the second one.
        up: Direction from the second edge to the side on which the first one belongs; zero if unknown.
    """
    a, b, c, d = (tuple(now[:, end]) for end in ends)
    first, second, is_crossing = cross_lines((a, b), (c, d))
    weights = jnp.stack(jnp.broadcast_arrays(1.0 - first, first, second - 1.0, -second))
    normal = _across(sub3(b, a), sub3(d, c))  # type: ignore[arg-type]
    along = dot3(normal, tuple(up))  # type: ignore[arg-type]
    side = jnp.where(along < 0, -1.0, 1.0).astype(now.dtype)
    over = side * dot3(_offset((a, b, c, d), weights), normal)
    a, b, c, d = moved = tuple(tuple(ahead[:, end]) for end in ends)
    next_over = side * dot3(_offset(moved, weights), _across(sub3(b, a), sub3(d, c)))  # type: ignore[arg-type]
    is_pair = is_crossing & (jnp.abs(along) > _LEAST_COSINE) & (jnp.abs(over) < 2.0 * _NEAR)
    return jnp.where(is_pair, jnp.minimum(over, next_over), jnp.inf), weights, side


def _across(first: Vector3, second: Vector3) -> Vector3:
    """Return the unit vectors across two edges, which may broadcast."""
    return tuple(safe_normalize(jnp.stack(cross3(first, second)), axis=0))  # type: ignore[return-value]


def _offset(places: tuple[Vector3, ...], weights: Float[Array, "4 ..."]) -> Vector3:
    """Return the sum of places with weights."""
    return tuple(
        sum(weight * place[axis] for weight, place in zip(weights, places, strict=True)) for axis in range(3)
    )  # type: ignore[return-value]


def _are_repeated(rows: Int[Array, "4 rows"]) -> Bool[Array, " rows"]:
    """Return which pairs were found before, from another of their ends."""
    low = jnp.minimum(rows[(0, 2), :], rows[(1, 3), :])
    high = jnp.maximum(rows[(0, 2), :], rows[(1, 3), :])
    is_turned = low[0] > low[1]
    keys = [jnp.where(is_turned, x[1 - k], x[k]) for k in range(2) for x in (low, high)]
    order = jnp.lexsort(keys)
    is_same = jnp.all(jnp.stack([key[order][1:] == key[order][:-1] for key in keys]), axis=0)
    return jnp.zeros(rows.shape[1], bool).at[order[1:]].set(is_same)
