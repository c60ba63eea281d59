"""Which pairs may meet on the way: all of them, found by blocks of primitives, in tables of fixed size."""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from eslr_jax.contact.pairs import GAP, Pairs, Rows, closest, corners_of, gap_along, signs
from eslr_jax.contact.search import Candidates, append, test_candidates
from eslr_jax.numerics import TrueEntries, Vector3, entries_where, in_memory
from eslr_jax.types import BodySurface, Garment

_NUMBERS = 9  # of a box


@struct.dataclass
class Primitives:
    """Vertices, faces or edges of the cloth, then of the body, in compact groups."""

    corners: Int[Array, "corners primitives"]  # vertices in the joint numbering
    is_real: Bool[Array, " primitives"]  # not padded
    blocks: Int[Array, "blocks members"]  # the last members of a group may repeat one
    num_cloth: int = struct.field(pytree_node=False)  # groups of the cloth come first


@struct.dataclass
class Meshes:
    """Cloth and body in one numbering, cloth first."""

    vertices: Primitives
    faces: Primitives
    edges: Primitives
    has_layers: bool = struct.field(pytree_node=False)  # cloth meets cloth


def joint_meshes(garment: Garment, surface: BodySurface | None, *, has_layers: bool = True) -> Meshes:
    """Return the primitives of a garment and of the part of a body that it can reach."""
    count = garment.vertex_areas.shape[0]
    vertex_ids = jnp.arange(count, dtype=jnp.int32)[None]
    is_real = garment.vertex_mask
    parts = [
        (vertex_ids, is_real, garment.vertex_blocks),
        (garment.faces.T, garment.rest_areas > 0, garment.face_blocks),
        (garment.edges.T, is_real[garment.edges[:, 0]] & is_real[garment.edges[:, 1]], garment.edge_blocks),
    ]
    bodies = [None, None, None]
    if surface is not None:
        body_ids = jnp.arange(surface.vertex_areas.shape[0], dtype=jnp.int32)[None]
        bodies = [
            (body_ids, surface.patch_vertices),
            (surface.faces.T, surface.face_blocks),
            (surface.edges.T, surface.edge_blocks),
        ]
    primitives = [_joined(cloth, other, count) for cloth, other in zip(parts, bodies, strict=True)]
    return Meshes(*primitives, has_layers=has_layers)


def without_body_faces(meshes: Meshes) -> Meshes:
    """Return meshes in which nothing is over a face of the body."""
    faces, count = meshes.faces, meshes.faces.num_cloth
    return meshes.replace(faces=faces.replace(blocks=faces.blocks[:count]))  # type: ignore[attr-defined]


def _joined(cloth: tuple, body: tuple | None, num_vertices: int) -> Primitives:
    corners, is_real, blocks = cloth
    if body is None:
        return Primitives(corners, is_real, blocks, blocks.shape[0])
    own, others = body
    width = max(blocks.shape[1], others.shape[1])
    widened = [
        jnp.pad(one, ((0, 0), (0, width - one.shape[1])), mode="edge")
        for one in (blocks, others + corners.shape[1])
    ]
    return Primitives(
        jnp.concatenate([corners, own + num_vertices], axis=1),
        jnp.pad(is_real, (0, own.shape[1]), constant_values=True),
        jnp.concatenate(widened),
        blocks.shape[0],
    )


class Motion(NamedTuple):
    """Straight ways of vertices, and how far the ends may be off."""

    middle: Vector3  # [m], half way
    half: Vector3  # half of the way [m]
    radius: Float[Array, " vertices"]  # of balls around places on the way [m]


class Found(NamedTuple):
    """Pairs, and how many there would have been."""

    pairs: Pairs
    most: Int[Array, ""]  # rows that the fuller table would have needed


def find_pairs(motion: Motion, meshes: Meshes, rows: int) -> Found:
    """Return all pairs that come within `GAP` while their vertices move; those of the body alone don't count.

    Args:
        motion: Of the vertices.
        meshes: Cloth and body.
        rows: Size of either table; static.
    """
    faces = _find_kind(meshes.vertices, meshes.faces, False, motion, meshes.has_layers, rows)
    edges = _find_kind(meshes.edges, meshes.edges, True, motion, meshes.has_layers, rows)
    counts = faces.count, edges.count
    tables = (table._replace(count=jnp.minimum(table.count, rows)) for table in (faces, edges))
    return Found(Pairs(*tables), jnp.maximum(*counts))


class _Boxes(NamedTuple):
    """Boxes along the axes around moving primitives, each with half of the gap."""

    middle: Vector3  # [m]
    half: Vector3  # half of the way [m]
    size: Vector3  # half of the sides [m]; of no size where padded


def _boxes(primitives: Primitives, motion: Motion) -> _Boxes:
    """Return a box around every primitive that moves with the middle of its corners."""
    count = primitives.corners.shape[0]
    radius = functools.reduce(jnp.maximum, [motion.radius[corner] for corner in primitives.corners])
    radius = jnp.where(primitives.is_real, radius + 0.5 * GAP, -jnp.inf)
    parts = []
    for places, ways in zip(motion.middle, motion.half, strict=True):
        own, moves = ([values[corner] for corner in primitives.corners] for values in (places, ways))
        middle, half = sum(own) / count, sum(moves) / count
        away = [jnp.abs(a - middle) + jnp.abs(b - half) for a, b in zip(own, moves, strict=True)]
        parts.append((middle, half, functools.reduce(jnp.maximum, away) + radius))
    return _Boxes(*zip(*parts, strict=True))  # type: ignore[arg-type]


