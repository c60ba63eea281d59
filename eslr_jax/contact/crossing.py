"""The side of a face on which a vertex belongs, where cloth already intersects itself."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from eslr_jax.numerics import Vector3, pierces, safe_normalize, vertex_normals
from eslr_jax.types import Garment

# Least cosine between a pair's line and a normal in the rest mesh; below it that mesh does not tell the side. For
# sleeve and trunk of a T-shirt, which intersect at the armpit of a hanging arm, the sum of both is .2 to 1.2.
_LEAST_COSINE = 0.2
# [m]; largest distance between vertex and face at which the rest mesh tells the side. Farther apart, other layers
# may lie between them, and in a fold that is wrapped around another one the side then differs from that at rest.
_NEXT_LAYER = 0.02
# [m]; largest distance at rest at which the rest mesh tells the side. The walls of a pleat are far apart around
# the body at rest, and may meet on either side; a pair with the wrong side tears the cloth around it. See
# `experiments/tried.md`.
_REST_REACH = 0.06


def sides_where_crossed(
    position: Float[Array, "vertices 3"],
    pairs: tuple[Int[Array, " pairs"], Int[Array, "pairs 3"], Float[Array, "pairs 3"]],
    side: Float[Array, " pairs"],
    garment: Garment,
) -> Float[Array, " pairs"]:
    """Return the sides of pairs; a close pair that intersects gets its side in the rest mesh.

    Pairs that don't intersect keep their side. A pair that intersects must not keep its present side, which would
    lock the intersection. If it is farther apart, now or at rest, or if the rest mesh does not tell its side, the
    side is unknown: it gets zero, so the pair is left out and may slide free.

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

    The line from the face to the vertex tells the side. The vertex is in front if the normals of both point at
    each other, and behind if they point away from each other. If both point the same way, the vertex is on the
    side to which the line points.
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
