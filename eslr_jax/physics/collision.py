"""Body collision: a one-sided cubic barrier at the tangent plane of the nearest body point."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from eslr_jax.contact.skin import SkinContacts, skin_heights
from eslr_jax.numerics import Vector3, components, dot3, segment_sum, sub3
from eslr_jax.types import Contacts, Garment


def penetration(
    position: Float[Array, "vertices 3"] | Vector3, contacts: Contacts, thickness: Float[Array, ""] | float
) -> Float[Array, " vertices"]:
    """Return max(thickness - d, 0) [m], d the height over the tangent plane at t + 1; zero where far."""
    offset = sub3(components(position), components(contacts.next_points))
    height = dot3(offset, components(contacts.next_normals))
    return jnp.where(contacts.is_near, jnp.maximum(thickness - height, 0.0), 0.0)


def collision_energy(
    position: Float[Array, "vertices 3"] | Vector3,
    contacts: Contacts,
    garment: Garment,
    stiffness: Float[Array, ""] | float,
    thickness: Float[Array, ""] | float,
) -> Float[Array, ""]:
    """Return stiffness sum_v a_v max(thickness - d_v, 0)^3 [J].

    Weighting by the vertex area a_v makes the energy independent of resolution; HOOD sums over vertices.

    Args:
        position: Vertex positions at t + 1 [m].
        contacts: The nearest body point of each vertex at t, carried to t + 1 by the body.
        garment: Vertex areas [m^2].
        stiffness: [J/m^5].
        thickness: Distance kept from the body [m].

    Source: HOOD (arXiv 2212.07242), with the closest point on the triangle in place of its centroid.
    """
    depth = penetration(position, contacts, thickness)
    return stiffness * jnp.sum(garment.vertex_areas * depth * depth * depth)


def skin_depths(
    position: Float[Array, "vertices 3"] | Vector3, skin: SkinContacts, thickness: Float[Array, ""] | float
) -> Float[Array, " rows"]:
    """Return max(thickness - d, 0) [m], d the height of the cloth's face over the skin; zero where far."""
    return jnp.where(skin.is_near, jnp.maximum(thickness - skin_heights(position, skin), 0.0), 0.0)


def skin_energy(
    position: Float[Array, "vertices 3"] | Vector3,
    skin: SkinContacts,
    stiffness: Float[Array, ""] | float,
    thickness: Float[Array, ""] | float,
) -> Float[Array, ""]:
    """Return stiffness sum_p a_p max(thickness - d_p, 0)^3 [J] over places p of the body under the cloth.

    Args:
        position: Vertex positions at t + 1 [m].
        skin: Places of the body, the places of the cloth over them, and the areas a_p.
        stiffness: [J/m^5].
        thickness: Distance kept from the body [m].

    Source: the barrier is `collision_energy`'s.
    """
    depth = skin_depths(position, skin, thickness)
    return stiffness * jnp.sum(skin.areas * depth * depth * depth)


def skin_diagonal(
    position: Float[Array, "vertices 3"],
    skin: SkinContacts,
    stiffness: Float[Array, ""] | float,
    thickness: Float[Array, ""] | float,
) -> Float[Array, " vertices"]:
    """Return an estimate of `skin_energy`'s curvature per vertex [N/m], a third of that along the normal."""
    curvature = 2.0 * stiffness * skin.areas * skin_depths(position, skin, thickness)
    values = skin.weights**2 * curvature[:, None]
    return segment_sum(values.T.ravel(), skin.corners.T.ravel(), position.shape[0])


def contact_forces(
    position: Float[Array, "vertices 3"],
    contacts: Contacts,
    garment: Garment,
    stiffness: Float[Array, ""] | float,
    thickness: Float[Array, ""] | float,
) -> Float[Array, " vertices"]:
    """Return the normal force on every vertex [N], the negative derivative of its collision energy."""
    depth = penetration(position, contacts, thickness)
    return 3.0 * stiffness * garment.vertex_areas * depth * depth