def _find_kind(
    first: Primitives, second: Primitives, is_edge: bool, motion: Motion, has_layers: bool, rows: int
) -> Rows:
    """Return pairs of one kind, and how many there are, which may be more than the rows."""
    own, others = (_boxes(one, motion) for one in (first, second))
    close = _close_groups(first, second, own, others, is_edge, has_layers)
    members = _table(first, own)
    table = _table(second, others).transpose(2, 1, 0)  # [members, numbers, blocks]

    def words_of(group: Array, other: Array) -> Array:
        words = _candidates(members[group], other, table)
        if not is_edge:
            return words
        # Within a group, each couple once: of row i the bits above i.
        later = jnp.left_shift(jnp.int32(-2), jnp.arange(words.shape[1], dtype=jnp.int32))
        return words & jnp.where((group == other)[:, None], later, -1)

    def test(found, candidates: Candidates):
        (group, other), (row, column) = candidates.groups, candidates.members
        one, two = first.blocks[group, row], second.blocks[other, column]
        ids = jnp.concatenate([first.corners[:, one], second.corners[:, two]])
        return append(*found, (ids,), _may_meet(ids, is_edge, motion) & candidates.is_used)

    nothing = jnp.zeros((4, rows), jnp.int32)
    (ids,), count = test_candidates(close, words_of, test, ((nothing,), jnp.int32(0)))
    return Rows(ids, count)


def _close_groups(
    first: Primitives, second: Primitives, own: _Boxes, others: _Boxes, is_edge: bool, has_layers: bool
) -> TrueEntries:
    """Return which groups hold primitives whose boxes meet; the body is not looked for in itself."""
    # A couple of groups of edges is looked at once; the cloth's come first.
    rows = first.blocks[: first.num_cloth] if is_edge else first.blocks
    ranges, other_ranges = in_memory(_ranges(rows, own), _ranges(second.blocks, others))
    group = jnp.arange(len(rows), dtype=jnp.int32)[None]

    def are_close(other: Int[Array, " words"]) -> Bool[Array, "words groups"]:
        (near,) = in_memory(other_ranges[:, other])
        overlaps = [ranges[k][None] + near[k - 3][:, None] >= 0 for k in range(6)]
        is_first, is_second = group < first.num_cloth, (other < second.num_cloth)[:, None]
        overlaps.append((is_first | is_second) if has_layers else (is_first != is_second))
        if is_edge:
            overlaps.append(group <= other[:, None])
        return functools.reduce(jnp.logical_and, overlaps)

    return entries_where(are_close, len(rows), len(second.blocks))


def _ranges(blocks: Int[Array, "blocks members"], boxes: _Boxes) -> Float[Array, "6 blocks"]:
    """Return how far the boxes of every group reach, all the way [m]: down and up the three axes."""
    spread = [size + jnp.abs(half) for half, size in zip(boxes.half, boxes.size, strict=True)]
    ends = [sign * x + away for sign in (-1, 1) for x, away in zip(boxes.middle, spread, strict=True)]
    # All in one: XLA computes maxima anew for every couple of groups where each has its own array, in 60 times
    # the time.
    return jnp.max(jnp.stack(ends)[:, blocks], axis=2)


def _table(primitives: Primitives, boxes: _Boxes) -> Float[Array, "blocks numbers members"]:
    """Return the boxes of the members of groups, with their corners behind them; copies have no size."""
    blocks = primitives.blocks
    is_copy = jnp.pad(blocks[:, 1:] == blocks[:, :-1], ((0, 0), (1, 0)))
    sizes = [jnp.where(is_copy, -jnp.inf, part[blocks]) for part in boxes.size]
    places = [part[blocks] for part in (*boxes.middle, *boxes.half)]
    corners = [corner[blocks].astype(places[0].dtype) for corner in primitives.corners]  # exact below 2^24
    return jnp.stack([*places, *sizes, *corners], axis=1)


def _candidates(
    rows: Float[Array, "pairs numbers rows"], others: Int[Array, " pairs"], table: Array
) -> Int[Array, "pairs rows"]:
    """Return for every primitive of a group which members of another its box meets on the way, as bits.

    Those with which it shares a vertex don't count.
    """

    def add_member(k: Array, words: Array) -> Array:
        member = table[k][:, others][:, :, None]
        is_met = jnp.ones(words.shape, bool)
        for axis in range(3):
            gap = jnp.abs(rows[:, axis] - member[axis]) - jnp.abs(rows[:, 3 + axis] - member[3 + axis])
            is_met = is_met & (gap < rows[:, 6 + axis] + member[6 + axis])
        for own in range(_NUMBERS, rows.shape[1]):
            for other in range(_NUMBERS, member.shape[0]):
                is_met = is_met & (rows[:, own] != member[other])
        return words | jnp.where(is_met, jnp.left_shift(jnp.int32(1), k), 0)

    # In a loop: XLA would gather the members anew for every row in a longer function.
    return jax.lax.fori_loop(
        0, table.shape[0], add_member, jnp.zeros((rows.shape[0], rows.shape[2]), jnp.int32)
    )


def _may_meet(ids: Int[Array, "corners rows"], is_edge: bool, motion: Motion) -> Bool[Array, " rows"]:
    """Return which pairs the normal half way does not part all the way."""
    p, half, side = corners_of(motion.middle, ids), corners_of(motion.half, ids), signs(is_edge)
    near = closest(p, is_edge)
    ends = [
        tuple(tuple(a + sign * b for a, b in zip(*one, strict=True)) for one in zip(p, half, strict=True))
        for sign in (-1.0, 1.0)
    ]
    gap = jnp.minimum(*(gap_along(near.normal, corners, side) for corners in ends))  # type: ignore[arg-type]
    balls = [
        functools.reduce(jnp.maximum, [motion.radius[ids[k]] for k in range(4) if side[k] == s])
        for s in (1, -1)
    ]
    return gap < GAP + balls[0] + balls[1]
