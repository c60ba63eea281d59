"""Coulomb friction against the moving body, smoothed where it sticks."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from eslr_jax.numerics import Vector3, components, dot3, sub3
from eslr_jax.types import Contacts


def friction_energy(
    position: Float[Array, "vertices 3"] | Vector3,
    start: Float[Array, "vertices 3"],
    contacts: Contacts,
    load: Float[Array, " vertices"],
    coefficient: Float[Array, ""] | float,
    slip: Float[Array, ""] | float,
) -> Float[Array, ""]:
    """Return mu sum_v N_v (sqrt(|u_v|^2 + s^2) - s) [J], whose force tends to mu N_v against the slip.

    u is the motion relative to the body point under the vertex, within the true tangent plane at t + 1.

    Args:
        position: Vertex positions at t + 1 [m].
        start: Vertex positions at t [m].
        contacts: Body points at t and t + 1.
        load: Normal force N [N], lagged: the contact force at t, so that the energy stays a potential.
        coefficient: Coulomb's mu.
        slip: Sliding distance s [m] below which friction acts like a spring.

    Source: lagged friction as in Li et al. 2020 (IPC), doi 10.1145/3386569.3392425, eq. 15.
    """
    body_motion = sub3(components(contacts.next_points), components(contacts.points))
    motion = sub3(sub3(components(position), components(start)), body_motion)
    normal = components(contacts.next_normals)
    along_normal = dot3(motion, normal)
    tangential = (
        motion[0] - along_normal * normal[0],
        motion[1] - along_normal * normal[1],
        motion[2] - along_normal * normal[2],
    )
    squared = dot3(tangential, tangential)
    # squared / (sqrt(squared + s^2) + s) equals sqrt(squared + s^2) - s without its cancellation.
    return coefficient * jnp.sum(load * squared / (jnp.sqrt(squared + slip * slip) + slip))
