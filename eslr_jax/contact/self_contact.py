"""Where points come close to faces of cloth: pairs of fixed capacity, found in sorted cells."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from eslr_jax.contact.triangle import point_triangle
from eslr_jax.errors import Status
from eslr_jax.numerics import Vector3, components, cross3, dot3, safe_norm, sub3, true_rows
from eslr_jax.types import Garment, PairCapacity

TIP_RADIUS = 0.06  # [m] within which the vertices of a sharp body see the cloth
# [m] within which layers see each other: they may approach by this much in a frame. At 0.02 the walls of a pleat
# that closes at a metre a second passed through each other unseen (hard case `layers`).
SEARCH_RADIUS = 0.04
_NEAR = 0.01  # [m] within which a pair is kept even if it doesn't seem to approach (ContourCraft)
_MIN_COSINE = 0.8  # between a pair's direction and the face normal; beside a hem there is nothing to hit
_REST_RADIUS = 0.02  # [m]; within it, topological neighbours are no pairs
_CELLS_PER_SIDE = 1024  # so that a cell's key fits 30 bits
CELL_CAPACITY = 96  # faces in each of the nine columns of three cells around a vertex; default
_TIP_CELL_CAPACITY = 512  # likewise around a tip, whose cells are larger
PAIRS_PER_VERTEX = 8  # default capacity, a mean over vertices
PAIRS_PER_TIP = 8  # likewise for tips, over the vertices of both; cloth bunched around a needle took 4.7


@struct.dataclass
class FacePairs:
    """Pairs of a point and a face of the cloth that are close at t.

    The points are the cloth's own vertices, or vertices of the body. A row that is not used has `side` zero,
    and names the last point and the last vertex.
    """

    vertices: Int[Array, " pairs"]  # the points' rows
    corners: Int[Array, "pairs 3"]  # vertices of the face
    weights: Float[Array, "pairs 3"]  # barycentric, of the place on the face nearest to the point at t
    side: Float[Array, " pairs"]  # 1 where the point is on the side of the face's normal at t, -1 behind
    areas: Float[Array, " pairs"]  # of cloth that the point stands for [m^2]
    count: Int[Array, ""]  # pairs found, which may be more than there are rows
    listed: Int[Array, ""]  # the cell capacity that would have held all faces looked at
    status: Int[Array, ""]  # Status.SELF_CONTACT_OVERFLOW if a capacity was too small


class _Grid(NamedTuple):
    """Faces sorted by the cell of their centroid."""

    keys: Int[Array, " faces"]  # ascending
    faces: Int[Array, " faces"]
    origin: Float[Array, " axes"]  # [m], shape [3]
    cell_size: Float[Array, ""]  # [m]


def default_capacity(num_vertices: int) -> PairCapacity:
    """Return the buffers that self-contact starts with, for a garment of so many vertices."""
    return PairCapacity(pairs=PAIRS_PER_VERTEX * num_vertices, faces=CELL_CAPACITY)


def find_self_contacts(
    position: Float[Array, "vertices 3"],
    predicted: Float[Array, "vertices 3"],
    garment: Garment,
    capacity: PairCapacity,
    *,
    radius: float = SEARCH_RADIUS,
) -> FacePairs:
    """Pair every vertex with the faces of the same cloth that it could touch during the frame.

    A pair is closer than `radius` at t, and closer than a centimetre at t or at the prediction. The vertex
    must stand over the face rather than beside it. Which side it is on is decided at t, where layers are
    taken to be in order. Faces around the vertex are no pairs: those that hold it, and those within two edges
    of it that are also within 2 cm in the rest mesh.

    Args:
        position: Vertices at t [m], shape [vertices, 3].
        predicted: A guess of the vertices at t + 1 [m], such as the inertial one, shape [vertices, 3].
        garment: Rest mesh.
        capacity: Sizes of the buffers; static.
        radius: Radius of the search [m].
    """
    points = _Points(position, predicted, garment.vertex_mask, garment.vertex_areas, is_cloth=True)
    pairs = _find_pairs(points, _Cloth(position, predicted, garment), radius, capacity)
    is_around = _is_around(pairs.vertices, pairs.corners, garment)
    return dataclasses.replace(pairs, side=jnp.where(is_around, 0.0, pairs.side))


def find_tip_contacts(
    position: Float[Array, "vertices 3"],
    predicted: Float[Array, "vertices 3"],
    body: Float[Array, "surface_vertices 3"],
    next_body: Float[Array, "surface_vertices 3"],
    garment: Garment,
) -> FacePairs:
    """Pair every body vertex with the faces of the cloth that it could touch during the frame.

    The nearest body point of every cloth vertex misses a tip that is finer than the cloth's mesh. The body's
    own vertices see the faces.

    Args:
        position: Cloth vertices at t [m], shape [vertices, 3].
        predicted: A guess of the cloth vertices at t + 1 [m], shape [vertices, 3].
        body: Body vertices at t [m], shape [surface_vertices, 3].
        next_body: Body vertices at t + 1 [m], shape [surface_vertices, 3].
        garment: Rest mesh.
    """
    count = body.shape[0]
    capacity = PairCapacity(PAIRS_PER_TIP * (position.shape[0] + count), _TIP_CELL_CAPACITY)
    area = jnp.sum(garment.vertex_areas) / jnp.sum(garment.vertex_mask, dtype=garment.vertex_areas.dtype)
    points = _Points(body, next_body, jnp.ones(count, bool), jnp.full(count, area), is_cloth=False)
    return _find_pairs(points, _Cloth(position, predicted, garment), TIP_RADIUS, capacity)


class _Points(NamedTuple):
    """What is paired with the faces of the cloth."""

    position: Float[Array, "points 3"]  # at t [m]
    predicted: Float[Array, "points 3"]  # at t + 1 [m]
    mask: Bool[Array, " points"]
    areas: Float[Array, " points"]  # of cloth [m^2]
    is_cloth: bool  # the points are the vertices of the faces


class _Cloth(NamedTuple):
    """Whose faces the points are paired with."""

    position: Float[Array, "vertices 3"]  # at t [m]
    predicted: Float[Array, "vertices 3"]  # at t + 1 [m]
    garment: Garment


def _find_pairs(points: _Points, cloth: _Cloth, radius: float, capacity: PairCapacity) -> FacePairs:
    """Return pairs of points and faces; see `find_self_contacts`."""
    garment = cloth.garment
    num_points, num_vertices = points.position.shape[0], cloth.position.shape[0]
    corners = [_gather(cloth.position, garment.faces[:, k]) for k in range(3)]
    centroid = _mean(corners)
    reach = _largest_reach(corners, centroid, garment.rest_areas > 0)
    grid = _sort_faces(centroid, garment.rest_areas > 0, radius + reach)
    faces, is_listed, most = _listed_faces(points.position, grid, capacity.faces)
    # First by distance of centroids, which is cheap, then exactly.
    x, y, z = components(points.position)
    listed = (centroid[0][faces], centroid[1][faces], centroid[2][faces])
    squared = _squared_distance((x[:, None], y[:, None], z[:, None]), listed)
    is_close = is_listed & points.mask[:, None] & (squared < grid.cell_size**2)
    limit = capacity.faces * num_points
    rows, num_close = true_rows(is_close.ravel(), limit)
    point = jnp.minimum(rows // faces.shape[1], num_points - 1)
    face = faces.ravel()[jnp.minimum(rows, faces.size - 1)]
    is_pair, weights, side = _is_pair(point, face, points, cloth, radius)
    rows, count = true_rows(is_pair & (jnp.arange(limit) < num_close), capacity.pairs)
    is_used = jnp.arange(capacity.pairs) < count
    rows = jnp.minimum(rows, limit - 1)
    point = jnp.where(is_used, point[rows], num_points - 1)
    listed = jnp.maximum(most, -(-num_close // num_points))
    is_full = (listed > capacity.faces) | (count > capacity.pairs)
    return FacePairs(
        vertices=point,
        corners=jnp.where(is_used[:, None], garment.faces[face[rows]], num_vertices - 1),
        weights=weights[rows],
        side=jnp.where(is_used, side[rows], 0.0),
        areas=jnp.where(is_used, points.areas[point], 0.0),
        count=count,
        listed=listed,
        status=jnp.where(is_full, jnp.int32(Status.SELF_CONTACT_OVERFLOW), jnp.int32(Status.OK)),
    )


def _mean(points: list[Vector3]) -> Vector3:
    """Return the mean of points given by components."""
    x, y, z = (sum(point[k] for point in points) / len(points) for k in range(3))
    return x, y, z  # type: ignore[return-value]


def _largest_reach(corners: list[Vector3], centroid: Vector3, is_real: Bool[Array, " faces"]) -> Array:
    """Return the largest distance from a face's centroid to its corners [m]."""
    squared = [jnp.max(jnp.where(is_real, _squared_distance(corner, centroid), 0.0)) for corner in corners]
    return jnp.sqrt(jnp.max(jnp.stack(squared)))


