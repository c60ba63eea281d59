"""Which pairs may come near: all of them, found by blocks of primitives, and kept in tables of fixed size."""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from eslr_jax.contact.pairs import CHUNK, Pairs, Rows, closest, corners_of, no_pairs, over_rows, signs
from eslr_jax.contact.search import Candidates, append, test_candidates
from eslr_jax.numerics import Vector3, dot3, in_memory, sub3, true_entries
from eslr_jax.types import BodySurface, Garment


@struct.dataclass
class Primitives:
    """Vertices, faces or edges of the cloth, then of the body, in compact groups."""

    corners: Int[Array, "corners primitives"]  # vertices in the joint numbering
    areas: Float[Array, " primitives"]  # of cloth that a pair stands for [m^2]; zero where padded
    blocks: Int[Array, "blocks members"]  # the last members of a group may repeat one
    num_cloth: int = struct.field(pytree_node=False)  # groups of the cloth come first


@struct.dataclass
class Meshes:
    """Cloth and body in one numbering, cloth first."""

    vertices: Primitives
    faces: Primitives
    edges: Primitives
    rest: Vector3  # [m], on which distances at rest are measured; of the cloth, then of a body far away
    num_cloth: int = struct.field(pytree_node=False)  # vertices


def joint_meshes(garment: Garment, surface: BodySurface | None) -> Meshes:
    """Return the primitives of a garment and of the part of a body that it can reach."""
    own = garment.vertex_areas
    count = own.shape[0]
    # An edge stands for a third of its faces, as a vertex does, and a vertex has three edges of its own.
    edge_areas = (own[garment.edges[:, 0]] + own[garment.edges[:, 1]]) / 6.0
    vertex_ids = jnp.arange(count, dtype=jnp.int32)[None]
    parts = [
        (vertex_ids, own, garment.vertex_blocks),
        (garment.faces.T, garment.rest_areas, garment.face_blocks),
        (garment.edges.T, edge_areas, garment.edge_blocks),
    ]
    size = 0
    if surface is not None:
        size = surface.vertex_areas.shape[0]
        # No pair weighs less than a vertex of cloth: a needle's own area is next to nothing.
        weights = jnp.maximum(surface.vertex_areas, garment.mean_vertex_area)
        body_ids = jnp.arange(size, dtype=jnp.int32)[None]
        bodies = [
            (body_ids, weights, surface.patch_vertices),
            (surface.faces.T, jnp.ones(surface.faces.shape[0]), surface.face_blocks),
            (surface.edges.T, jnp.full(surface.edges.shape[0], jnp.inf), surface.edge_blocks),
        ]
    else:
        bodies = [None, None, None]
    primitives = [_joined(cloth, other, count) for cloth, other in zip(parts, bodies, strict=True)]
    rest = jnp.pad(garment.sewn_positions.T, ((0, 0), (0, size)))
    return Meshes(*primitives, rest=(rest[0], rest[1], rest[2]), num_cloth=count)


def _joined(cloth: tuple, body: tuple | None, num_vertices: int) -> Primitives:
    corners, areas, blocks = cloth
    if body is None:
        return Primitives(corners, areas, blocks, blocks.shape[0])
    width = max(blocks.shape[1], body[2].shape[1])
    widened = [
        jnp.pad(one, ((0, 0), (0, width - one.shape[1])), mode="edge")
        for one in (blocks, body[2] + areas.shape[0])
    ]
    return Primitives(
        jnp.concatenate([corners, body[0] + num_vertices], axis=1),
        jnp.concatenate([areas, body[1].astype(areas.dtype)]),
        jnp.concatenate(widened),
        blocks.shape[0],
    )


class Motion(NamedTuple):
    """Where vertices may be during a search: on straight ways, and in balls around the place they have got to."""

    middle: Vector3  # [m], half way
    half: Vector3  # half of the way [m]
    radius: Float[Array, " vertices"]  # of the balls [m]


class Found(NamedTuple):
    """Pairs, and how many there would have been."""

    pairs: Pairs
    most: Int[Array, ""]  # rows that the fuller table would have needed


