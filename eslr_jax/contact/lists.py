"""Which pairs may come near: all of them, found by blocks of primitives, and kept in tables of fixed size."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from eslr_jax.contact.pairs import Pairs, Rows, closest, corners_of, over_rows, signs
from eslr_jax.contact.search import Candidates, append, test_candidates
from eslr_jax.numerics import Vector3, dot3, sub3, true_entries
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
    primitives = [_joined(cloth, body, count) for cloth, body in zip(parts, bodies, strict=True)]
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
    motion: Motion, meshes: Meshes, reach: Float[Array, ""], rows: int, pieces: Int[Array, " vertices"] | None
) -> Found:
    """Return all pairs that come within the reach of contact while their vertices move.

    Args:
        motion: Where vertices may be.
        meshes: Cloth and body.
        reach: Distance below which pairs act [m].
        rows: Size of either table; static.
        pieces: Piece of every vertex of the cloth, where only cloth of different pieces may touch; None: all.
    """
    scope = (motion, meshes, reach, rows, pieces)
    faces, num_faces = _find_kind(meshes.vertices, meshes.faces, False, *scope)
    edges, num_edges = _find_kind(meshes.edges, meshes.edges, True, *scope)
    return Found(Pairs(faces, edges), jnp.maximum(num_faces, num_edges))


class _Balls(NamedTuple):
    """Spheres around primitives."""

    middle: Vector3
    half: Vector3
    size: Float[Array, " primitives"]  # [m]


def _balls(primitives: Primitives, motion: Motion, reach: Array) -> _Balls:
    """Return balls around moving primitives, each with half of the reach; of no size where padded."""
    count = primitives.corners.shape[0]
    places, ways = (corners_of(values, primitives.corners) for values in (motion.middle, motion.half))
    middle, half = (
        tuple(sum(corner[axis] for corner in values) / count for axis in range(3))
        for values in (places, ways)
    )
    size = jnp.zeros_like(middle[0])
    for k in range(count):
        away = [sub3(places[k], middle), sub3(ways[k], half)]  # type: ignore[arg-type]
        own = sum(jnp.sqrt(dot3(one, one)) for one in away) + motion.radius[primitives.corners[k]]
        size = jnp.maximum(size, own)
    size = jnp.where(primitives.areas > 0, size + 0.5 * reach, -jnp.inf)
    return _Balls(middle, half, size)  # type: ignore[arg-type]


def _find_kind(
    first: Primitives,
    second: Primitives,
    is_edge: bool,
    motion: Motion,
    meshes: Meshes,
    reach: Array,
    rows: int,
    pieces: Array | None,
) -> tuple[Rows, Array]:
    balls = [_balls(one, motion, reach) for one in (first, second)]
    close = true_entries(_are_close(first, second, balls, is_edge))
    table = _table(second, balls[1])

    def words_of(group: Array, other: Array) -> Array:
        return _candidates(first.blocks[group], other, balls[0], table)

    def test(found, candidates: Candidates):
        (group, other), (row, column) = candidates.groups, candidates.members
        one, two = first.blocks[group, row], second.blocks[other, column]
        ids = jnp.concatenate([first.corners[:, one], second.corners[:, two]])
        is_pair = _may_touch(ids, is_edge, motion, meshes.num_cloth, reach, pieces) & candidates.is_used
        areas = first.areas[one]
        if is_edge:
            is_pair = is_pair & ((group != other) | (one < two))  # within a group, each couple once
            areas = jnp.minimum(areas, second.areas[two])
        return append(*found, (ids, areas), is_pair)

    nothing = (jnp.zeros((4, rows), jnp.int32), jnp.zeros(rows, reach.dtype))
    (ids, areas), count = test_candidates(close, words_of, test, (nothing, jnp.int32(0)))
    return _completed(ids, areas, jnp.minimum(count, rows), is_edge, meshes, reach), count


def _completed(ids: Array, areas: Array, count: Array, is_edge: bool, meshes: Meshes, reach: Array) -> Rows:
    """Return rows with their reach: at most half of the distance at rest, where both sides are cloth."""
    p = corners_of(meshes.rest, ids)
    apart = closest(p, is_edge).distance
    is_cloth = jnp.all(ids < meshes.num_cloth, axis=0)
    own = jnp.where(is_cloth, jnp.minimum(reach, 0.5 * apart), reach)
    rest = jnp.zeros_like(areas)
    if is_edge:
        lengths = [sub3(p[k + 1], p[k]) for k in (0, 2)]
        squared = [dot3(one, one) for one in lengths]
        rest = jnp.where(is_cloth, squared[0] * squared[1], squared[0] * squared[0])
    return Rows(ids, areas, own, rest, count)


def _are_close(
    first: Primitives, second: Primitives, balls: list[_Balls], is_edge: bool
) -> Bool[Array, "blocks others"]:
    """Return which groups hold primitives whose boxes meet; the body is not looked for in itself."""
    ranges = []
    for one, ball in zip((first, second), balls, strict=True):
        size = ball.size[one.blocks]
        is_real = size > 0
        axes = []
        for axis in range(3):
            middle, spread = ball.middle[axis][one.blocks], size + jnp.abs(ball.half[axis][one.blocks])
            low = jnp.min(jnp.where(is_real, middle - spread, jnp.inf), axis=1)
            high = jnp.max(jnp.where(is_real, middle + spread, -jnp.inf), axis=1)
            axes.append((low, high))
        ranges.append(axes)
    is_close = jnp.ones((first.blocks.shape[0], second.blocks.shape[0]), bool)
    for (low, high), (other_low, other_high) in zip(*ranges, strict=True):
        is_close = is_close & (low[:, None] <= other_high[None]) & (other_low[None] <= high[:, None])
    own = jnp.arange(first.blocks.shape[0]) < first.num_cloth
    others = jnp.arange(second.blocks.shape[0]) < second.num_cloth
    is_close = is_close & (own[:, None] | others[None])
    if is_edge:  # each couple of groups once; the cloth's come first
        is_close = is_close & (
            jnp.arange(first.blocks.shape[0])[:, None] <= jnp.arange(second.blocks.shape[0])[None]
        )
    return is_close


def _table(primitives: Primitives, balls: _Balls) -> Float[Array, "members numbers blocks"]:
    """Return middle, half way and size of the members of every group; copies have no size."""
    blocks = primitives.blocks
    is_copy = jnp.pad(blocks[:, 1:] == blocks[:, :-1], ((0, 0), (1, 0)))
    size = jnp.where(is_copy, -jnp.inf, balls.size[blocks])
    values = [part[blocks] for part in (*balls.middle, *balls.half)]
    return jnp.stack([*values, size]).transpose(2, 0, 1)


def _candidates(
    ids: Int[Array, "pairs rows"], others: Int[Array, " pairs"], balls: _Balls, table: Array
) -> Int[Array, "pairs rows"]:
    """Return for every primitive which members of a group its ball meets, as bits."""
    middle, half = (tuple(part[ids] for part in parts) for parts in balls[:2])
    is_copy = jnp.pad(ids[:, 1:] == ids[:, :-1], ((0, 0), (1, 0)))
    size = jnp.where(is_copy, -jnp.inf, balls.size[ids])

    def add_member(k: Array, words: Array) -> Array:
        member = table[k][:, others][:, :, None]
        offset = sub3(middle, tuple(member[:3]))  # type: ignore[arg-type]
        way = sub3(half, tuple(member[3:6]))  # type: ignore[arg-type]
        room = size + member[6] + jnp.sqrt(dot3(way, way))
        is_kept = (room > 0) & (dot3(offset, offset) < room * room)
        return words | jnp.where(is_kept, jnp.left_shift(jnp.int32(1), k), 0)

    # In a loop: XLA would gather the members anew for every row in a longer function.
    return jax.lax.fori_loop(0, table.shape[0], add_member, jnp.zeros(ids.shape, jnp.int32))


def _may_touch(
    ids: Int[Array, "corners rows"],
    is_edge: bool,
    motion: Motion,
    num_cloth: int,
    reach: Array,
    pieces: Array | None,
) -> Bool[Array, " rows"]:
    """Return which pairs may come within reach; those that share a vertex don't count."""
    half, side = corners_of(motion.half, ids), signs(is_edge)
    first, second = ([k for k in range(4) if side[k] == sign] for sign in (1, -1))
    relative, shares_one = jnp.zeros_like(half[0][0]), jnp.zeros(ids.shape[1], bool)
    for a in first:
        for b in second:
            way = sub3(half[a], half[b])
            relative = jnp.maximum(relative, dot3(way, way))
            shares_one = shares_one | (ids[a] == ids[b])
    distance = closest(corners_of(motion.middle, ids), is_edge).distance
    room = reach + jnp.sqrt(relative) + balls_of(motion.radius, ids, is_edge)
    is_kept = ~shares_one & (distance < room)
    if pieces is not None:
        one, other = (pieces[jnp.minimum(ids[k], num_cloth - 1)] for k in (first[0], second[0]))
        is_body = jnp.any(ids >= num_cloth, axis=0)
        is_kept = is_kept & (is_body | (one != other))
    return is_kept