def _squared_distance(a: Vector3, b: Vector3) -> Array:
    """Return squared distances between points given by components."""
    difference = sub3(a, b)
    return dot3(difference, difference)


def _cell_key(cell: Int[Array, "... 3"]) -> Int[Array, ...]:
    """Return one number per cell; cells that differ in the last coordinate alone are in sequence."""
    cell = jnp.clip(cell, 0, _CELLS_PER_SIDE - 1)
    return (cell[..., 0] * _CELLS_PER_SIDE + cell[..., 1]) * _CELLS_PER_SIDE + cell[..., 2]


def _sort_faces(centroid: Vector3, is_real: Bool[Array, " faces"], cell_size: Array) -> _Grid:
    """Sort faces by cell; padded faces come last, in a cell of their own."""
    points = jnp.stack(centroid, axis=-1)
    origin = jnp.min(jnp.where(is_real[:, None], points, jnp.inf), axis=0)
    cell = jnp.floor((points - origin[None]) / cell_size).astype(jnp.int32) + 1
    key = jnp.where(is_real, _cell_key(cell), _CELLS_PER_SIDE**3)
    order = jnp.argsort(key)
    return _Grid(key[order], order, origin, cell_size)


def _listed_faces(
    position: Float[Array, "points 3"], grid: _Grid, capacity: int
) -> tuple[Int[Array, "points listed"], Bool[Array, "points listed"], Int[Array, ""]]:
    """Return the faces in the 27 cells around every point, which slots are real, and the longest column."""
    cell = jnp.floor((position - grid.origin[None]) / grid.cell_size).astype(jnp.int32) + 1
    steps = jnp.array([(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1)], jnp.int32)
    columns = cell[:, None, :] + jnp.pad(steps, ((0, 0), (0, 1)))[None]  # [points, 9, 3]
    up = jnp.array([[[0, 0, 1]]], jnp.int32)
    first = jnp.searchsorted(grid.keys, _cell_key(columns - up), side="left")
    last = jnp.searchsorted(grid.keys, _cell_key(columns + up), side="right")
    slot = first[..., None] + jnp.arange(capacity, dtype=first.dtype)[None, None]  # [points, 9, capacity]
    is_listed = slot < last[..., None]
    faces = grid.faces[jnp.minimum(slot, grid.faces.shape[0] - 1)]
    num_points = position.shape[0]
    return (
        faces.reshape(num_points, -1),
        is_listed.reshape(num_points, -1),
        jnp.max(last - first),
    )


