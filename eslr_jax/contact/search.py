"""Nearest faces of a body surface: blocks of query points against patches of the surface, by bounding boxes."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from eslr_jax.contact.triangle import point_triangle
from eslr_jax.numerics import (
    TrueEntries,
    Vector3,
    components,
    dot3,
    sub3,
    take3,
    true_entries,
    true_rows,
)
from eslr_jax.types import BodySurface

_INFINITY = 0x7F800000  # bits of the float32 infinity
_FIRST = 2  # patches that every block looks into; what they hold bounds the distance to the others
_PAIRS = 4  # pairs of a block and a patch that are looked at together, times the number of blocks
_SHARE_FACING = 4  # one block in so many is searched for its opposing faces at a time


class PosedSurface(NamedTuple):
    """A body surface at one moment."""

    positions: Float[Array, "surface_vertices 3"]  # [m]
    normals: Float[Array, "surface_vertices 3"]
    reach: Float[Array, " surface_vertices"]  # [m] within which a vertex may oppose another


class _Groups(NamedTuple):
    """Points in compact groups; component arrays have shape [groups, members]."""

    points: Vector3  # [m]
    normals: Vector3


class _Patches(NamedTuple):
    """Surface vertices in patches."""

    vertices: Int[Array, "patches members"]
    groups: _Groups


class _Nearest(NamedTuple):
    """The two nearest vertices so far.

    A squared distance stands as the bits of its float32, with the vertex in the lowest of them: as integers they
    order like the distances, so that one minimum tells both the distance and whose it is.
    """

    first: Int[Array, "*shape"]
    second: Int[Array, "*shape"]


Exclusion = Callable[[_Groups, Vector3, Vector3], Bool[Array, "pairs rows"]]
"""From points, and one candidate with its normal for each group of them, to where it does not count."""


def nearest_faces(
    query: Float[Array, "vertices 3"],
    positions: Float[Array, "surface_vertices 3"],
    surface: BodySurface,
    blocks: Int[Array, "blocks rows"],
) -> Int[Array, " vertices"]:
    """Return the face nearest to every query point; zero for points in no block.

    Args:
        query: Points [m].
        positions: Surface vertices [m].
        surface: Search tables.
        blocks: Compact groups of query points.
    """
    body = components(positions)
    members = take3(body, surface.patch_vertices)
    patches = _Patches(surface.patch_vertices, _Groups(members, members))
    points = take3(components(query), blocks)
    groups = _Groups(points, points)
    num_patches = members[0].shape[0]
    keys = _with_index(_gaps(points, members), jnp.arange(num_patches, dtype=jnp.int32)[None], num_patches)
    mask, key = _index_mask(keys.shape[1]), jnp.full(blocks.shape[0], -1)
    nearest = _nothing(blocks.shape)
    for _ in range(min(_FIRST, keys.shape[1])):
        key = jnp.min(jnp.where(keys > key[:, None], keys, _INFINITY), axis=1)
        nearest = _merge(nearest, _look(groups, key & mask, patches))
    farthest = jnp.max(nearest.first, axis=1, keepdims=True)
    is_open = (keys > key[:, None]) & ((keys & ~mask) < farthest)
    nearest = _search(groups, patches, true_entries(is_open), nearest)
    face = _nearest_around(points, _vertices(nearest, patches), body, surface)
    return jnp.zeros(query.shape[0], jnp.int32).at[blocks].set(face)


def opposing_faces(
    query: Float[Array, "vertices 3"],
    facing: Float[Array, "vertices 3"],
    body: PosedSurface,
    surface: BodySurface,
    blocks: Int[Array, "blocks rows"],
    least_cosine: float,
) -> tuple[Int[Array, " vertices"], Bool[Array, " vertices"]]:
    """Return the nearest face that lies before every query point and faces it, and whether there is one.

    Args:
        query: Points [m].
        facing: Normals of the body at the place that is nearest to them.
        body: The surface.
        surface: Search tables.
        blocks: Compact groups of query points.
        least_cosine: Between normals, below which two places face each other.
    """
    ids, count = surface.patch_vertices, blocks.shape[0]
    positions = components(body.positions)
    patches = _Patches(ids, _Groups(take3(positions, ids), take3(components(body.normals), ids)))
    groups = _Groups(take3(components(query), blocks), take3(components(facing), blocks))
    may_oppose = _may_oppose(groups, patches.groups, jnp.max(body.reach[ids], axis=1), least_cosine)

    def is_excluded(points: _Groups, candidate: Vector3, normal: Vector3) -> Bool[Array, "pairs rows"]:
        is_ahead = dot3(sub3(candidate, points.points), points.normals) >= 0
        return ~(is_ahead & (dot3(normal, points.normals) <= least_cosine))

    nearest = _search(groups, patches, true_entries(may_oppose), _nothing(blocks.shape), is_excluded)
    # Faces are looked for where there is a vertex: in a few blocks, some at a time.
    is_found = nearest.first < _INFINITY
    size = -(-count // _SHARE_FACING)
    order, num_found = true_rows(jnp.any(is_found, axis=1), _SHARE_FACING * size)
    order = jnp.minimum(order, count - 1)

    def locate(carry):
        first, face = carry
        rows = jax.lax.dynamic_slice(order, (first,), (size,))
        some, found = jax.tree.map(lambda leaf: leaf[rows], (groups.points, nearest))
        vertices = _vertices(found, patches)
        return first + size, face.at[rows].set(_nearest_around(some, vertices, positions, surface))

    start = (jnp.int32(0), jnp.zeros(blocks.shape, jnp.int32))
    _, face = jax.lax.while_loop(lambda carry: carry[0] < num_found, locate, start)
    nothing = jnp.zeros(query.shape[0], jnp.int32)
    return nothing.at[blocks].set(face), nothing.astype(bool).at[blocks].set(is_found)


def _bounds(values: Vector3) -> tuple[Vector3, Vector3]:
    """Return the lowest and the highest of every component within the groups."""
    x, y, z = values
    low = (jnp.min(x, axis=1), jnp.min(y, axis=1), jnp.min(z, axis=1))
    return low, (jnp.max(x, axis=1), jnp.max(y, axis=1), jnp.max(z, axis=1))


Range = tuple[Array, Array]
"""The lowest and the highest of one component in every group, each of shape [groups]."""


def box_gaps(own: list[Range], others: list[Range]) -> Float[Array, "own others"]:
    """Return all squared distances between two sets of boxes [m^2], given by their ranges along the axes."""
    squared = 0.0
    for (low, high), (other_low, other_high) in zip(own, others, strict=True):
        gap = jnp.maximum(low[:, None] - other_high[None], other_low[None] - high[:, None])
        squared = squared + jnp.square(jnp.maximum(gap, 0.0))
    return squared  # type: ignore[return-value]


def _gaps(points: Vector3, members: Vector3) -> Float[Array, "blocks patches"]:
    """Return the squared distances between the boxes around blocks and around patches [m^2]."""
    own, others = (list(zip(*_bounds(values), strict=True)) for values in (points, members))
    return box_gaps(own, others)


def _may_oppose(
    blocks: _Groups, patches: _Groups, reach: Float[Array, " patches"], least_cosine: float
) -> Bool[Array, "blocks patches"]:
    """Return which patches may hold a vertex that opposes a point of a block: bounds by intervals."""
    (low, high), (patch_low, patch_high) = _bounds(blocks.points), _bounds(patches.points)
    normal, patch_normal = _bounds(blocks.normals), _bounds(patches.normals)
    cosine, ahead = 0.0, 0.0
    for axis in range(3):
        a, b = (end[axis][:, None] for end in normal)
        c, d = (end[axis][None] for end in patch_normal)
        cosine = cosine + jnp.minimum(jnp.minimum(a * c, a * d), jnp.minimum(b * c, b * d))
        c, d = patch_low[axis][None] - high[axis][:, None], patch_high[axis][None] - low[axis][:, None]
        ahead = ahead + jnp.maximum(jnp.maximum(a * c, a * d), jnp.maximum(b * c, b * d))
    is_near = _gaps(blocks.points, patches.points) < (reach * reach)[None]
    return is_near & (cosine <= least_cosine) & (ahead >= 0.0)  # type: ignore[return-value]


def _index_mask(count: int) -> int:
    """Return the lowest bits that hold numbers below `count`."""
    return (1 << max(count - 1, 1).bit_length()) - 1


def _with_index(
    squared: Float[Array, "*shape"], index: Int[Array, "*other"], count: int
) -> Int[Array, "*shape"]:
    """Return squared distances as integers of the same order, with a number below `count` in the lowest bits."""
    bits = jax.lax.bitcast_convert_type(squared.astype(jnp.float32), jnp.int32)
    return (bits & ~_index_mask(count)) | index


def _nothing(shape: tuple[int, ...]) -> _Nearest:
    """Return that no vertex is found yet."""
    none = jnp.full(shape, _INFINITY, jnp.int32)
    return _Nearest(none, none)


def _merge(a: _Nearest, b: _Nearest) -> _Nearest:
    """Return the two nearest of four different vertices."""
    second = jnp.minimum(jnp.maximum(a.first, b.first), jnp.minimum(a.second, b.second))
    return _Nearest(jnp.minimum(a.first, b.first), second)


def _look(
    points: _Groups,
    patch: Int[Array, " pairs"],
    patches: _Patches,
    is_excluded: Exclusion | None = None,
) -> _Nearest:
    """Return the two nearest vertices of one patch for each group of points."""
    vertices = patches.vertices[patch]
    members, normals = (take3(values, patch) for values in patches.groups)
    count = patches.vertices.size
    nearest = _nothing(points.points[0].shape)
    for k in range(vertices.shape[1]):
        here, normal = (tuple(c[:, k, None] for c in values) for values in (members, normals))
        offset = sub3(points.points, here)  # type: ignore[arg-type]
        distance = _with_index(dot3(offset, offset), vertices[:, k, None], count)
        if is_excluded is not None:
            distance = jnp.where(is_excluded(points, here, normal), _INFINITY, distance)  # type: ignore[arg-type]
        nearest = _merge(nearest, _Nearest(distance, jnp.full_like(distance, _INFINITY)))
    return nearest


def _search(
    blocks: _Groups,
    patches: _Patches,
    pairs: TrueEntries,
    nearest: _Nearest,
    is_excluded: Exclusion | None = None,
) -> _Nearest:
    """Return the two nearest vertices after all pairs of a block and a patch are looked at, many at a time.

    Args:
        blocks: Query points.
        patches: Surface vertices.
        pairs: Of a block and a patch.
        nearest: What is found already, in other patches.
        is_excluded: Which candidates don't count; by default none.
    """
    size = _PAIRS * nearest.first.shape[0]

    def advance(carry):
        first, nearest = carry
        number = first + jnp.arange(size, dtype=jnp.int32)
        block, patch = pairs.find(number)
        found = _look(jax.tree.map(lambda leaf: leaf[block], blocks), patch, patches, is_excluded)
        is_pair = (number < pairs.count)[:, None]
        found = jax.tree.map(lambda leaf: jnp.where(is_pair, leaf, _INFINITY), found)
        best = nearest.first.at[block].min(found.first)
        # Whoever is not the best may be the second.
        second = jnp.minimum(nearest.second, jnp.where(nearest.first > best, nearest.first, _INFINITY))
        rest = jnp.where(found.first > best[block], found.first, found.second)
        return first + size, _Nearest(best, second.at[block].min(rest))

    start = (jnp.int32(0), nearest)
    return jax.lax.while_loop(lambda carry: carry[0] < pairs.count, advance, start)[1]


def _vertices(nearest: _Nearest, patches: _Patches) -> tuple[Int[Array, "blocks rows"], ...]:
    """Return the two vertices that are nearest to every point; the first of all where none is found."""
    return tuple(key & _index_mask(patches.vertices.size) for key in nearest)


def _nearest_around(
    points: Vector3,
    vertices: tuple[Int[Array, "blocks rows"], ...],
    body: Vector3,
    surface: BodySurface,
) -> Int[Array, "blocks rows"]:
    """Return the nearest of the faces around some surface vertices per point."""
    # What pads the table becomes face zero: one more candidate.
    around = (surface.face_incidence % surface.faces.shape[0]).astype(jnp.int32).T
    faces = jnp.concatenate([around[:, vertex] for vertex in vertices])  # [candidates, blocks, rows]
    corners = jnp.stack([c for k in range(3) for c in take3(body, surface.faces[:, k])], axis=1)
    count = faces.shape[0]

    def try_face(slot: Array, best: Int[Array, "blocks rows"]) -> Int[Array, "blocks rows"]:
        a, b, c = jnp.moveaxis(corners[faces[slot]], -1, 0).reshape(3, 3, *best.shape)
        squared, _, _ = point_triangle(points, tuple(a), tuple(b), tuple(c))
        return jnp.minimum(best, _with_index(squared, slot, count))

    # In a loop, so that all candidates are not in memory at once.
    best = jax.lax.fori_loop(0, count, try_face, jnp.full(points[0].shape, _INFINITY, jnp.int32))
    slot = jnp.minimum(best & _index_mask(count), count - 1)
    return jnp.take_along_axis(faces, slot[None], axis=0)[0]
