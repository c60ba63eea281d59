"""Inertia: the kinetic part of implicit Euler, or of BDF2."""

from __future__ import annotations

from typing import Any

from flax import struct
from jaxtyping import Array, Float

from eslr_jax.numerics import Vector3, components, dot3, in_memory, sub3
from eslr_jax.terms.term import FrameProblem, Term


@struct.dataclass
class Inertia(Term):
    """The energy of being elsewhere than where inertia leads."""

    name = "inertia"
    on = "vertices"

    def corner_energies(
        self, corners: tuple[Vector3, ...], problem: FrameProblem, data: Any
    ) -> Float[Array, " vertices"]:
        """Return the energy of every vertex [J]; see `inertia_energies`."""
        return inertia_energies(corners[0], problem.inertial_guess, problem.masses, problem.inertial_timestep)

    def diagonal(self, x: Vector3, problem: FrameProblem, data: Any) -> Float[Array, " vertices"]:
        """Return m_v / dt^2 [N/m]."""
        return problem.masses / problem.inertial_timestep**2


def inertia_energies(
    position: Float[Array, "vertices 3"] | Vector3,
    inertial_guess: Float[Array, "vertices 3"],
    masses: Float[Array, " vertices"],
    timestep: Float[Array, ""] | float,
) -> Float[Array, " vertices"]:
    """Return m_v |x_v - (x_t + dt v_t)|^2 / (2 dt^2) of every vertex [J].

    Source: Gast et al. 2015, doi 10.1109/TVCG.2015.2459687; HOOD's inertia loss.
    """
    offset = sub3(components(position), components(inertial_guess))
    (scale,) = in_memory(masses / (2.0 * timestep * timestep))
    return scale * dot3(offset, offset)