def balls_of(radius: Array, ids: Array, is_edge: bool) -> Float[Array, " rows"]:
    """Return the sum of the greatest radii of both sides of pairs [m]."""
    r = [radius[row] for row in ids]
    if is_edge:
        return jnp.maximum(r[0], r[1]) + jnp.maximum(r[2], r[3])
    return r[0] + jnp.maximum(jnp.maximum(r[1], r[2]), r[3])


def nearer_pairs(x: Vector3, radius: Float[Array, " vertices"], pairs: Pairs, rows: int) -> Found:
    """Return those of some pairs that may come within reach while every vertex stays within its ball around x.

    Args:
        x: Vertices by components [m].
        radius: Of the balls [m]; zero for the body.
        pairs: Of `find_pairs`.
        rows: Size of either table; static.
    """
    tables, counts = [], []
    for kind, is_edge in pairs.kinds:

        def add(found: tuple, part: Rows, is_edge: bool = is_edge) -> tuple:
            distance = closest(corners_of(x, part.ids), is_edge).distance
            is_pair = (part.areas > 0) & (distance < part.reach + balls_of(radius, part.ids, is_edge))
            return append(*found, part[:4], is_pair)

        nothing = jnp.zeros(rows, x[0].dtype)
        start = ((jnp.zeros((4, rows), jnp.int32), nothing, nothing, nothing), jnp.int32(0))
        table, count = over_rows(kind, start, add)
        tables.append(Rows(*table, jnp.minimum(count, rows)))
        counts.append(count)
    return Found(Pairs(*tables), jnp.maximum(*counts))
