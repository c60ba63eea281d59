"""On which side a vertex belongs of a face that its own cloth already passes through."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from eslr_jax.numerics import Vector3, pierces, safe_normalize, vertex_normals
from eslr_jax.types import Garment

# Of a direction along a normal (cosine) at rest, below which it says nothing. A T-shirt's sleeve and trunk, which
# cross at the armpit where an arm hangs down, have .2 to 1.2 for the sum of both.
_LEAST_COSINE = 0.2
# [m] between a vertex and a face; farther apart, other layers may lie between them, and in a fold that is wrapped
# around another one they are then on the other side than at rest.
_NEXT_LAYER = 0.02
# [m] between a vertex and a face at rest. Beyond it the rest mesh says nothing: the walls of a pleat, far apart
# around the body at rest, may meet with either side, and one that takes the wrong side tears its neighbours. See
# `experiments/tried.md`.
_REST_REACH = 0.06


def sides_where_crossed(
    position: Float[Array, "vertices 3"],
    pairs: tuple[Int[Array, " pairs"], Int[Array, "pairs 3"], Float[Array, "pairs 3"]],
    side: Float[Array, " pairs"],
    garment: Garment,
) -> Float[Array, " pairs"]:
    """Return the sides of pairs; those that pass through each other, and are close, have the rest mesh's.

    All others stay as they are. Where a pair crosses, whatever keeps it so would lock it. Of those that are
    farther apart, now or at rest, or that the rest mesh says nothing about, nobody knows the side: they are left
    out, and may slide free.

    Args:
        position: Vertices [m].
        pairs: Vertices, corners of faces, and barycentric weights of the places on the faces.
        side: 1 in front of the face, -1 behind, 0 where a row is not used.
        garment: Rest mesh.
    """
    vertices, corners, weights = pairs
    offset = _offsets(position, vertices, corners, weights)
    is_close = jnp.sum(jnp.square(offset), axis=1) < _NEXT_LAYER**2
    at_rest = jnp.where(is_close, _sides_at_rest(vertices, corners, weights, garment), 0.0)
    is_crossed = (side != 0) & _are_crossed(position, vertices, corners, garment)
    return jnp.where(is_crossed, at_rest, side)


def _sides_at_rest(
    vertices: Int[Array, " pairs"],
    corners: Int[Array, "pairs 3"],
    weights: Float[Array, "pairs 3"],
    garment: Garment,
) -> Float[Array, " pairs"]:
    """Return the sides of pairs in the rest mesh, zero where they are not clear.

    Along the line from the face to the vertex: in front where the normals look at each other, behind where they
    look away from each other. Layers that look the same way are on the side that the line points to.
    """
    rest = garment.rest_positions
    corner = rest[corners]  # [pairs, 3, 3]
    offset = _offsets(rest, vertices, corners, weights)
    is_within_reach = jnp.sum(jnp.square(offset), axis=1) < _REST_REACH**2
    line = safe_normalize(offset)
    face = safe_normalize(jnp.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]))
    normals = vertex_normals(rest, garment.faces, garment.face_incidence)
    at_face = jnp.sum(line * face, axis=-1)
    at_vertex = jnp.sum(line * normals[vertices], axis=-1)
    is_stacked = at_face * at_vertex > _LEAST_COSINE**2
    clearness = jnp.where(is_stacked, at_face, at_face - at_vertex)
    return jnp.where(is_within_reach & (jnp.abs(clearness) > _LEAST_COSINE), jnp.sign(clearness), 0.0)


def _offsets(
    places: Float[Array, "vertices 3"],
    vertices: Int[Array, " pairs"],
    corners: Int[Array, "pairs 3"],
    weights: Float[Array, "pairs 3"],
) -> Float[Array, "pairs 3"]:
    """Return the way from the place on the face to the vertex [m]."""
    return places[vertices] - jnp.sum(weights[:, :, None] * places[corners], axis=1)


def _are_crossed(
    position: Float[Array, "vertices 3"],
    vertices: Int[Array, " pairs"],
    corners: Int[Array, "pairs 3"],
    garment: Garment,
) -> Bool[Array, " pairs"]:
    """Return where an edge of the vertex pierces the face, or an edge of the face a face of the vertex."""
    x = position.T
    face = _corners(x[:, corners.T[:, :, None]])
    ends = garment.neighbors[vertices]  # [pairs, degree], padded with the vertex itself
    is_apart = ~jnp.any(ends[:, :, None] == corners[:, None, :], axis=2)
    pierced = is_apart & pierces(tuple(x[:, vertices[:, None]]), tuple(x[:, ends]), face)
    slots = garment.face_incidence[vertices]
    around = garment.faces[slots % garment.faces.shape[0]]  # [pairs, degree, 3]
    is_real = slots < garment.faces.size
    faces = _corners(x[:, jnp.moveaxis(around, 2, 0)])
    crossed = jnp.any(pierced, axis=1)
    for k in range(3):
        first, second = corners[:, k, None], corners[:, (k + 1) % 3, None]
        is_apart = is_real & ~jnp.any((around == first[:, None]) | (around == second[:, None]), axis=2)
        pierced = is_apart & pierces(face[k], face[(k + 1) % 3], faces)
        crossed = crossed | jnp.any(pierced, axis=1)
    return crossed


def _corners(places: Float[Array, "3 corners ..."]) -> list[Vector3]:
    """Return the corners of triangles, each by components."""
    return [tuple(places[:, k]) for k in range(places.shape[1])]  # type: ignore[misc]
