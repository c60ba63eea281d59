"""Internal damping: stress that the rate of strain adds to the stress of the strain (Kelvin-Voigt).

A fabric with damping tau answers the strain G with the stress of G + tau dG/dt. Over a frame of length dt,
tau dG/dt adds the potential (tau / dt) W(G' - G): W is the fabric's energy, G its strain at t, G' at t + 1.
Bending adds the same with the angles of its hinges. An oscillation of angular frequency w has the damping ratio
tau w / 2, so fast ripples die first. Falling and turning are not damped: they strain nothing.

Source: Baraff and Witkin 1998, doi 10.1145/280814.280821, section 4.5, with forces from a potential.
"""

from __future__ import annotations

from types import MappingProxyType
from typing import NamedTuple

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from eslr_jax.numerics import Vector3, gather_corners
from eslr_jax.ranges import Range
from eslr_jax.terms.bending import angle_energies, dihedral_angles
from eslr_jax.terms.stretch import green_strains, strain_energies, stretch_diagonal
from eslr_jax.terms.term import Elements, FrameProblem, Term
from eslr_jax.types import Garment


class PastStrain(NamedTuple):
    """How the cloth was strained at t."""

    strains: Vector3  # components 00, 11 and 01 of the Green strain of every face
    angles: Float[Array, " hinges"]  # [rad]


@struct.dataclass
class Damping(Term):
    """The dissipation potential of a fabric."""

    name = "damping"
    is_elastic = True
    ranges = MappingProxyType({"time": Range(0.0, 1.0, "s")})

    time: Float[Array, ""] | float  # tau, by which stress runs ahead of strain [s]

    def prepare(self, problem: FrameProblem) -> PastStrain:
        """Return the strain that a frame begins with."""
        return _strain(problem.position, problem)

    def elements(self, x: Vector3, problem: FrameProblem, data: PastStrain) -> tuple[Elements, ...]:
        """Return (tau / dt) W of the change of strain [J], of faces and of hinges."""
        garment, material, rate = problem.garment, problem.material, self.time / problem.timestep
        now = _strain(x, problem)
        change = tuple(after - before for after, before in zip(now.strains, data.strains, strict=True))
        turned = now.angles - data.angles
        whole = 2.0 * jnp.pi
        turned = turned - whole * jnp.round(turned / whole)  # past a complete fold the angle jumps
        stretching = strain_energies(change, garment, material)  # type: ignore[arg-type]
        bending = angle_energies(turned, garment, material)
        bent = garment.hinges if material.plate is None else garment.faces
        return Elements(rate * stretching, garment.faces), Elements(rate * bending, bent)

    def diagonal(self, x: Vector3, problem: FrameProblem, data: PastStrain) -> Float[Array, " vertices"]:
        """Return the curvature of the strain's change [N/m]."""
        return self.time / problem.timestep * stretch_diagonal(problem.garment, problem.material)

    def describe(self, garment: Garment) -> str:
        """Return its time."""
        return f"{float(self.time):g} s"


def _strain(position: Float[Array, "vertices 3"] | Vector3, problem: FrameProblem) -> PastStrain:
    garment = problem.garment
    corners = gather_corners(position, garment.faces, garment.face_incidence)
    return PastStrain(green_strains(corners, garment), dihedral_angles(position, garment))
