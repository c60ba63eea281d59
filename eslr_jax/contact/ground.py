"""Planes that do not move, such as a level ground."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from eslr_jax.contact.nearest import CLEARANCE
from eslr_jax.types import Contacts


def ground_contacts(position: Float[Array, "vertices 3"], height: Float[Array, ""]) -> Contacts:
    """Pair every vertex with the point of the ground under it.

    Args:
        position: Garment vertices at t [m].
        height: Height of the ground [m].
    """
    points = position.at[:, 1].set(height)
    normals = jnp.zeros_like(position).at[:, 1].set(1.0)
    return still_contacts(points, normals, position[:, 1] - height, jnp.ones(position.shape[0], bool))


def still_contacts(
    points: Float[Array, "vertices 3"],
    normals: Float[Array, "vertices 3"],
    distances: Float[Array, " vertices"],
    is_near: Bool[Array, " vertices"],
) -> Contacts:
    """Return contacts with planes through points [m], across normals, that do not move within a frame."""
    faces = jnp.zeros(points.shape[0], jnp.int32)
    return Contacts(points, points, normals, normals, distances, is_near, faces)


def clear_of_ground(
    position: Float[Array, "vertices 3"], height: Float[Array, ""], is_pinned: Bool[Array, " vertices"]
) -> Float[Array, "vertices 3"]:
    """Return positions [m], shape [vertices, 3], with vertices under the ground lifted out; pinned ones stay."""
    lifted = jnp.maximum(position[:, 1], height + CLEARANCE)
    return position.at[:, 1].set(jnp.where(is_pinned, position[:, 1], lifted))