def find_pairs(
    motion: Motion,
    meshes: Meshes,
    reach: Float[Array, ""],
    known: Found,
    is_new: Bool[Array, " vertices"],
    pieces: Int[Array, " vertices"] | None,
) -> Found:
    """Return all pairs that come within the reach of contact while their vertices move.

    Args:
        motion: Where vertices may be.
        meshes: Cloth and body.
        reach: Distance below which pairs act [m].
        known: All pairs of vertices that are not new, in tables of the size that is returned.
        is_new: Vertices whose pairs are looked for.
        pieces: Piece of every vertex of the cloth, where only cloth of different pieces may touch; None: all.
    """
    scope = (motion, meshes, reach, is_new, pieces)
    faces, num_faces = _find_kind(meshes.vertices, meshes.faces, False, known.pairs.faces, *scope)
    edges, num_edges = _find_kind(meshes.edges, meshes.edges, True, known.pairs.edges, *scope)
    return Found(Pairs(faces, edges), jnp.maximum(known.most, jnp.maximum(num_faces, num_edges)))


class _Boxes(NamedTuple):
    """Boxes along the axes around moving primitives, each with half of the reach."""

    middle: Vector3  # [m]
    half: Vector3  # half of the way [m]
    size: Vector3  # half of the sides [m]; of no size where padded


def _boxes(primitives: Primitives, motion: Motion, reach: Array) -> _Boxes:
    """Return a box around every primitive that moves with the middle of its corners."""
    count = primitives.corners.shape[0]
    radius = functools.reduce(jnp.maximum, [motion.radius[corner] for corner in primitives.corners])
    radius = jnp.where(primitives.areas > 0, radius + 0.5 * reach, -jnp.inf)
    parts = []
    for places, ways in zip(motion.middle, motion.half, strict=True):
        own, moves = ([values[corner] for corner in primitives.corners] for values in (places, ways))
        middle, half = sum(own) / count, sum(moves) / count
        away = [jnp.abs(a - middle) + jnp.abs(b - half) for a, b in zip(own, moves, strict=True)]
        parts.append((middle, half, functools.reduce(jnp.maximum, away) + radius))
    return _Boxes(*zip(*parts, strict=True))  # type: ignore[arg-type]


def _find_kind(
    first: Primitives,
    second: Primitives,
    is_edge: bool,
    known: Rows,
    motion: Motion,
    meshes: Meshes,
    reach: Array,
    is_new: Array,
    pieces: Array | None,
) -> tuple[Rows, Array]:
    own, others = (_boxes(one, motion, reach) for one in (first, second))
    has_new = [jnp.any(is_new[one.corners][:, one.blocks], axis=(0, 2)) for one in (first, second)]
    is_close = _are_close(first, second, own, others, is_edge)
    close = true_entries(is_close & (has_new[0][: is_close.shape[0], None] | has_new[1][None]))
    rows = _table(first.blocks, own)
    table = _table(second.blocks, others).transpose(2, 1, 0)  # [members, numbers, blocks]

    def words_of(group: Array, other: Array) -> Array:
        return _candidates(rows[group], other, table)

    def test(found, candidates: Candidates):
        (group, other), (row, column) = candidates.groups, candidates.members
        one, two = first.blocks[group, row], second.blocks[other, column]
        ids = jnp.concatenate([first.corners[:, one], second.corners[:, two]])
        is_pair = _may_touch(ids, is_edge, motion, meshes.num_cloth, reach, pieces)
        is_pair = is_pair & jnp.any(is_new[ids], axis=0) & candidates.is_used
        areas = first.areas[one]
        if is_edge:
            is_pair = is_pair & ((group != other) | (one < two))  # within a group, each couple once
            areas = jnp.minimum(areas, second.areas[two])
        return append(*found, (ids, areas), is_pair)

    (ids, areas), count = test_candidates(close, words_of, test, (known[:2], known.count))
    return _completed(ids, areas, jnp.minimum(count, areas.size), is_edge, meshes, reach), count


