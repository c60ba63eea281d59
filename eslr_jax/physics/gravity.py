"""Gravity along -y."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from eslr_jax.numerics import Vector3, components


def gravity_energy(
    position: Float[Array, "vertices 3"] | Vector3,
    reference: Float[Array, "vertices 3"] | None,
    masses: Float[Array, " vertices"],
    gravity: Float[Array, ""] | float,
) -> Float[Array, ""]:
    """Return sum_v m_v g (y_v - y_reference) [J].

    Args:
        position: Vertex positions [m].
        reference: Where the energy is zero, usually the frame's start; None is the world origin (HOOD).
            A near reference keeps float32 sums exact and the total independent of where the scene stands.
        masses: Vertex masses [kg].
        gravity: Acceleration [m/s^2].
    """
    height = components(position)[1]
    if reference is not None:
        height = height - reference[:, 1]
    return gravity * jnp.sum(masses * height)
