"""A level ground: collision as with the body, and what friction needs to know of it."""

from __future__ import annotations

from collections.abc import Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from eslr_jax.contact.ground import clear_of_ground, ground_contacts
from eslr_jax.errors import ConfigError
from eslr_jax.numerics import Vector3
from eslr_jax.ranges import Range, check_number
from eslr_jax.terms.collision import collision_energies, contact_forces, lifted, penetration
from eslr_jax.terms.problem import (
    CONTACT_STIFFNESS,
    CONTACT_THICKNESS,
    STIFFNESS_RANGE,
    THICKNESS_RANGE,
    FrameProblem,
)
from eslr_jax.terms.stretch import contact_excess
from eslr_jax.terms.term import Term
from eslr_jax.terms.worn import Worn
from eslr_jax.types import Contacts, Garment, Obstacle


class GroundContact(NamedTuple):
    """Contact of the cloth's vertices with the ground during a frame."""

    contacts: Contacts  # the points of the ground under the vertices
    stiffness: Float[Array, ""]  # [J/m^5]


@struct.dataclass
class Ground(Term):
    """A level ground, which no vertex passes.

    Without a height it lies under the lowest point of the moving body, where cloth could reach it. It is flat and
    stands still: no edge dips into it, and where the cloth
    is tells how hard it presses.
    """

    name = "collision"
    on = "vertices"
    unless_needed = "out of reach"
    ranges = MappingProxyType({"stiffness": STIFFNESS_RANGE, "thickness": THICKNESS_RANGE})

    height: Float[Array, ""] | float | None = None  # [m]; None: to be planned
    is_always: bool = struct.field(
        pytree_node=False, default=False
    )  # modelled also where no cloth reaches it
    stiffness: Float[Array, ""] | float = CONTACT_STIFFNESS  # [J/m^5]
    thickness: Float[Array, ""] | float = CONTACT_THICKNESS  # distance that vertices keep [m]

    def check(self) -> None:
        """Check its constants and its height (host)."""
        super().check()
        if self.height is not None:
            check_number("ground height", self.height, Range(-1e3, 1e3, "m"))

    def plan(self, worn: Worn, others: Sequence[Term]) -> Ground | None:
        """Return the ground under the body, or None where no cloth could reach it."""
        if self.height is not None:
            return self.replace(height=np.float32(self.height))
        if not (self.is_always or worn.could_fall() or worn.reaches(worn.lowest_point)):
            return None
        return self.replace(height=np.float32(worn.lowest_point))

    def alike(self, worn: Worn, planned: Sequence[Any]) -> Ground:
        """Return the ground under this scene's body."""
        return self.replace(height=np.float32(worn.lowest_point if self.height is None else self.height))

    def start(
        self, position: Float[Array, "vertices 3"], garment: Garment, body: Obstacle | None
    ) -> Float[Array, "vertices 3"]:
        """Return positions [m] lifted off the ground."""
        height = jnp.asarray(self.height, position.dtype)
        return clear_of_ground(position, height, garment.is_pinned)

    def prepare(self, problem: FrameProblem) -> GroundContact:
        """Return the points of the ground under the vertices."""
        if self.height is None:
            raise ConfigError("a ground without a height; give it one, or take the terms of plan_scene")
        contacts = ground_contacts(problem.position, jnp.asarray(self.height, problem.position.dtype))
        return GroundContact(contacts, self.stiffness * contact_excess(problem.material))

    def corner_energies(
        self, corners: tuple[Vector3, ...], problem: FrameProblem, data: GroundContact
    ) -> Float[Array, " vertices"]:
        """Return the energy of every vertex [J]; see `collision_energies`."""
        return collision_energies(corners[0], data.contacts, problem.garment, data.stiffness, self.thickness)

    def diagonal(self, x: Vector3, problem: FrameProblem, data: GroundContact) -> Float[Array, " vertices"]:
        """Return a third of the curvature along the normal [N/m]."""
        depth = penetration(x, data.contacts, self.thickness)
        return 2.0 * data.stiffness * problem.garment.vertex_areas * depth

    def push_out(
        self, position: Float[Array, "vertices 3"], problem: FrameProblem, data: GroundContact
    ) -> Float[Array, "vertices 3"]:
        """Return positions [m] with vertices lifted out of the ground."""
        return lifted(position, data.contacts, self.thickness)

    def touched(
        self, problem: FrameProblem, data: GroundContact
    ) -> tuple[Contacts, Float[Array, " vertices"]]:
        """Return the points of the ground with the forces at t."""
        limits = data.stiffness, self.thickness
        return data.contacts, contact_forces(problem.position, data.contacts, problem.garment, *limits)

    def describe(self, garment: Garment) -> str:
        """Return where it is."""
        return f"at {float(self.height or 0.0):.2f} m"
