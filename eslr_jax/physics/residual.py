"""How far a position is from the frame's optimum: in force, and in energy."""

from __future__ import annotations

from typing import NamedTuple

import jax
from jaxtyping import Array, Float

from eslr_jax.numerics import safe_norm
from eslr_jax.physics.inertia import vertex_masses
from eslr_jax.physics.potential import potential
from eslr_jax.physics.problem import FrameProblem, start_guess
from eslr_jax.types import Garment, Material


class OptimalityGap(NamedTuple):
    """Potential above the optimum's from the same state."""

    joules: Float[Array, ""]
    relative: Float[Array, ""]  # to the initial gap: what the inertial guess, pushed out, has above it


def weight_norm(problem: FrameProblem, garment: Garment, material: Material) -> Float[Array, ""]:
    """Return the norm of the vertices' weights [N]: the unit of residuals."""
    return problem.parameters.gravity * safe_norm(vertex_masses(garment, material))


def relative_residual(
    gradient: Float[Array, "vertices 3"], problem: FrameProblem, garment: Garment, material: Material
) -> Float[Array, ""]:
    """Return the norm of a remaining force [N] over that of the weights, without unit."""
    return safe_norm(gradient.reshape(-1)) / weight_norm(problem, garment, material)


def residual(
    position: Float[Array, "vertices 3"], problem: FrameProblem, garment: Garment, material: Material
) -> Float[Array, ""]:
    """Return the force norm that is left at `position` over the weights' norm, without unit."""
    return relative_residual(
        jax.grad(potential)(position, problem, garment, material), problem, garment, material
    )


def gap(
    position: Float[Array, "vertices 3"],
    problem: FrameProblem,
    garment: Garment,
    material: Material,
    optimum: Float[Array, ""] | float,
) -> OptimalityGap:
    """Return how much potential `position` leaves on the table.

    Args:
        position: Any stepper's answer at t + 1 [m].
        problem: The frame's problem.
        garment: Rest mesh.
        material: Fabric.
        optimum: The potential's minimum [J], of `newton.minimize_newton` or of many L-BFGS iterations.
    """
    joules = potential(position, problem, garment, material) - optimum
    drop = potential(start_guess(problem, garment), problem, garment, material) - optimum
    return OptimalityGap(joules, joules / drop)