def _is_pair(
    point: Int[Array, " rows"],
    face: Int[Array, " rows"],
    points: _Points,
    cloth: _Cloth,
    radius: float,
) -> tuple[Bool[Array, " rows"], Float[Array, "rows 3"], Float[Array, " rows"]]:
    """Return which rows are pairs, the barycentric weights of the nearest place, and the point's side."""
    corner = cloth.garment.faces[face]
    here = _gather(points.position, point)
    a, b, c = (_gather(cloth.position, corner[:, k]) for k in range(3))
    squared, u, v = point_triangle(here, a, b, c)
    weights = (1.0 - u - v, u, v)
    height, size = _height(here, (a, b, c), weights)
    moved = [_gather(cloth.predicted, corner[:, k]) for k in range(3)]
    predicted_height, _ = _height(_gather(points.predicted, point), moved, weights)
    side = jnp.where(height < 0, -1.0, 1.0).astype(squared.dtype)
    is_over = jnp.abs(height) >= _MIN_COSINE * jnp.sqrt(squared)
    is_reached = (squared < _NEAR**2) | (side * predicted_height < _NEAR)
    is_pair = (squared < jnp.square(radius)) & is_over & is_reached & (size > 0)
    if points.is_cloth:
        is_pair = is_pair & ~jnp.any(corner == point[:, None], axis=1)
    return is_pair, jnp.stack(weights, axis=-1), side


def _gather(x: Float[Array, "vertices 3"], rows: Int[Array, " rows"]) -> Vector3:
    """Return rows of `x` by components."""
    return x[rows, 0], x[rows, 1], x[rows, 2]


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