def _completed(ids: Array, areas: Array, count: Array, is_edge: bool, meshes: Meshes, reach: Array) -> Rows:
    """Return rows with their reach: at most half of the distance at rest, where both sides are cloth."""

    def add(carry, part: Rows):
        first, own, rest = carry
        p = corners_of(meshes.rest, part.ids)
        is_cloth = jnp.all(part.ids < meshes.num_cloth, axis=0)
        near = jnp.where(is_cloth, jnp.minimum(reach, 0.5 * closest(p, is_edge).distance), reach)
        own = jax.lax.dynamic_update_slice(own, near, (first,))
        if is_edge:
            squared = [dot3(one, one) for one in (sub3(p[1], p[0]), sub3(p[3], p[2]))]
            lengths = squared[0] * jnp.where(is_cloth, squared[1], squared[0])
            rest = jax.lax.dynamic_update_slice(rest, lengths, (first,))
        return first + CHUNK, own, rest

    nothing = jnp.zeros_like(areas)
    rows = Rows(ids, areas, nothing, nothing, count)
    _, own, rest = over_rows(rows, (jnp.int32(0), nothing, nothing), add)
    return rows._replace(reach=own, rest=rest)


def _are_close(
    first: Primitives, second: Primitives, own: _Boxes, others: _Boxes, is_edge: bool
) -> Bool[Array, "blocks others"]:
    """Return which groups hold primitives whose boxes meet; the body is not looked for in itself."""
    # A couple of groups of edges is looked at once; the cloth's come first.
    rows = first.blocks[: first.num_cloth] if is_edge else first.blocks
    is_close = jnp.ones((rows.shape[0], second.blocks.shape[0]), bool)
    for axis in range(3):
        low, high = _range(rows, own, axis)
        other_low, other_high = _range(second.blocks, others, axis)
        is_close = is_close & (low[:, None] <= other_high[None]) & (other_low[None] <= high[:, None])
    group, other = (jnp.arange(count) for count in is_close.shape)
    if is_edge:
        return is_close & (group[:, None] <= other[None])
    return is_close & ((group < first.num_cloth)[:, None] | (other < second.num_cloth)[None])


def _range(blocks: Int[Array, "blocks members"], boxes: _Boxes, axis: int) -> tuple[Array, Array]:
    """Return from where to where the boxes of every group reach, all the way [m]."""
    middle, spread = boxes.middle[axis], boxes.size[axis] + jnp.abs(boxes.half[axis])
    low, high = in_memory(middle - spread, middle + spread)
    return jnp.min(low[blocks], axis=1), jnp.max(high[blocks], axis=1)


def _table(blocks: Int[Array, "blocks members"], boxes: _Boxes) -> Float[Array, "blocks numbers members"]:
    """Return the boxes of the members of groups; copies have no size."""
    is_copy = jnp.pad(blocks[:, 1:] == blocks[:, :-1], ((0, 0), (1, 0)))
    sizes = [jnp.where(is_copy, -jnp.inf, part[blocks]) for part in boxes.size]
    return jnp.stack([*(part[blocks] for part in (*boxes.middle, *boxes.half)), *sizes], axis=1)


def _candidates(
    rows: Float[Array, "pairs numbers rows"], others: Int[Array, " pairs"], table: Array
) -> Int[Array, "pairs rows"]:
    """Return for every primitive of a group which members of another its box meets on the way, as bits."""

    def add_member(k: Array, words: Array) -> Array:
        member = table[k][:, others][:, :, None]
        is_met = jnp.ones(words.shape, bool)
        for axis in range(3):
            gap = jnp.abs(rows[:, axis] - member[axis]) - jnp.abs(rows[:, 3 + axis] - member[3 + axis])
            is_met = is_met & (gap < rows[:, 6 + axis] + member[6 + axis])
        return words | jnp.where(is_met, jnp.left_shift(jnp.int32(1), k), 0)

    # In a loop: XLA would gather the members anew for every row in a longer function.
    return jax.lax.fori_loop(
        0, table.shape[0], add_member, jnp.zeros((rows.shape[0], rows.shape[2]), jnp.int32)
    )


