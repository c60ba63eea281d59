"""Internal damping: stress that the rate of strain adds to the stress of the strain (Kelvin-Voigt).

A fabric with damping tau answers the strain G with the stress of G + tau dG/dt. Over a frame of length dt,
tau dG/dt adds the potential (tau / dt) W(G' - G): W is the fabric's energy, G its strain at t, G' at t + 1.
Bending adds the same with the angles of its hinges. An oscillation of angular frequency w has the damping ratio
tau w / 2, so fast ripples die first. Falling and turning are not damped: they strain nothing.

Source: Baraff and Witkin 1998, doi 10.1145/280814.280821, section 4.5, with forces from a potential.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from eslr_jax.numerics import Vector3, gather_corners
from eslr_jax.physics.bending import angle_energy, dihedral_angles
from eslr_jax.physics.membrane import green_strains, strain_energies
from eslr_jax.types import Garment

if TYPE_CHECKING:
    from eslr_jax.physics.problem import FrameProblem


@struct.dataclass
class PastStrain:
    """How the cloth was strained at t, and how much of its change resists."""

    strains: Vector3  # components 00, 11 and 01 of the Green strain of every face
    angles: Float[Array, " hinges"]  # [rad]
    rate: Float[Array, ""]  # tau / dt


def past_strain(
    damping: Float[Array, ""],
    timestep: Float[Array, ""],
    position: Float[Array, "vertices 3"],
    garment: Garment,
) -> PastStrain:
    """Return the strain that a frame begins with.

    Args:
        damping: Time tau by which stress runs ahead of strain [s].
        timestep: Of the frame [s].
        position: Vertex positions at t [m].
        garment: Rest mesh.
    """
    corners = gather_corners(position, garment.faces, garment.face_incidence)
    angles, _ = dihedral_angles(position, garment)
    return PastStrain(green_strains(corners, garment), angles, damping / timestep)


def damping_energy(position: Vector3, problem: FrameProblem) -> Float[Array, ""]:
    """Return the dissipation potential of the fabric [J]; zero where the scene has no damping.

    Args:
        position: Candidate positions at t + 1 [m], by components.
        problem: The frame's problem.
    """
    past = problem.strain
    if past is None:
        return jnp.zeros((), position[0].dtype)
    garment, material = problem.garment, problem.material
    strains = green_strains(gather_corners(position, garment.faces, garment.face_incidence), garment)
    change = (strains[0] - past.strains[0], strains[1] - past.strains[1], strains[2] - past.strains[2])
    turned = dihedral_angles(position, garment)[0] - past.angles
    turned = turned - 2.0 * jnp.pi * jnp.round(
        turned / (2.0 * jnp.pi)
    )  # past a complete fold the angle jumps
    stretching = jnp.sum(strain_energies(change, garment, material))
    bending = angle_energy(turned, garment, material)
    return past.rate * (stretching + bending)
