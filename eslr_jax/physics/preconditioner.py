"""A diagonal estimate of the potential's Hessian."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from eslr_jax.numerics import scatter_corners
from eslr_jax.physics.collision import penetration
from eslr_jax.physics.inertia import vertex_masses
from eslr_jax.physics.problem import FrameProblem
from eslr_jax.physics.repulsion import repulsion_diagonal
from eslr_jax.types import Garment, Material


def stretch_diagonal(garment: Garment, material: Material) -> Float[Array, " vertices"]:
    """Return the membrane's stiffness per vertex at rest [N/m], averaged over the triangle's plane.

    Moving one corner along its height changes the strain by 1/height, so the curvature is
    A h (lambda + 2 mu) / height^2 = h (lambda + 2 mu) |opposite edge|^2 / (4 A).
    """
    corners = garment.rest_positions[garment.faces]
    opposite = corners[:, [2, 0, 1]] - corners[:, [1, 2, 0]]
    squared = jnp.sum(opposite * opposite, axis=-1)
    modulus = material.thickness * (material.lame_lambda + 2.0 * material.lame_mu)
    is_real = garment.rest_areas > 0
    scale = jnp.where(is_real, modulus / (4.0 * jnp.where(is_real, garment.rest_areas, 1.0)), 0.0)
    return scatter_corners(scale[:, None] * squared, garment.face_incidence)


def hessian_diagonal(
    problem: FrameProblem, garment: Garment, material: Material, position: Float[Array, "vertices 3"]
) -> Float[Array, " vertices"]:
    """Return a positive stiffness per vertex [N/m]: inertia, stretch, contacts and friction at `position`.

    Padded and pinned vertices get one, so that dividing by it is safe.
    """
    masses = vertex_masses(garment, material)
    diagonal = masses / problem.timestep**2 + stretch_diagonal(garment, material)
    if problem.contacts is not None:
        assert problem.friction_load is not None
        parameters = problem.parameters
        depth = penetration(position, problem.contacts, problem.collision_thickness)
        if problem.across is not None:
            depth = depth + penetration(position, problem.across, problem.collision_thickness)
        slip = parameters.friction_speed * problem.timestep
        # The contact curvature acts along one of three axes, friction along two.
        diagonal = diagonal + 2.0 * parameters.collision_stiffness * garment.vertex_areas * depth
        diagonal = diagonal + parameters.friction_coefficient * problem.friction_load / (3.0 * slip)
    if problem.self_contacts is not None:
        diagonal = diagonal + repulsion_diagonal(
            position,
            problem.self_contacts,
            garment,
            problem.parameters.repulsion_stiffness,
            problem.parameters.repulsion_thickness,
        )
    return jnp.where(garment.vertex_mask, diagonal, 1.0)