def _may_touch(
    ids: Int[Array, "corners rows"],
    is_edge: bool,
    motion: Motion,
    num_cloth: int,
    reach: Array,
    pieces: Array | None,
) -> Bool[Array, " rows"]:
    """Return which pairs may come within reach; those that share a vertex don't count."""
    p, half, side = corners_of(motion.middle, ids), corners_of(motion.half, ids), signs(is_edge)
    near = closest(p, is_edge)
    normal = tuple(part / near.distance for part in near.offset)
    # A direction that parts two primitives at both ends of straight ways parts them all the way.
    ends = []
    for sign in (1.0, -1.0):
        along = [
            s * (dot3(normal, sub3(corner, p[0])) + sign * dot3(normal, way))  # type: ignore[arg-type]
            for s, corner, way in zip(side, p, half, strict=True)
        ]
        lows = [
            functools.reduce(jnp.minimum, [a for a, t in zip(along, side, strict=True) if t == s])
            for s in (1, -1)
        ]
        ends.append(lows[0] + lows[1])
    shares_one = functools.reduce(
        jnp.logical_or, [ids[a] == ids[b] for a in range(4) for b in range(a) if side[a] != side[b]]
    )
    room = reach + balls_of(motion.radius, ids, is_edge)
    is_kept = ~shares_one & (jnp.minimum(*ends) < room)
    if pieces is not None:
        one, other = (pieces[jnp.minimum(ids[k], num_cloth - 1)] for k in (0, 3))
        is_body = jnp.any(ids >= num_cloth, axis=0)
        is_kept = is_kept & (is_body | (one != other))
    return is_kept


def balls_of(radius: Array, ids: Array, is_edge: bool) -> Float[Array, " rows"]:
    """Return the sum of the greatest radii of both sides of pairs [m]."""
    r = [radius[row] for row in ids]
    if is_edge:
        return jnp.maximum(r[0], r[1]) + jnp.maximum(r[2], r[3])
    return r[0] + jnp.maximum(jnp.maximum(r[1], r[2]), r[3])


def nearer_pairs(
    x: Vector3,
    radius: Float[Array, " vertices"],
    pairs: Pairs,
    rows: int,
    is_left_out: Bool[Array, " vertices"] | None = None,
) -> Found:
    """Return those of some pairs that may come within reach while every vertex stays within its ball around x.

    Args:
        x: Vertices by components [m].
        radius: Of the balls [m]; zero for the body.
        pairs: Of `find_pairs`.
        rows: Size of either table; static.
        is_left_out: Vertices whose pairs are left out; None: no vertex.
    """
    tables, counts = [], []
    for kind, is_edge in pairs.kinds:

        def mark(carry: tuple, part: Rows, is_edge: bool = is_edge) -> tuple:
            first, *kept = carry
            distance = closest(corners_of(x, part.ids), is_edge).distance
            is_pair = (part.areas > 0) & (distance < part.reach + balls_of(radius, part.ids, is_edge))
            if is_left_out is not None:
                is_pair = is_pair & ~jnp.any(is_left_out[part.ids], axis=0)
            return first + CHUNK, *append(*kept, (first + jnp.arange(CHUNK, dtype=jnp.int32),), is_pair)

        start = (jnp.int32(0), (jnp.zeros(rows, jnp.int32),), jnp.int32(0))
        _, (numbers,), count = over_rows(kind, start, mark)
        tables.append(_taken(kind, numbers, jnp.minimum(count, rows)))
        counts.append(count)
    return Found(Pairs(*tables), jnp.maximum(*counts))


def _taken(pairs: Rows, numbers: Int[Array, " rows"], count: Int[Array, ""]) -> Rows:
    """Return a table of the rows with these numbers, `CHUNK` at a time."""

    def take(carry):
        first, table = carry
        row = jax.lax.dynamic_slice(numbers, (first,), (CHUNK,))
        is_used = first + jnp.arange(CHUNK, dtype=jnp.int32) < count
        part = [leaf[..., row] for leaf in pairs[:4]]
        part[1] = jnp.where(is_used, part[1], 0.0)
        start = [(0,) * (leaf.ndim - 1) + (first,) for leaf in part]
        return first + CHUNK, tuple(map(jax.lax.dynamic_update_slice, table, part, start))

    nothing = no_pairs(numbers.size, pairs.areas.dtype)[:4]
    _, table = jax.lax.while_loop(lambda carry: carry[0] < count, take, (jnp.int32(0), nothing))
    return Rows(*table, count)
