"""Self-contact: a one-sided cubic barrier between a vertex and the plane of a face of the same cloth."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from eslr_jax.contact.self_contact import SelfContacts
from eslr_jax.numerics import Vector3, components, cross3, dot3, safe_normalize, segment_sum, sub3
from eslr_jax.types import Garment

_SWEEPS = 4  # of `push_apart`


def pair_heights(
    position: Float[Array, "vertices 3"], contacts: SelfContacts
) -> tuple[Float[Array, " pairs"], Vector3]:
    """Return every vertex's height over its face's plane, on the side it is kept on [m], and that direction.

    d = side (x_v - sum_k w_k x_k) . n, with the face's unit normal n at `position`; so the energy of d turns
    with the cloth, and its four forces have no resultant and no moment. Unused rows give zero.
    """
    x = components(position)
    point = tuple(c[contacts.vertices] for c in x)
    corners = [tuple(c[contacts.corners[:, k]] for c in x) for k in range(3)]
    weights = [contacts.weights[:, k] for k in range(3)]
    foot = tuple(sum(weights[k] * corners[k][axis] for k in range(3)) for axis in range(3))
    normal = cross3(sub3(corners[1], corners[0]), sub3(corners[2], corners[0]))  # type: ignore[arg-type]
    unit = safe_normalize(jnp.stack(normal, axis=0), axis=0)
    direction = (contacts.side * unit[0], contacts.side * unit[1], contacts.side * unit[2])
    return dot3(sub3(point, foot), direction), direction  # type: ignore[arg-type]


def overlaps(
    position: Float[Array, "vertices 3"], contacts: SelfContacts, thickness: Float[Array, ""] | float
) -> Float[Array, " pairs"]:
    """Return max(thickness - d, 0) per pair [m]; zero where a row is not used."""
    height, _ = pair_heights(position, contacts)
    return jnp.where(contacts.side != 0, jnp.maximum(thickness - height, 0.0), 0.0)


def repulsion_energy(
    position: Float[Array, "vertices 3"],
    contacts: SelfContacts,
    garment: Garment,
    stiffness: Float[Array, ""] | float,
    thickness: Float[Array, ""] | float,
) -> Float[Array, ""]:
    """Return stiffness sum_pairs a_v max(thickness - d, 0)^3 [J].

    Args:
        position: Vertex positions at t + 1 [m].
        contacts: Pairs that are close at t.
        garment: Vertex areas a_v [m^2].
        stiffness: [J/m^5].
        thickness: Distance kept between layers [m].

    Source: ContourCraft (arXiv 2405.09522), its repulsion loss, with areas in place of its count of vertices
        and the nearest point of the face in place of a corner.
    """
    depth = overlaps(position, contacts, thickness)
    return stiffness * jnp.sum(garment.vertex_areas[contacts.vertices] * depth**3)


def repulsion_diagonal(
    position: Float[Array, "vertices 3"],
    contacts: SelfContacts,
    garment: Garment,
    stiffness: Float[Array, ""] | float,
    thickness: Float[Array, ""] | float,
) -> Float[Array, " vertices"]:
    """Return an estimate of the energy's curvature per vertex [N/m], a third of that along the normal."""
    depth = overlaps(position, contacts, thickness)
    curvature = 2.0 * stiffness * garment.vertex_areas[contacts.vertices] * depth
    return _scatter(contacts, curvature, contacts.weights**2 * curvature[:, None], position.shape[0])


def push_apart(
    position: Float[Array, "vertices 3"], contacts: SelfContacts, thickness: Float[Array, ""] | float
) -> Float[Array, "vertices 3"]:
    """Move the two sides of every overlapping pair apart, both by half, a few times.

    Like pushing out of the body, it is a better start than the barrier's own slow first iterations. A vertex
    of several pairs moves by the mean of what they ask for.
    """
    num_vertices = position.shape[0]
    for _ in range(_SWEEPS):
        height, direction = pair_heights(position, contacts)
        depth = jnp.where(contacts.side != 0, jnp.maximum(thickness - height, 0.0), 0.0)
        # Moving the vertex by s and corner k by -s w_k / |w|^2 parts them by 2 s.
        share = contacts.weights / jnp.sum(contacts.weights**2, axis=1, keepdims=True)
        is_deep = (depth > 0).astype(position.dtype)
        asked = _scatter(contacts, is_deep, is_deep[:, None] * (contacts.weights > 0), num_vertices)
        scale = 1.0 / jnp.maximum(asked, 1.0)
        moves = [
            _scatter(contacts, 0.5 * depth * axis, -0.5 * (depth * axis)[:, None] * share, num_vertices)
            for axis in direction
        ]
        position = position + scale[:, None] * jnp.stack(moves, axis=-1)
    return position


def _scatter(
    contacts: SelfContacts,
    at_vertex: Float[Array, " pairs"],
    at_corners: Float[Array, "pairs 3"],
    num_vertices: int,
) -> Float[Array, " vertices"]:
    """Sum what pairs give to their vertex and to their three corners."""
    values = jnp.concatenate([at_vertex, at_corners.T.ravel()])
    ids = jnp.concatenate([contacts.vertices, contacts.corners.T.ravel()])
    return segment_sum(values, ids, num_vertices)
