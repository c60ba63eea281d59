"""Contacts of skin with faces and edges of the cloth, through which the body would show between vertices."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from eslr_jax.contact.edges import Cloth, Skin, clearance_over, find_crossings
from eslr_jax.contact.nearest import CLEARANCE, find_contacts
from eslr_jax.contact.search import face_corners, following_vertices, nearest_candidates, nearest_face_around
from eslr_jax.contact.triangle import point_triangle
from eslr_jax.numerics import Vector3, components, dot3, sub3, take3, vertex_normals
from eslr_jax.types import BodySurface, Contacts, Garment

_LIFTS = 8  # of skinned cloth off the skin
_ROUNDS = 4  # of neighbours; at 1k vertices the cloth's are two to three of the body's edges apart
_OVER = 0.02  # [m] over a body vertex, at the end of the frame, beyond which the cloth does not matter to it


@struct.dataclass
class SkinContacts:
    """Places of the body close under the cloth at t: vertices under faces, and edges under edges."""

    corners: Int[Array, "rows 3"]  # vertices of the cloth's face; an edge has its second one twice
    weights: Float[Array, "rows 3"]  # barycentric, of the place over the body's at t
    next_points: Float[Array, "rows 3"]  # places of the body at t + 1 [m]
    next_normals: Float[Array, "rows 3"]  # of the body there
    is_near: Bool[Array, " rows"]
    areas: Float[Array, " rows"]  # that they stand for [m^2]


@jax.jit  # traced once for the start of a scene and for its steps
def find_skin_contacts(
    cloth: tuple[Float[Array, "vertices 3"], Float[Array, "vertices 3"]],
    bodies: tuple[Float[Array, "surface_vertices 3"], Float[Array, "surface_vertices 3"]],
    nearest: Contacts,
    surface: BodySurface,
    garment: Garment,
) -> SkinContacts:
    """Return the places of the body that faces and edges of the cloth are about to intersect.

    Contacts keep the cloth's vertices off the body, but between them a face may cut a knee, and a fold may cut an
    edge of the body. The places with the least clearance are kept, three body vertices per crossing of edges.
    Their number is fixed, so no buffer can overflow.

    Args:
        cloth: Cloth vertices at t [m], and a guess of them at t + 1, such as the inertial one.
        bodies: Surface vertices at t and at t + 1 [m].
        nearest: The nearest body point of every cloth vertex.
        surface: Faces of the body.
        garment: Rest mesh.
    """
    moving = Cloth(*cloth)
    normals = [vertex_normals(body, surface.faces, surface.face_incidence) for body in bodies]
    corners, weights, clearance = _places_over_vertices(moving, bodies, normals, nearest, surface, garment)
    count = 3 * min(cloth[0].shape[0], clearance.shape[0] // 2) // 4
    covered, rows = jax.lax.top_k(-clearance, count)
    corners, weights = corners[rows], weights[rows]
    skin = Skin(*bodies, *normals, clearance[:, None])
    crossings = find_crossings(moving, skin, (rows, corners), nearest, garment, surface)
    areas = jnp.concatenate([surface.vertex_areas[rows], crossings.areas])
    return SkinContacts(
        corners=jnp.concatenate([corners, crossings.ends[:, (0, 1, 1)]]),
        weights=jnp.concatenate([weights, jnp.pad(crossings.weights, ((0, 0), (0, 1)))]),
        next_points=jnp.concatenate([skin.next[rows], crossings.next_points]),
        next_normals=jnp.concatenate([skin.next_normals[rows], crossings.next_normals]),
        is_near=jnp.concatenate([-covered, crossings.clearance]) < _OVER,
        # What a vertex of the cloth carries, or more where the body's mesh is the coarser one.
        areas=jnp.maximum(areas, garment.mean_vertex_area),
    )


def _places_over_vertices(
    cloth: Cloth,
    bodies: tuple[Float[Array, "surface_vertices 3"], Float[Array, "surface_vertices 3"]],
    normals: Sequence[Float[Array, "surface_vertices 3"]],
    nearest: Contacts,
    surface: BodySurface,
    garment: Garment,
) -> tuple[
    Int[Array, "surface_vertices 3"], Float[Array, "surface_vertices 3"], Float[Array, " surface_vertices"]
]:
    """Return the place of the cloth over every body vertex: corners, weights, and its height at t or t + 1 [m].

    The height is the lower one; it is infinite where the cloth is far, or beside the vertex.
    """
    body, next_body = bodies
    is_seed = nearest.is_near & garment.vertex_mask
    vertex = _nearest_vertices(cloth.now, body, surface.faces[nearest.faces], is_seed, surface)
    vertex = _descend(vertex, cloth.now, body, garment)
    corners, weights, squared = _nearest_places(vertex, cloth.now, body, garment)
    both = jnp.concatenate(cloth, axis=1)[corners.T]
    here, ahead = jnp.split(sum(weights[:, k, None] * both[k] for k in range(3)), 2, axis=1)
    over = jnp.sum((here - body) * normals[0], axis=-1)
    next_over = jnp.sum((ahead - next_body) * normals[1], axis=-1)
    clearance = clearance_over(squared, over, next_over)
    return corners, weights, jnp.where(surface.is_boundary, jnp.inf, clearance)


def skin_heights(position: Float[Array, "vertices 3"] | Vector3, skin: SkinContacts) -> Float[Array, " rows"]:
    """Return how high the places of the cloth are over those of the body at t + 1 [m]."""
    corners = take3(components(position), skin.corners.T)
    place = tuple(sum(skin.weights[:, k] * axis[k] for k in range(3)) for axis in corners)
    return dot3(sub3(place, components(skin.next_points)), components(skin.next_normals))  # type: ignore[arg-type]


def lift_off_skin(
    position: Float[Array, "vertices 3"],
    body: Float[Array, "surface_vertices 3"],
    surface: BodySurface,
    garment: Garment,
) -> Float[Array, "vertices 3"]:
    """Return positions [m], shape [vertices, 3], with faces of the cloth lifted off the skin; pinned ones stay.

    Args:
        position: Cloth vertices outside the body, of `clear_of_body` [m].
        body: Surface vertices [m].
        surface: Faces of the body.
        garment: Says which vertices are pinned.
    """
    count = position.shape[0]

    def lift(_, position: Float[Array, "vertices 3"]) -> Float[Array, "vertices 3"]:
        nearest = find_contacts(position, body, body, surface, garment.vertex_blocks)
        skin = find_skin_contacts((position, position), (body, body), nearest, surface, garment)
        depth = jnp.where(skin.is_near, jnp.maximum(CLEARANCE - skin_heights(position, skin), 0.0), 0.0)
        # Corner k moves by w_k / |w|^2 times the depth, so that the place does by the depth; a corner of several
        # places by the largest that they ask for.
        share = skin.weights / jnp.sum(skin.weights**2, axis=1, keepdims=True) * depth[:, None]
        highest = jnp.zeros(count, position.dtype).at[skin.corners].max(share)
        is_highest = (share > 0) & (share == highest[skin.corners])
        moves = jnp.where(is_highest[..., None], share[..., None] * skin.next_normals[:, None], 0.0)
        times = jnp.zeros(count, position.dtype).at[skin.corners].add(is_highest.astype(position.dtype))
        move = jnp.zeros_like(position).at[skin.corners].add(moves) / jnp.maximum(times, 1.0)[:, None]
        return position + jnp.where(garment.is_pinned[:, None], 0.0, move)

    return jax.lax.fori_loop(0, _LIFTS, lift, position)


def _nearest_vertices(
    position: Float[Array, "vertices 3"],
    body: Float[Array, "surface_vertices 3"],
    corners: Int[Array, "vertices 3"],
    is_seed: Bool[Array, " vertices"],
    surface: BodySurface,
) -> Int[Array, " surface_vertices"]:
    """Return a near cloth vertex for every body vertex.

    Each cloth vertex that is a seed is first assigned to the corners of its nearest body face. Then, a few times,
    every body vertex takes the nearest of its own cloth vertex and those of its neighbours.
    """
    cloth, here = components(position), components(body)
    is_neighbor = surface.face_incidence < surface.faces.size
    neighbors = following_vertices(surface.face_incidence, surface.faces)
    own = jnp.arange(body.shape[0], dtype=jnp.int32)[:, None]
    around = jnp.concatenate([own, jnp.where(is_neighbor, neighbors, own)], axis=1).T
    nobody = position.shape[0]
    seeds = jnp.where(is_seed[:, None], corners, body.shape[0])
    vertex = jnp.full(body.shape[0], nobody, jnp.int32)
    ids = jnp.broadcast_to(jnp.arange(nobody, dtype=jnp.int32)[:, None], seeds.shape)
    vertex = vertex.at[seeds].set(ids, mode="drop")

    def spread(_, vertex: Int[Array, " surface_vertices"]) -> Int[Array, " surface_vertices"]:
        return nearest_candidates(here, vertex[around], cloth)

    return jax.lax.fori_loop(0, _ROUNDS, spread, vertex)


def _descend(
    vertex: Int[Array, " surface_vertices"],
    position: Float[Array, "vertices 3"],
    body: Float[Array, "surface_vertices 3"],
    garment: Garment,
) -> Int[Array, " surface_vertices"]:
    """Walk along edges of the cloth to nearer vertices, since its mesh may be finer than that of the body."""
    cloth, here, nobody = components(position), components(body), position.shape[0]
    own = jnp.arange(nobody, dtype=jnp.int32)[:, None]
    neighbors = jnp.where(garment.neighbor_mask, garment.neighbors, own).T

    def walk(_, vertex: Int[Array, " surface_vertices"]) -> Int[Array, " surface_vertices"]:
        known = jnp.minimum(vertex, nobody - 1)
        candidates = jnp.concatenate([known[None], neighbors[:, known]])
        nearer = nearest_candidates(here, candidates, cloth)
        return jnp.where(vertex < nobody, nearer, nobody)

    return jax.lax.fori_loop(0, _ROUNDS, walk, vertex)


def _nearest_places(
    vertex: Int[Array, " surface_vertices"],
    position: Float[Array, "vertices 3"],
    body: Float[Array, "surface_vertices 3"],
    garment: Garment,
) -> tuple[
    Int[Array, "surface_vertices 3"], Float[Array, "surface_vertices 3"], Float[Array, " surface_vertices"]
]:
    """Return the nearest place on the faces around a cloth vertex: corners, weights, squared distance [m^2].

    The distance is infinite where there is no vertex.
    """
    nobody, point = position.shape[0], components(body)
    is_known = vertex < nobody
    corners = face_corners(position, garment.faces)
    face = nearest_face_around(point, (jnp.minimum(vertex, nobody - 1),), corners, garment.face_incidence)
    squared, u, v = point_triangle(point, *(tuple(corner) for corner in corners[face].T.reshape(3, 3, -1)))
    squared = jnp.where(is_known, squared, jnp.inf)
    return garment.faces[face], jnp.stack([1.0 - u - v, u, v], axis=1), squared
