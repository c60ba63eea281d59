"""Inertia: the kinetic part of implicit Euler."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from eslr_jax.numerics import Vector3, components, dot3, sub3
from eslr_jax.types import Garment, Material


def vertex_masses(garment: Garment, material: Material) -> Float[Array, " vertices"]:
    """Return lumped masses [kg]; zero for padded vertices."""
    return material.density * garment.vertex_areas


def inertia_energy(
    position: Float[Array, "vertices 3"] | Vector3,
    inertial_guess: Float[Array, "vertices 3"],
    masses: Float[Array, " vertices"],
    timestep: Float[Array, ""],
) -> Float[Array, ""]:
    """Return sum_v m_v |x_v - (x_t + dt v_t)|^2 / (2 dt^2) [J].

    Source: Gast et al. 2015, doi 10.1109/TVCG.2015.2459687; HOOD's inertia loss.
    """
    offset = sub3(components(position), components(inertial_guess))
    return jnp.sum(masses * dot3(offset, offset)) / (2.0 * timestep * timestep)
