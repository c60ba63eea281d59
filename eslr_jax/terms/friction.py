"""Coulomb friction against the moving body and between layers, smoothed where it sticks."""

from __future__ import annotations

from collections.abc import Sequence
from types import MappingProxyType
from typing import NamedTuple

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from eslr_jax.numerics import Vector3, components, dot3, in_memory, sub3
from eslr_jax.ranges import Range
from eslr_jax.terms.term import FrameProblem, Term
from eslr_jax.terms.worn import Worn
from eslr_jax.types import Contacts


class Rubbing(NamedTuple):
    """What the cloth rubs against."""

    contacts: Contacts
    force: Float[Array, " vertices"]  # Coulomb's greatest friction force of every vertex [N]


@struct.dataclass
class Friction(Term):
    """Friction with what the terms before it say that the cloth touches: the body and the ground.

    Pairs of `Contact` rub with the same constants; their energy is counted there.
    """

    name = "friction"
    on = "vertices"
    unless_needed = "nothing in reach to rub on"
    ranges = MappingProxyType(
        {"coefficient": Range(0.0, 10.0), "speed": Range(1e-6, 1.0, "m/s")}  # not zero: it divides
    )

    coefficient: Float[Array, ""] | float = 0.5  # (HOOD)
    # [m/s] below which friction sticks: creep on a 20 degree slope stays under 1 mm/s at 0.5.
    speed: Float[Array, ""] | float = 9e-4

    def plan(self, worn: Worn, others: Sequence[Term]) -> Friction | None:
        """Return itself, or None where no term before it touches anything, and no layer another one."""
        is_touched = any(type(term).touched is not Term.touched for term in others)
        return self if is_touched or worn.num_pieces > 1 else None

    def prepare(self, problem: FrameProblem) -> tuple[Rubbing, ...]:
        """Return all that the cloth rubs against."""
        touched = (term.touched(problem, data) for term, data in problem.parts)
        return tuple(Rubbing(one[0], self.coefficient * one[1]) for one in touched if one is not None)

    def corner_energies(
        self, corners: tuple[Vector3, ...], problem: FrameProblem, data: tuple[Rubbing, ...]
    ) -> Float[Array, " vertices"]:
        """Return the energy of every vertex [J]; see `friction_energies`."""
        slip = self.slip(problem)
        energies = [friction_energies(corners[0], problem.position, *rubbing, slip) for rubbing in data]
        return sum(energies, jnp.zeros_like(corners[0][0]))

    def diagonal(
        self, x: Vector3, problem: FrameProblem, data: tuple[Rubbing, ...]
    ) -> Float[Array, " vertices"] | float:
        """Return the curvature where the cloth sticks [N/m]; along two of three axes, with its force spread."""
        return sum((rubbing.force / (3.0 * self.slip(problem)) for rubbing in data), 0.0)

    def slip(self, problem: FrameProblem) -> Float[Array, ""]:
        """Return the distance in a frame below which friction acts like a spring [m]."""
        return self.speed * problem.timestep


def friction_energies(
    position: Float[Array, "vertices 3"] | Vector3,
    start: Float[Array, "vertices 3"],
    contacts: Contacts,
    force: Float[Array, " vertices"],
    slip: Float[Array, ""] | float,
) -> Float[Array, " vertices"]:
    """Return mu N_v (sqrt(|u_v|^2 + s^2) - s) of every vertex [J], whose force tends to mu N_v against the slip.

    u is the motion from `start`, at t, to `position`, at t + 1 [m], relative to the body point under the vertex,
    within the true tangent plane at t + 1. `force` is Coulomb's mu times the normal force N [N], lagged: the
    contact force at t, so that the energy stays a potential. `slip` is the distance s [m] below which friction is
    a spring.

    Source: lagged friction as in Li et al. 2020 (IPC), doi 10.1145/3386569.3392425, eq. 15.
    """
    body_motion = sub3(components(contacts.next_points), components(contacts.points))
    motion = sub3(sub3(components(position), components(start)), body_motion)
    return slip_energies(motion, components(contacts.next_normals), force, slip)


def slip_energies(
    motion: Vector3, normal: Vector3, force: Float[Array, " rows"], slip: Float[Array, ""] | float
) -> Float[Array, " rows"]:
    """Return the energies of `friction_energies` [J], from relative motions [m] and unit normals."""
    along_normal = dot3(motion, normal)
    x, y, z = (part - along_normal * axis for part, axis in zip(motion, normal, strict=True))
    tangential = x, y, z
    squared = dot3(tangential, tangential)
    # squared / (sqrt(squared + s^2) + s) equals sqrt(squared + s^2) - s without its cancellation.
    (force,) = in_memory(force)
    return force * squared / (jnp.sqrt(squared + slip * slip) + slip)
