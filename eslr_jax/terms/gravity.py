"""Gravity along -y."""

from __future__ import annotations

from types import MappingProxyType
from typing import Any

from flax import struct
from jaxtyping import Array, Float

from eslr_jax.numerics import Vector3, components, in_memory
from eslr_jax.ranges import Range
from eslr_jax.terms.term import FrameProblem, Term


@struct.dataclass
class Gravity(Term):
    """The weight's energy, counted from the frame's first positions."""

    name = "gravity"
    on = "vertices"
    ranges = MappingProxyType({"acceleration": Range(1e-2, 100.0, "m/s^2")})  # residuals are in weights

    acceleration: Float[Array, ""] | float = 9.81  # [m/s^2], along -y

    def corner_energies(
        self, corners: tuple[Vector3, ...], problem: FrameProblem, data: Any
    ) -> Float[Array, " vertices"]:
        """Return the energy of every vertex [J]; see `gravity_energies`."""
        return gravity_energies(corners[0], problem.position, problem.masses, self.acceleration)


def gravity_energies(
    position: Float[Array, "vertices 3"] | Vector3,
    reference: Float[Array, "vertices 3"] | None,
    masses: Float[Array, " vertices"],
    gravity: Float[Array, ""] | float,
) -> Float[Array, " vertices"]:
    """Return m_v g (y_v - y_reference) of every vertex [J], with positions in metres and g in m/s^2.

    The reference is where the energy is zero, usually the frame's start; None is the world's origin (HOOD). A
    near one keeps float32 sums exact and the total independent of where the scene stands.
    """
    height = components(position)[1]
    if reference is not None:
        height = height - reference[:, 1]
    (weights,) = in_memory(gravity * masses)
    return weights * height
