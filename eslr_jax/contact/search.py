"""Nearest faces of a body surface: blocks of query points against patches of the surface, by bounding boxes."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from eslr_jax.contact.triangle import point_triangle
from eslr_jax.numerics import (
    TrueEntries,
    Vector3,
    dot3,
    entries_of_words,
    sub3,
    true_entries,
    true_rows,
)
from eslr_jax.types import BodySurface

_INFINITY = 0x7F800000  # bits of the float32 infinity
_COLUMNS = 32  # patches are padded to a multiple: XLA packs bits four times as fast without a rest
_BLOCK_PAIRS = 512  # of groups looked at together; what is read of them then stays in the cache
_CANDIDATES = 1024  # that are tested exactly at a time
_FIRST = 2  # patches that every block looks into; what they hold bounds the distance to the others
_PAIRS = 4  # pairs of a block and a patch that are looked at together, times the number of blocks
_SHARE_FACING = 4  # one block in so many is searched for its opposing faces at a time

_Kept = TypeVar("_Kept")


class PosedSurface(NamedTuple):
    """A body surface at one moment."""

    positions: Float[Array, "surface_vertices 3"]  # [m]
    normals: Float[Array, "surface_vertices 3"]
    reach: Float[Array, ""] | float  # [m] within which a vertex may oppose another


class _Groups(NamedTuple):
    """Points in compact groups, the component first: what is done to all three is one kernel."""

    points: Float[Array, "3 groups members"]  # [m]
    normals: Float[Array, "3 groups members"]


class _Patches(NamedTuple):
    """Surface vertices in patches."""

    vertices: Int[Array, "patches members"]
    groups: _Groups


class _Nearest(NamedTuple):
    """The two nearest vertices so far.

    An entry holds the bits of a squared distance in float32, with the number of the vertex in the lowest bits.
    Such integers have the order of the distances, so one minimum gives the distance and the vertex.
    """

    first: Int[Array, "*shape"]
    second: Int[Array, "*shape"]


Exclusion = Callable[[_Groups, Vector3, Vector3], Bool[Array, "pairs rows"]]
"""A function of points, and of one candidate with its normal per group; returns where it does not count."""


@jax.jit  # traced once for the start of a scene and for its steps
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
    members = positions.T[:, surface.patch_vertices]
    patches = _Patches(surface.patch_vertices, _Groups(members, members))
    points = query.T[:, blocks]
    groups = _Groups(points, points)
    gaps = _gaps(_bounds(points), _bounds(members, _COLUMNS))
    keys = _with_index(gaps, jnp.arange(gaps.shape[1], dtype=jnp.int32)[None], gaps.shape[1])
    mask, key = _index_mask(keys.shape[1]), jnp.full(blocks.shape[0], -1)
    nearest = _nothing(blocks.shape)
    for _ in range(min(_FIRST, members.shape[1])):
        key = jnp.min(jnp.where(keys > key[:, None], keys, _INFINITY), axis=1)
        nearest = _merge(nearest, _look(groups, key & mask, patches))
    farthest = jnp.max(nearest.first, axis=1, keepdims=True)
    is_open = (keys > key[:, None]) & ((keys & ~mask) < farthest)
    nearest = _search(groups, patches, true_entries(is_open), nearest)
    face = _nearest_around(points, _vertices(nearest, patches), positions, surface)
    return jnp.zeros(query.shape[0], jnp.int32).at[blocks].set(face)


def nearest_vertices(
    query: Float[Array, "rows 3"], positions: Float[Array, "surface_vertices 3"], count: int
) -> Int[Array, "count rows"]:
    """Return the nearest surface vertices of every query point [m], the nearest first.

    All pairs are measured, in one matrix product. Of vertices whose distances differ by less than a thousandth
    either may come first.
    """
    origin = jnp.mean(positions, axis=0)  # near which the product loses no digits
    here, there = query - origin[None], positions - origin[None]
    squared = (
        jnp.sum(here * here, axis=1)[:, None] + jnp.sum(there * there, axis=1)[None] - 2 * here @ there.T
    )
    size = positions.shape[0]
    keys = _with_index(jnp.maximum(squared, 0.0), jnp.arange(size, dtype=jnp.int32)[None], size)
    found = [jnp.min(keys, axis=1)]
    for _ in range(count - 1):
        found.append(jnp.min(jnp.where(keys > found[-1][:, None], keys, _INFINITY), axis=1))
    return jnp.stack(found) & _index_mask(size)


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
    patches = _Patches(ids, _Groups(body.positions.T[:, ids], body.normals.T[:, ids]))
    groups = _Groups(query.T[:, blocks], facing.T[:, blocks])
    may_oppose = _may_oppose(groups, patches.groups, body.reach, least_cosine)

    def is_excluded(points: _Groups, candidate: Vector3, normal: Vector3) -> Bool[Array, "pairs rows"]:
        here, facing = tuple(points.points), tuple(points.normals)
        is_ahead = dot3(sub3(candidate, here), facing) >= 0  # type: ignore[arg-type]
        return ~(is_ahead & (dot3(normal, facing) <= least_cosine))  # type: ignore[arg-type]

    nearest = _search(groups, patches, true_entries(may_oppose), _nothing(blocks.shape), is_excluded)
    # Faces are looked for where there is a vertex: in a few blocks, some at a time.
    is_found = nearest.first < _INFINITY
    size = -(-count // _SHARE_FACING)
    order, num_found = true_rows(jnp.any(is_found, axis=1), _SHARE_FACING * size)
    order = jnp.minimum(order, count - 1)

    def locate(carry):
        first, face = carry
        rows = jax.lax.dynamic_slice(order, (first,), (size,))
        vertices = _vertices(jax.tree.map(lambda leaf: leaf[rows], nearest), patches)
        around = _nearest_around(groups.points[:, rows], vertices, body.positions, surface)
        return first + size, face.at[rows].set(around)

    start = (jnp.int32(0), jnp.zeros(blocks.shape, jnp.int32))
    _, face = jax.lax.while_loop(lambda carry: carry[0] < num_found, locate, start)
    nothing = jnp.zeros(query.shape[0], jnp.int32)
    return nothing.at[blocks].set(face), nothing.astype(bool).at[blocks].set(is_found)


class Candidates(NamedTuple):
    """Members of two groups that are to be tested exactly, some at a time."""

    groups: tuple[Int[Array, " rows"], Int[Array, " rows"]]
    members: tuple[Int[Array, " rows"], Int[Array, " rows"]]  # their places in these groups
    is_used: Bool[Array, " rows"]


def test_candidates(
    close: TrueEntries,
    words_of: Callable[[Int[Array, " pairs"], Int[Array, " pairs"]], Int[Array, "pairs members"]],
    test: Callable[[_Kept, Candidates], _Kept],
    start: _Kept,
) -> _Kept:
    """Return what is left of a start after all candidates are tested.

    Args:
        close: Pairs of groups.
        words_of: From groups and others to the candidates of their members: bit k of a word is for the other's
            member k.
        test: Takes candidates in.
        start: Before any is tested.
    """

    def look(carry):
        first, kept = carry
        number = first + jnp.arange(_BLOCK_PAIRS, dtype=jnp.int32)
        group, other = close.find(number)
        candidates = entries_of_words(jnp.where((number < close.count)[:, None], words_of(group, other), 0))

        def test_some(carry):
            first, kept = carry
            number = first + jnp.arange(_CANDIDATES, dtype=jnp.int32)
            pair, column = candidates.find(number)
            rows = Candidates(
                (group[pair], other[pair]), (column // 32, column % 32), number < candidates.count
            )
            return first + _CANDIDATES, test(kept, rows)

        return first + _BLOCK_PAIRS, jax.lax.while_loop(
            lambda carry: carry[0] < candidates.count, test_some, (jnp.int32(0), kept)
        )[1]

    return jax.lax.while_loop(lambda carry: carry[0] < close.count, look, (jnp.int32(0), start))[1]


def append(
    tables: tuple[Array, ...], count: Int[Array, ""], rows: tuple[Array, ...], is_kept: Bool[Array, " rows"]
) -> tuple[tuple[Array, ...], Int[Array, ""]]:
    """Append rows, along the last axis; those beyond the tables are counted, but not stored."""
    slot = jnp.where(is_kept, count + jnp.cumsum(is_kept, dtype=jnp.int32) - 1, tables[0].shape[-1])
    tables = tuple(old.at[..., slot].set(new, mode="drop") for old, new in zip(tables, rows, strict=True))
    return tables, count + jnp.sum(is_kept, dtype=jnp.int32)


class _Boxes(NamedTuple):
    """The lowest and the highest of every component within groups."""

    low: Float[Array, "3 groups"]
    high: Float[Array, "3 groups"]


def _bounds(values: Float[Array, "3 groups members"], multiple: int = 1) -> _Boxes:
    """Return the boxes of groups, and empty ones up to a multiple of their number, infinitely far from any."""
    more = ((0, 0), (0, -values.shape[1] % multiple))
    low = jnp.pad(jnp.min(values, axis=2), more, constant_values=jnp.inf)
    return _Boxes(low, jnp.pad(jnp.max(values, axis=2), more, constant_values=-jnp.inf))


def _gaps(blocks: _Boxes, patches: _Boxes) -> Float[Array, "blocks patches"]:
    """Return the squared distances between the boxes around blocks and around patches [m^2]."""
    squared = 0.0
    for low, high, other_low, other_high in zip(*blocks, *patches, strict=True):
        gap = jnp.maximum(low[:, None] - other_high[None], other_low[None] - high[:, None])
        squared = squared + jnp.square(jnp.maximum(gap, 0.0))
    return squared  # type: ignore[return-value]


def _may_oppose(
    blocks: _Groups, patches: _Groups, reach: Float[Array, ""] | float, least_cosine: float
) -> Bool[Array, "blocks columns"]:
    """Return which patches may hold a vertex that opposes a point of a block: bounds by intervals.

    The columns beyond the patches are false.
    """
    box, patch_box = _bounds(blocks.points), _bounds(patches.points, _COLUMNS)
    normal, patch_normal = _bounds(blocks.normals), _bounds(patches.normals, _COLUMNS)
    cosine, ahead = 0.0, 0.0
    for axis in range(3):
        a, b = (end[axis][:, None] for end in normal)
        c, d = (end[axis][None] for end in patch_normal)
        cosine = cosine + jnp.minimum(jnp.minimum(a * c, a * d), jnp.minimum(b * c, b * d))
        c = patch_box.low[axis][None] - box.high[axis][:, None]
        d = patch_box.high[axis][None] - box.low[axis][:, None]
        ahead = ahead + jnp.maximum(jnp.maximum(a * c, a * d), jnp.maximum(b * c, b * d))
    is_near = _gaps(box, patch_box) < reach**2
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


@partial(jax.jit, static_argnames="is_excluded")  # traced once for both first patches, and anew for a search
def _look(
    points: _Groups,
    patch: Int[Array, " pairs"],
    patches: _Patches,
    is_excluded: Exclusion | None = None,
) -> _Nearest:
    """Return the two nearest vertices of one patch for each group of points."""
    vertices = patches.vertices[patch]
    members, normals = (values[:, patch] for values in patches.groups)
    count = patches.vertices.size
    nearest = _nothing(points.points.shape[1:])
    for k in range(vertices.shape[1]):
        here, normal = (tuple(c[:, k, None] for c in values) for values in (members, normals))
        offset = sub3(tuple(points.points), here)  # type: ignore[arg-type]
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
        found = _look(jax.tree.map(lambda leaf: leaf[:, block], blocks), patch, patches, is_excluded)
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
    points: Float[Array, "3 blocks rows"],
    vertices: tuple[Int[Array, "blocks rows"], ...],
    positions: Float[Array, "surface_vertices 3"],
    surface: BodySurface,
) -> Int[Array, "blocks rows"]:
    """Return the nearest of the faces around some surface vertices per point."""
    corners = face_corners(positions, surface.faces)
    return nearest_face_around(tuple(points), vertices, corners, surface.face_incidence)  # type: ignore[arg-type]


def face_corners(
    positions: Float[Array, "vertices 3"], faces: Int[Array, "faces 3"]
) -> Float[Array, "faces 9"]:
    """Return the corners of every face, one after another: a row of nine is one read."""
    return positions[faces].reshape(-1, 9)


def nearest_face_around(
    points: Vector3,
    vertices: tuple[Int[Array, "*shape"], ...],
    corners: Float[Array, "faces 9"],
    face_incidence: Int[Array, "vertices degree"],
) -> Int[Array, "*shape"]:
    """Return the nearest of the faces around some vertices of a mesh per point, or face zero.

    Args:
        points: By components, each of any shape.
        vertices: One or more for every point.
        corners: Of `face_corners` [m].
        face_incidence: Of the mesh, see `numerics.gather_corners`.
    """
    # What pads the table becomes face zero: one more candidate.
    around = (face_incidence % corners.shape[0]).astype(jnp.int32).T
    faces = jnp.concatenate([around[:, vertex] for vertex in vertices])  # [candidates, *shape]
    count = faces.shape[0]

    def try_face(slot: Array, best: Int[Array, "*shape"]) -> Int[Array, "*shape"]:
        a, b, c = jnp.moveaxis(corners[faces[slot]], -1, 0).reshape(3, 3, *best.shape)
        squared, _, _ = point_triangle(points, tuple(a), tuple(b), tuple(c))
        return jnp.minimum(best, _with_index(squared, slot, count))

    # In a loop, so that all candidates are not in memory at once.
    best = jax.lax.fori_loop(0, count, try_face, jnp.full(points[0].shape, _INFINITY, jnp.int32))
    return _chosen(faces, best)


def _chosen(candidates: Int[Array, "candidates ..."], best: Int[Array, "*shape"]) -> Int[Array, "*shape"]:
    """Return the candidates whose slots stand in the lowest bits; the first where none was found."""
    count = candidates.shape[0]
    slot = jnp.minimum(best & _index_mask(count), count - 1)
    return jnp.take_along_axis(candidates, slot[None], axis=0)[0]
