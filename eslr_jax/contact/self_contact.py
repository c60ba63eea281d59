"""Where points come close to faces of cloth: pairs of fixed capacity, found by blocks of points and of faces."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from eslr_jax.contact.crossing import sides_where_crossed
from eslr_jax.contact.search import Candidates, append, box_gaps, test_candidates
from eslr_jax.contact.triangle import point_triangle
from eslr_jax.errors import Status
from eslr_jax.numerics import (
    Vector3,
    cross3,
    dot3,
    safe_norm,
    safe_normalize,
    sub3,
    true_entries,
)
from eslr_jax.types import Garment

TIP_RADIUS = 0.06  # [m] within which vertices of a body with tips are paired with the cloth
# [m] within which layers are paired: they may approach by this much in a frame. At 0.02 the walls of a pleat that
# closes at a metre a second were not paired and passed through each other (hard case `layers`).
SEARCH_RADIUS = 0.04
# [m] within which a pair is kept even if it doesn't seem to approach. With ContourCraft's 0.01 the walls of fast
# folds, which the inertial guess sees moving apart, passed through each other: `layers` of the hard cases.
_NEAR = 0.02
_MIN_COSINE = 0.8  # between a pair's direction and the face normal; beside a hem there is nothing to hit
_MAX_SLOPE = 0.75  # the same as sideways distance over height: sin / cos
_REST_RADIUS = 0.02  # [m]; within it, topological neighbours are no pairs
_SLACK = 1e-5  # [m] by which the cheap test is wider than the exact one: rounding
PAIRS_PER_VERTEX = 8  # rows per vertex, enough for all cloth in the hard cases, which needs at most 6.9
_FEWEST_PAIRS = 64  # least number of rows of the first buffer
_BEGINNING = 8  # vertices per row of the first buffer; a walking T-shirt has a pair per 20 to 130 vertices
_PIECES_BEGINNING = 2  # the same for several pieces; a skirt over trousers has a pair per 2.6 vertices
PAIRS_PER_TIP = 12  # rows per vertex of cloth and body for tips; cloth bunched around a needle needed 8.3


@struct.dataclass
class FacePairs:
    """Pairs of a point and a face of the cloth that are close at t.

    The points are the cloth's own vertices, or vertices of the body. A row that is not used has `side` zero,
    and names the last point and the last vertex.
    """

    vertices: Int[Array, " pairs"]  # the points' rows
    corners: Int[Array, "pairs 3"]  # vertices of the face
    weights: Float[Array, "pairs 3"]  # barycentric, of the place on the face nearest to the point at t
    side: Float[Array, " pairs"]  # 1 where the point is kept on the side of the face's normal, -1 behind
    areas: Float[Array, " pairs"]  # of cloth that the point stands for [m^2]
    count: Int[Array, ""]  # pairs found, which may be more than there are rows
    status: Int[Array, ""]  # Status.SELF_CONTACT_OVERFLOW if a capacity was too small


@struct.dataclass
class TipPairs:
    """Pairs of a vertex of the body, a tip, and a face of the cloth that are close at t.

    A row that is not used has `side` zero.
    """

    next_points: Float[Array, "pairs 3"]  # the tips at t + 1 [m]
    corners: Int[Array, "pairs 3"]  # vertices of the face
    # Of the corners, in the offset from the place on the face: as of `FacePairs`, but negative.
    weights: Float[Array, "pairs 3"]
    side: Float[Array, " pairs"]  # as of `FacePairs`
    areas: Float[Array, " pairs"]  # [m^2]
    status: Int[Array, ""]  # Status.TIP_OVERFLOW if there was too little room


def default_rows(num_vertices: int) -> int:
    """Return the size of a buffer that holds the self-contact of nearly any garment of so many vertices."""
    return PAIRS_PER_VERTEX * num_vertices


def starting_rows(num_vertices: int, pieces: int = 1) -> int:
    """Return the size of a small buffer, for those who enlarge it where it overflows: every row costs time.

    Args:
        num_vertices: Of the garment.
        pieces: Pieces of cloth that it consists of.
    """
    share = _BEGINNING if pieces == 1 else _PIECES_BEGINNING
    return max(num_vertices // share, _FEWEST_PAIRS)


def find_self_contacts(
    position: Float[Array, "vertices 3"],
    predicted: Float[Array, "vertices 3"],
    garment: Garment,
    capacity: int,
    *,
    pieces: Int[Array, " vertices"] | None = None,
    radius: float = SEARCH_RADIUS,
) -> FacePairs:
    """Pair every vertex with the faces of the same cloth that it could touch during the frame.

    A pair is closer than `radius` at t, and closer than two centimetres at t or at the prediction. The vertex
    must stand over the face rather than beside it. Which side it is on is decided at t, and in the rest mesh
    where the two pass through each other at t. Faces around the vertex are no pairs: those that hold it, and
    those within two edges of it that are also within 2 cm in the rest mesh.

    Args:
        position: Vertices at t [m], shape [vertices, 3].
        predicted: A guess of the vertices at t + 1 [m], such as the inertial one, shape [vertices, 3].
        garment: Rest mesh.
        capacity: Rows of the buffer; static.
        pieces: Piece of every vertex: only cloth of different pieces is paired; None: all cloth is.
        radius: Radius of the search [m].
    """
    blocks = garment.vertex_blocks
    ends = _ends(position, predicted)
    points = _Points(ends, garment.vertex_mask, garment.vertex_areas, blocks)
    cloth = _Cloth(ends, garment, has_points=True, pieces=pieces)
    pairs = _find_pairs(points, cloth, radius, capacity)
    rows = (pairs.vertices, pairs.corners, pairs.weights)
    return pairs.replace(side=sides_where_crossed(position, rows, pairs.side, garment))


def find_tip_contacts(
    position: Float[Array, "vertices 3"],
    predicted: Float[Array, "vertices 3"],
    body: Float[Array, "surface_vertices 3"],
    next_body: Float[Array, "surface_vertices 3"],
    blocks: Int[Array, "blocks rows"],
    garment: Garment,
) -> TipPairs:
    """Pair every body vertex with the faces of the cloth that it could touch during the frame.

    Contacts of the cloth's vertices miss a tip that is finer than the cloth's mesh. So the body's vertices are
    paired with faces of the cloth.

    Args:
        position: Cloth vertices at t [m], shape [vertices, 3].
        predicted: A guess of the cloth vertices at t + 1 [m], shape [vertices, 3].
        body: Body vertices at t [m], shape [surface_vertices, 3].
        next_body: Body vertices at t + 1 [m], shape [surface_vertices, 3].
        blocks: Compact groups of body vertices, as in `BodySurface.patch_vertices`.
        garment: Rest mesh.
    """
    count = body.shape[0]
    capacity = PAIRS_PER_TIP * (position.shape[0] + count)
    areas = jnp.full(count, garment.mean_vertex_area)
    points = _Points(_ends(body, next_body), jnp.ones(count, bool), areas, blocks)
    cloth = _Cloth(_ends(position, predicted), garment, has_points=False)
    faces = _find_pairs(points, cloth, TIP_RADIUS, capacity)
    next_points = next_body[faces.vertices]
    status = jnp.where(faces.status == int(Status.OK), int(Status.OK), int(Status.TIP_OVERFLOW))
    return TipPairs(next_points, faces.corners, -faces.weights, faces.side, faces.areas, status)


def _ends(
    position: Float[Array, "vertices 3"], predicted: Float[Array, "vertices 3"]
) -> Float[Array, "ends 3 vertices"]:
    """Return positions at t and at t + 1 by components, in one array: every gather of it is one kernel."""
    return jnp.stack([position.T, predicted.T])


class _Points(NamedTuple):
    """What is paired with the faces of the cloth."""

    ends: Float[Array, "ends 3 points"]  # at t and at t + 1 [m]
    mask: Bool[Array, " points"]
    areas: Float[Array, " points"]  # of cloth [m^2]
    blocks: Int[Array, "blocks rows"]  # compact groups of points


class _Cloth(NamedTuple):
    """Whose faces the points are paired with."""

    ends: Float[Array, "ends 3 vertices"]  # at t and at t + 1 [m]
    garment: Garment
    has_points: bool  # the points are the vertices of the faces
    pieces: Int[Array, " vertices"] | None = None  # only cloth of different pieces is paired


class _FaceTable(NamedTuple):
    """What the cheap test reads of the faces in their blocks, member by member."""

    # Planes x, y, z, offset: of the face at t, of the face at t + 1, and of its three sides, upright on the face
    # and positive inside. Shape [members, 5, 4, face_blocks], in metres.
    planes: Float[Array, "members planes numbers face_blocks"]
    corners: Int[Array, "members corners face_blocks"]


def _find_pairs(points: _Points, cloth: _Cloth, radius: float, capacity: int) -> FacePairs:
    """Return pairs of points and faces; see `find_self_contacts`."""
    # The choice of pairs has no derivative; their places on the faces have one.
    still = cloth._replace(ends=jax.lax.stop_gradient(cloth.ends))
    point, face, count = _search(jax.lax.stop_gradient(points), still, radius, capacity)
    pairs = _exactly(point, face, points, cloth, radius)
    is_used = jnp.arange(capacity) < count
    is_full = count > capacity
    return pairs.replace(
        vertices=jnp.where(is_used, point, points.ends.shape[2] - 1),
        corners=jnp.where(is_used[:, None], pairs.corners, cloth.ends.shape[2] - 1),
        weights=jnp.where(is_used[:, None], pairs.weights, 1.0 / 3.0),
        side=jnp.where(is_used, pairs.side, 0.0),
        areas=jnp.where(is_used, pairs.areas, 0.0),
        count=count,
        status=jnp.where(is_full, jnp.int32(Status.SELF_CONTACT_OVERFLOW), jnp.int32(Status.OK)),
    )


def _search(
    points: _Points, cloth: _Cloth, radius: float, capacity: int
) -> tuple[Int[Array, " pairs"], Int[Array, " pairs"], Int[Array, ""]]:
    """Return points and faces of the pairs, and their number, which may be more than there are rows.

    Three tests narrow the pairs down: boxes around blocks of points against boxes around blocks of faces; every
    point against every face of two such blocks, by a cheap test that misses no pair; and an exact test.
    """
    garment = cloth.garment
    table = _face_table(cloth)
    boxes = true_entries(_are_close(points, cloth, radius))

    def words_of(block: Array, faces: Array) -> Array:
        return _candidates(points.blocks[block], faces, points, table, (radius, cloth.has_points))

    def test(found, rows: Candidates):
        point = points.blocks[rows.groups[0], rows.members[0]]
        face = garment.face_blocks[rows.groups[1], rows.members[1]]
        side = _exactly(point, face, points, cloth, radius).side
        return append(*found, (point, face), (side != 0) & rows.is_used)

    nobody = jnp.zeros(capacity, jnp.int32)
    (point, face), count = test_candidates(boxes, words_of, test, ((nobody, nobody), jnp.int32(0)))
    return point, face, count


def _are_close(points: _Points, cloth: _Cloth, radius: float) -> Bool[Array, "blocks face_blocks"]:
    """Return which blocks of points and of faces have boxes closer than the radius."""
    garment = cloth.garment
    is_real = (garment.rest_areas > 0)[garment.face_blocks]
    is_point = points.mask[points.blocks]
    corners = jnp.moveaxis(garment.faces[garment.face_blocks], 2, 0)  # [3, face_blocks, members]
    at, values = points.ends[0][:, points.blocks], cloth.ends[0][:, corners]
    own = _range(at, at, is_point)
    others = _range(values.min(1), values.max(1), is_real)
    return box_gaps(own, others) < radius**2


def _range(
    low: Float[Array, "3 blocks members"],
    high: Float[Array, "3 blocks members"],
    is_real: Bool[Array, "blocks members"],
) -> list[tuple[Array, Array]]:
    """Return the least and the greatest of the real members of every block, axis by axis."""
    least, most = jnp.where(is_real, low, jnp.inf).min(2), jnp.where(is_real, high, -jnp.inf).max(2)
    return list(zip(least, most, strict=True))


def _face_table(cloth: _Cloth) -> _FaceTable:
    """Return the planes of every face; none is within reach of faces without area, nor of copies in a block."""
    garment = cloth.garment

    def plane(normal: Array, through: Array) -> Array:
        return jnp.concatenate([normal, jnp.sum(normal * through, axis=0, keepdims=True)])

    here, ahead = jnp.moveaxis(cloth.ends[:, :, garment.faces.T], 2, 1)  # by corners and components

    def upright(corners: Array) -> Array:
        return safe_normalize(jnp.cross(corners[1] - corners[0], corners[2] - corners[0], axis=0), axis=0)

    normal = upright(here)
    own = plane(normal, here[0])
    is_flat = (garment.rest_areas <= 0) | (jnp.sum(normal * normal, axis=0) == 0)
    planes = [own.at[3].set(jnp.where(is_flat, jnp.inf, own[3])), plane(upright(ahead), ahead[0])]
    for k in range(3):
        inwards = jnp.cross(normal, here[(k + 1) % 3] - here[k], axis=0)
        planes.append(plane(safe_normalize(inwards, axis=0), here[k]))
    blocks = garment.face_blocks.T
    in_blocks = jnp.moveaxis(jnp.stack(planes)[:, :, blocks], 2, 0)
    offset = jnp.where(_is_copy(garment.face_blocks).T, jnp.inf, in_blocks[:, 0, 3])
    in_blocks = in_blocks.at[:, 0, 3].set(offset)
    return _FaceTable(in_blocks, jnp.moveaxis(garment.faces.T[:, blocks], 1, 0))


def _is_copy(groups: Int[Array, "groups members"]) -> Bool[Array, "groups members"]:
    """Return which members repeat the one before, as in the last group of `compact_groups` if it is not full."""
    return jnp.pad(groups[:, 1:] == groups[:, :-1], ((0, 0), (1, 0)))


def _candidates(
    ids: Int[Array, "pairs rows"],
    faces: Int[Array, " pairs"],
    points: _Points,
    table: _FaceTable,
    scope: tuple[float, bool],
) -> Int[Array, "pairs rows"]:
    """Return for every point which faces of a block may be its partners, as bits.

    A partner is a face that the point lies over, or misses sideways by at most `_MAX_SLOPE` times its height. The
    point is near at t or at the prediction, and not a corner of the face.

    Args:
        ids: Points.
        faces: A block of faces for each row of points.
        points: Where they are.
        table: Of the faces.
        scope: Radius of the search [m], and whether the points are vertices of the faces.
    """
    radius, has_points = scope
    at, ahead = (tuple(end) for end in points.ends[:, :, ids])
    is_point = points.mask[ids] & ~_is_copy(ids)

    def add_member(k: Array, words: Int[Array, "pairs rows"]) -> Int[Array, "pairs rows"]:
        planes, corners = table.planes[k][..., faces], table.corners[k][:, faces]

        def height(number: int, point: Vector3) -> Array:
            x, y, z, offset = planes[number][:, :, None]
            return dot3(point, (x, y, z)) - offset

        now = height(0, at)
        size = jnp.abs(now)
        later = jnp.where(now < 0, -1.0, 1.0) * height(1, ahead)
        is_kept = is_point & (size < radius + _SLACK)
        is_kept = is_kept & ((size < _NEAR + _SLACK) | (later < _NEAR + _SLACK))
        for side in (2, 3, 4):
            is_kept = is_kept & (height(side, at) >= -_MAX_SLOPE * size - _SLACK)
        if has_points:
            for corner in corners:
                is_kept = is_kept & (corner[:, None] != ids)
        return words | jnp.where(is_kept, jnp.left_shift(jnp.int32(1), k), 0)

    # In a loop: XLA would gather the planes anew for every point in a longer function.
    members = table.planes.shape[0]
    return jax.lax.fori_loop(0, members, add_member, jnp.zeros(ids.shape, jnp.int32))


def _exactly(
    point: Int[Array, " rows"], face: Int[Array, " rows"], points: _Points, cloth: _Cloth, radius: float
) -> FacePairs:
    """Return candidates with the place on the face and the side; the side is zero where they are no pair."""
    garment = cloth.garment
    corner = garment.faces[face]
    here, ahead = (tuple(end) for end in points.ends[:, :, point])
    a_b_c, moved = ([tuple(place) for place in end] for end in jnp.moveaxis(cloth.ends[:, :, corner.T], 2, 1))
    squared, u, v = point_triangle(here, *a_b_c)
    weights = (1.0 - u - v, u, v)
    height, size = _height(here, a_b_c, weights)
    predicted_height, _ = _height(ahead, moved, weights)
    side = jnp.where(height < 0, -1.0, 1.0).astype(squared.dtype)
    is_over = jnp.abs(height) >= _MIN_COSINE * jnp.sqrt(squared)
    is_reached = (squared < _NEAR**2) | (side * predicted_height < _NEAR)
    is_pair = (squared < jnp.square(radius)) & is_over & is_reached & (size > 0)
    if cloth.has_points:
        is_pair = is_pair & ~_is_around(point, corner, garment)
    if cloth.pieces is not None:
        is_pair = is_pair & (cloth.pieces[point] != cloth.pieces[corner[:, 0]])
    return FacePairs(
        vertices=point,
        corners=corner,
        weights=jnp.stack(weights, axis=-1),
        side=jnp.where(is_pair, side, 0.0),
        areas=points.areas[point],
        count=jnp.int32(0),
        status=jnp.int32(Status.OK),
    )


def _height(point: Vector3, corners, weights) -> tuple[Array, Array]:
    """Return a point's height over its foot on a face, along the normal [m], and twice the area [m^2]."""
    normal = cross3(sub3(corners[1], corners[0]), sub3(corners[2], corners[0]))
    size = safe_norm(jnp.stack(normal, axis=-1))
    foot = tuple(sum(w * corner[k] for w, corner in zip(weights, corners, strict=True)) for k in range(3))
    offset = dot3(sub3(point, foot), normal)  # type: ignore[arg-type]
    return offset / jnp.where(size > 0, size, 1.0), size


def _is_around(
    vertex: Int[Array, " pairs"], corner: Int[Array, "pairs 3"], garment: Garment
) -> Bool[Array, " pairs"]:
    """Return which faces lie within two edges of their vertex, and near it in the rest mesh."""
    ring = garment.neighbors[vertex]  # [pairs, degree], padded with the vertex itself
    outer = garment.neighbors[ring].reshape(ring.shape[0], -1)  # of the second ring
    reached = jnp.concatenate([ring, outer], axis=1)
    is_linked = jnp.any(reached[:, :, None] == corner[:, None, :], axis=(1, 2))
    rest = garment.rest_positions
    offset = rest[corner] - rest[vertex][:, None, :]
    nearest = jnp.min(jnp.sum(offset * offset, axis=-1), axis=1)
    return is_linked & (nearest < _REST_RADIUS**2)
