"""Coulomb friction against the moving body, smoothed where it sticks."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from eslr_jax.numerics import Vector3, components, dot3, in_memory, sub3
from eslr_jax.terms.problem import FrameProblem
from eslr_jax.terms.term import Term
from eslr_jax.types import Contacts


@struct.dataclass
class Friction(Term):
    """Friction with the body and with the ground."""

    name = "friction"
    on = "vertices"

    def corner_energies(
        self, corners: tuple[Vector3, ...], problem: FrameProblem, data: Any
    ) -> Float[Array, " vertices"]:
        """Return the energy of every vertex [J]; see `friction_energies`."""
        slip = _slip(problem)
        energies = [
            friction_energies(corners[0], problem.position, contacts, pressing, slip)
            for contacts, pressing in _touching(problem)
        ]
        return sum(energies, jnp.zeros_like(corners[0][0]))

    def diagonal(self, x: Vector3, problem: FrameProblem, data: Any) -> Float[Array, " vertices"] | float:
        """Return the curvature where the cloth sticks [N/m]; along two of three axes, with its force spread."""
        return sum((pressing / (3.0 * _slip(problem)) for _, pressing in _touching(problem)), 0.0)


def _slip(problem: FrameProblem) -> Float[Array, ""]:
    """Return the distance in a frame below which friction acts like a spring [m]."""
    return problem.constants.friction_speed * problem.timestep


def _touching(problem: FrameProblem) -> Iterator[tuple[Contacts, Float[Array, " vertices"]]]:
    """Return what the cloth rubs against, with the greatest friction force of every vertex [N]."""
    for touched, contacts in (
        (problem.body, None if problem.body is None else problem.body.nearest),
        (problem.ground, None if problem.ground is None else problem.ground.contacts),
    ):
        if touched is not None and contacts is not None:
            yield contacts, problem.constants.friction_coefficient * touched.friction_load


def friction_energies(
    position: Float[Array, "vertices 3"] | Vector3,
    start: Float[Array, "vertices 3"],
    contacts: Contacts,
    force: Float[Array, " vertices"],
    slip: Float[Array, ""] | float,
) -> Float[Array, " vertices"]:
    """Return mu N_v (sqrt(|u_v|^2 + s^2) - s) of every vertex [J], whose force tends to mu N_v against the slip.

    u is the motion relative to the body point under the vertex, within the true tangent plane at t + 1.

    Args:
        position: Vertex positions at t + 1 [m].
        start: Vertex positions at t [m].
        contacts: Body points at t and t + 1.
        force: Coulomb's mu times the normal force N [N], lagged: the contact force at t, so that the energy
            stays a potential.
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
    (force,) = in_memory(force)
    return force * squared / (jnp.sqrt(squared + slip * slip) + slip)
