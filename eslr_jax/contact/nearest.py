"""The nearest body point of every garment vertex."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from eslr_jax.contact.search import (
    PosedSurface,
    face_corners,
    nearest_faces,
    nearest_vertices,
    opposing_faces,
)
from eslr_jax.contact.triangle import point_triangle
from eslr_jax.numerics import (
    Vector3,
    components,
    cross3,
    in_memory,
    safe_norm,
    safe_normalize,
    sub3,
    vertex_normals,
)
from eslr_jax.types import BodySurface, Contacts, Garment

_OPPOSED = -0.2  # cosine between normals below which two parts of the body face each other
_TOUCHING = 0.02  # [m] that a vertex may already be inside the part across
CONTACT_RADIUS = 0.1  # [m] beyond which a tangent plane no longer stands for the body
_ON_BOUNDARY = 0.999  # share of a point's weights on boundary vertices above which it lies on the boundary
_PUSH_OUT_STEPS = 8  # tangent-plane projections that take skinned cloth out of the body
CLEARANCE = 2e-3  # [m] at which skinned cloth leaves the body and the ground; the collision thickness
MAX_APPROACH = 0.3  # [m] by which a body may come towards cloth in a frame; hard case fast_limb tries 0.27
_IMPACT = 0.02  # [m] before the body, where the path of thrown cloth ends
_EQUALLY = 1e-6  # [m] by which another face may be farther than the nearest, and is as near
_SEARCHES = 8  # along such a path, at most; straight at a wall, two


class SurfacePoint(NamedTuple):
    """A point of a body surface per garment vertex."""

    face: Int[Array, " vertices"]
    barycentric: Vector3  # weights of the face's corners
    squared_distance: Float[Array, " vertices"]  # [m^2]


def nearest_point(
    query: Float[Array, "vertices 3"],
    positions: Float[Array, "surface_vertices 3"],
    surface: BodySurface,
    blocks: Int[Array, "blocks rows"] | None = None,
) -> SurfacePoint:
    """Find the nearest surface point of every query point.

    It is the nearest point on the faces around two surface vertices: the nearest one, and another that is near.
    Another face is nearer by more than a millimetre for less than one point in a thousand.

    Args:
        query: Points [m].
        positions: Surface vertices [m], in the order of `surface.vertex_ids`.
        surface: Search tables.
        blocks: Compact groups of query points, as in `Garment.vertex_blocks`. The more compact, the faster;
            without them every point is a group of its own.
    """
    face = nearest_faces(*jax.lax.stop_gradient((query, positions)), surface, _or_single(blocks, query))
    return _point_on(face, query, positions, surface)


def _or_single(
    blocks: Int[Array, "blocks rows"] | None, query: Float[Array, "vertices 3"]
) -> Int[Array, "blocks rows"]:
    """Return the blocks that are given, or else every point as a block of its own."""
    return jnp.arange(query.shape[0], dtype=jnp.int32)[:, None] if blocks is None else blocks


def _point_on(
    face: Int[Array, " vertices"],
    query: Float[Array, "vertices 3"],
    positions: Float[Array, "surface_vertices 3"],
    surface: BodySurface,
) -> SurfacePoint:
    """Return the nearest point of one face per query point."""
    corners = face_corners(positions, surface.faces)[face].T.reshape(3, 3, -1)
    squared, u, v = point_triangle(components(query), *(tuple(corner) for corner in corners))
    return SurfacePoint(face, (1.0 - u - v, u, v), squared)


def interpolate(
    values: Float[Array, "surface_vertices features"], location: SurfacePoint, surface: BodySurface
) -> Float[Array, "vertices features"]:
    """Return per-vertex values of the surface at located points."""
    corners = values[surface.faces[location.face].T]
    return sum(weight[:, None] * corners[k] for k, weight in enumerate(location.barycentric))  # type: ignore[return-value]


def find_contacts(
    position: Float[Array, "vertices 3"],
    body: Float[Array, "surface_vertices 3"],
    next_body: Float[Array, "surface_vertices 3"],
    surface: BodySurface,
    blocks: Int[Array, "blocks rows"] | None = None,
) -> Contacts:
    """Pair every garment vertex with its nearest body point at t, and carry that point to t + 1.

    The side of the body is decided at t, where the cloth is known to be outside; a limb that moves fast then
    carries its contact planes along instead of jumping over the cloth.

    Args:
        position: Garment vertices at t [m].
        body: Surface vertices at t [m].
        next_body: Surface vertices at t + 1 [m].
        surface: Search tables.
        blocks: Compact groups of vertices, see `nearest_point`.
    """
    step = _surface_step(body, next_body, surface)
    return _contacts_at(nearest_point(position, body, surface, blocks), position, step, surface)


def find_both_sides(
    position: Float[Array, "vertices 3"],
    body: Float[Array, "surface_vertices 3"],
    next_body: Float[Array, "surface_vertices 3"],
    surface: BodySurface,
    blocks: Int[Array, "blocks rows"] | None = None,
    predicted: Float[Array, "vertices 3"] | None = None,
) -> tuple[Contacts, Contacts]:
    """Return the nearest contacts, and those with the part of the body that faces them across the cloth.

    Cloth between two thighs, or between an arm and the chest, touches both. With the nearest contact alone, the
    other limb would sweep over a vertex and then push it out on its far side. If no part of the body within reach
    faces a vertex, `is_near` of its opposing contact is false, and the contact's face is arbitrary.

    Thrown cloth moves by more than the contact radius in a frame. It touches the body where its path meets it.

    Args:
        position: Garment vertices at t [m].
        body: Surface vertices at t [m].
        next_body: Surface vertices at t + 1 [m].
        surface: Search tables.
        blocks: Compact groups of vertices, see `nearest_point`.
        predicted: A guess of the vertices at t + 1 [m], such as the inertial one; without it nothing is thrown.
    """
    step = _surface_step(body, next_body, surface)
    groups = _or_single(blocks, position)
    if predicted is None:
        query, location = position, nearest_point(position, body, surface, blocks)
    else:
        still = jax.lax.stop_gradient((position, predicted, step))
        face, gone = _nearest_on_path(*still, surface, groups)
        query = position + gone
        location = _point_on(face, query, body, surface)
    contacts = _contacts_at(location, query, step, surface)
    # Across is what is there at t + 1: a limb that faces the vertex at t may have swung past it.
    carried = position + (contacts.next_points - contacts.points)
    end = _SurfaceStep(next_body, next_body, step.next_normals, step.next_normals)
    posed = PosedSurface(*jax.lax.stop_gradient((next_body, step.next_normals)), CONTACT_RADIUS)
    at, facing = in_memory(*jax.lax.stop_gradient((carried, contacts.next_normals)))
    face, is_found = opposing_faces(at, facing, posed, surface, groups, _OPPOSED)
    opposing = _contacts_at(_point_on(face, carried, next_body, surface), carried, end, surface)
    is_facing = jnp.sum(opposing.normals * contacts.next_normals, axis=-1) < _OPPOSED
    is_outside = opposing.distances > -_TOUCHING
    return contacts, opposing.replace(is_near=opposing.is_near & is_found & is_facing & is_outside)


def find_near_vertices(
    position: Float[Array, "vertices 3"],
    body: Float[Array, "surface_vertices 3"],
    next_body: Float[Array, "surface_vertices 3"],
    surface: BodySurface,
    count: int,
) -> Contacts:
    """Pair every garment vertex with the `count` nearest body vertices at t, and carry these to t + 1.

    Returns:
        Contacts of count * vertices rows: all vertices with their nearest, then all with their second nearest.

    Arguments are those of `find_contacts`.
    """
    vertex = nearest_vertices(*jax.lax.stop_gradient((position, body)), count).reshape(-1)
    entry, size = surface.face_incidence[vertex, 0], surface.faces.shape[0]
    first, second, third = ((entry // size == k).astype(position.dtype) for k in range(3))
    query = jnp.tile(position, (count, 1))
    squared = jnp.sum(jnp.square(query - body[vertex]), axis=1)
    step = _surface_step(body, next_body, surface)
    return _contacts_at(SurfacePoint(entry % size, (first, second, third), squared), query, step, surface)


class _SurfaceStep(NamedTuple):
    """A body surface at both ends of a frame."""

    positions: Float[Array, "surface_vertices 3"]  # at t [m]
    next_positions: Float[Array, "surface_vertices 3"]  # at t + 1 [m]
    normals: Float[Array, "surface_vertices 3"]
    next_normals: Float[Array, "surface_vertices 3"]


def _surface_step(
    body: Float[Array, "surface_vertices 3"],
    next_body: Float[Array, "surface_vertices 3"],
    surface: BodySurface,
) -> _SurfaceStep:
    """Return a surface with its normals at both ends of a frame; they are computed once."""
    ends = (vertex_normals(end, surface.faces, surface.face_incidence) for end in (body, next_body))
    return _SurfaceStep(body, next_body, *ends)


def _nearest_on_path(
    position: Float[Array, "vertices 3"],
    predicted: Float[Array, "vertices 3"],
    step: _SurfaceStep,
    surface: BodySurface,
    blocks: Int[Array, "blocks rows"],
) -> tuple[Int[Array, " vertices"], Float[Array, "vertices 3"]]:
    """Return the nearest face of every vertex, and the offset [m] to the place on its path where it was found.

    The offset is zero, except for a thrown vertex whose path, relative to the body, comes close to the body or
    ends near it: the nearest point at t tells nothing of a body half a metre ahead, or of a rod on the way. From
    each place that is searched, the vertex can move on by the distance found there without meeting anything (Hart
    1996, Sphere Tracing). Only frames with thrown cloth search the whole surface again, in the same compiled
    loop.
    """
    moves = step.next_positions - step.positions

    def look(carry: _Path) -> _Path:
        query = position + carry.gone
        face = nearest_faces(query, step.positions, surface, blocks)
        path = predicted - position - moves[surface.faces[face, 0]]
        is_thrown = carry.is_open & (jnp.sum(path * path, axis=1) > CONTACT_RADIUS**2)
        first = jnp.where(carry.searches == 0, face, carry.face)
        carry = carry._replace(searches=carry.searches + 1, face=first, is_open=is_thrown)
        return jax.lax.cond(
            jnp.any(is_thrown), lambda: _go_on(carry, face, query, path, step, surface), lambda: carry
        )

    count = position.shape[0]
    nowhere, nobody = jnp.zeros_like(position), jnp.zeros(count, bool)
    start = _Path(jnp.int32(0), jnp.zeros(count, jnp.int32), nowhere, ~nobody, nobody)

    def is_going(carry: _Path) -> Bool[Array, ""]:
        return (carry.searches < _SEARCHES) & jnp.any(carry.is_open)

    end = jax.lax.while_loop(is_going, look, start)
    return end.face, jnp.where(end.is_hit[:, None], end.gone, 0.0)


class _Path(NamedTuple):
    """How far vertices were followed."""

    searches: Int[Array, ""]
    face: Int[Array, " vertices"]  # nearest at t, or where the body is hit
    gone: Float[Array, "vertices 3"]  # [m]
    is_open: Bool[Array, " vertices"]  # still on its way
    is_hit: Bool[Array, " vertices"]


def _go_on(
    carry: _Path,
    face: Int[Array, " vertices"],
    query: Float[Array, "vertices 3"],
    path: Float[Array, "vertices 3"],
    step: _SurfaceStep,
    surface: BodySurface,
) -> _Path:
    """Return vertices that are still on their way carried on by their distance from the body.

    Args:
        carry: What is known of them.
        face: Nearest to where they are.
        query: Where they are [m].
        path: Their whole path, as the body sees it [m].
        step: The body.
        surface: Search tables.
    """
    location = _point_on(face, query, step.positions, surface)
    points, normals = (interpolate(values, location, surface) for values in (step.positions, step.normals))
    is_outside = jnp.sum((query - points) * normals, axis=1) > 0
    distance, length = jnp.sqrt(location.squared_distance), safe_norm(path)
    gone = safe_norm(carry.gone)
    is_end = gone > 0.999 * length
    is_close = distance < jnp.where(is_end, CONTACT_RADIUS, _IMPACT)
    is_hit = carry.is_open & is_outside & (gone > 0) & is_close & ~_is_on_boundary(location, surface)
    is_open = carry.is_open & is_outside & ~is_end & (distance >= _IMPACT)
    share = jnp.minimum((gone + distance - 0.5 * _IMPACT) / jnp.maximum(length, CONTACT_RADIUS), 1.0)
    return carry._replace(
        face=jnp.where(is_hit, face, carry.face),
        gone=jnp.where(is_open[:, None], share[:, None] * path, carry.gone),
        is_open=is_open,
        is_hit=carry.is_hit | is_hit,
    )


def _contacts_at(
    location: SurfacePoint,
    position: Float[Array, "vertices 3"],
    step: _SurfaceStep,
    surface: BodySurface,
) -> Contacts:
    """Carry located body points to t + 1, with their tangent planes.

    The surface is only a part of the body. Cloth beyond its boundary is not in contact with it, because another
    point of the whole body is nearer.
    """
    found = interpolate(jnp.concatenate(step, axis=1), location, surface)
    points, next_points, normal, next_normal = jnp.split(found, 4, axis=1)
    here = safe_normalize(normal)
    side = jnp.sum((position - points) * here, axis=-1)
    is_apart = location.squared_distance > 0  # on the surface the root has no slope
    distance = jnp.where(is_apart, jnp.sqrt(jnp.where(is_apart, location.squared_distance, 1.0)), 0.0)
    is_on_boundary = _is_on_boundary(location, surface)
    return Contacts(
        points=points,
        next_points=next_points,
        normals=here,
        next_normals=safe_normalize(next_normal),
        distances=jnp.where((side < 0) & ~is_on_boundary, -distance, distance),
        # A limb that comes closer during the frame would otherwise jump over cloth that is far at t.
        is_near=(distance - jnp.maximum(approach(points, next_points, here), 0.0) < CONTACT_RADIUS)
        & ~is_on_boundary,
        faces=location.face,
    )


def _is_on_boundary(location: SurfacePoint, surface: BodySurface) -> Bool[Array, "*points"]:
    """Return which points lie where the surface ends."""
    corners = surface.is_boundary[surface.faces[location.face]]
    return sum(jnp.where(corners[..., k], location.barycentric[k], 0.0) for k in range(3)) > _ON_BOUNDARY  # type: ignore[return-value, operator]


def approach(
    points: Float[Array, "vertices 3"],
    next_points: Float[Array, "vertices 3"],
    normals: Float[Array, "vertices 3"],
) -> Float[Array, " vertices"]:
    """Return by how much body points move along their normals during the frame, towards the cloth [m]."""
    return jnp.sum((next_points - points) * normals, axis=-1)


def clear_of_body(
    position: Float[Array, "vertices 3"],
    body: Float[Array, "surface_vertices 3"],
    surface: BodySurface,
    garment: Garment,
) -> Float[Array, "vertices 3"]:
    """Return positions [m], shape [vertices, 3], with vertices inside the body moved onto it; pinned ones stay.

    Args:
        position: Garment vertices [m], shape [vertices, 3].
        body: Surface vertices [m], shape [surface_vertices, 3].
        surface: Search tables.
        garment: Says which vertices are pinned.
    """

    def project(_, position):
        contacts = find_contacts(position, body, body, surface, garment.vertex_blocks)
        height = jnp.sum((position - contacts.points) * contacts.normals, axis=-1)
        height = jnp.minimum(height, contacts.distances)
        lift = jnp.where(contacts.is_near, jnp.maximum(CLEARANCE - height, 0.0), 0.0)
        lift = jnp.where(garment.is_pinned, 0.0, lift)
        return position + lift[:, None] * contacts.normals

    return jax.lax.fori_loop(0, _PUSH_OUT_STEPS, project, position)


def is_inside(
    may_be: Bool[Array, " vertices"],
    position: Float[Array, "vertices 3"],
    body: Float[Array, "surface_vertices 3"],
    surface: BodySurface,
) -> Bool[Array, " vertices"]:
    """Return which vertices are inside the body, by the nearest of all its faces.

    `find_contacts` looks at few faces. Along a needle it may take one across, behind which everything is. So what
    it takes to be inside is looked at once more, one vertex at a time. Where faces end there is no inside.

    Args:
        may_be: Vertices to look at.
        position: Of them [m].
        body: Surface vertices [m].
        surface: Its faces.

    Source: of several faces that are equally near the one decides that is seen least from the side, as in
    Baerentzen and Aanaes 2005, doi 10.1109/TVCG.2005.49.
    """

    def look_at_all() -> Bool[Array, " vertices"]:
        rows = face_corners(body, surface.faces).T.reshape(3, 3, -1)
        a, b, c = (tuple(corner) for corner in rows)
        ab, ac = sub3(b, a), sub3(c, a)
        normal = safe_normalize(jnp.stack(cross3(ab, ac), axis=1)).T
        (ids,) = jnp.nonzero(may_be, size=len(may_be), fill_value=0)

        def look(number: Array, found: Bool[Array, " vertices"]) -> Bool[Array, " vertices"]:
            vertex = ids[number]
            query = tuple(jnp.broadcast_to(part, a[0].shape) for part in position[vertex])
            _, u, v = point_triangle(query, a, b, c)  # type: ignore[arg-type]
            offset = jnp.stack([q - o - u * i - v * j for q, o, i, j in zip(query, a, ab, ac, strict=True)])
            distance, height = safe_norm(offset, axis=0), jnp.sum(offset * normal, axis=0)
            is_nearest = distance <= jnp.min(distance) + _EQUALLY
            steepest = jnp.argmax(jnp.where(is_nearest, jnp.abs(height), -1.0))
            weights = tuple(weight[steepest] for weight in (1.0 - u - v, u, v))
            place = SurfacePoint(steepest, weights, distance[steepest] ** 2)  # type: ignore[arg-type]
            return found.at[vertex].set((height[steepest] < 0) & ~_is_on_boundary(place, surface))

        return jax.lax.fori_loop(0, jnp.sum(may_be), look, jnp.zeros_like(may_be))

    # In most frames there is nothing to look at.
    return jax.lax.cond(jnp.any(may_be), look_at_all, lambda: jnp.zeros_like(may_be))
