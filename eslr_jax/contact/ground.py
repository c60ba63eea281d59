"""A level ground that does not move."""

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
    return Contacts(
        points=points,
        next_points=points,
        normals=normals,
        next_normals=normals,
        distances=position[:, 1] - height,
        is_near=jnp.ones(position.shape[0], bool),
        faces=jnp.zeros(position.shape[0], jnp.int32),
    )


def clear_of_ground(
    position: Float[Array, "vertices 3"], height: Float[Array, ""], is_pinned: Bool[Array, " vertices"]
) -> Float[Array, "vertices 3"]:
    """Return positions [m], shape [vertices, 3], with vertices under the ground lifted out; pinned ones stay."""
    lifted = jnp.maximum(position[:, 1], height + CLEARANCE)
    return position.at[:, 1].set(jnp.where(is_pinned, position[:, 1], lifted))
