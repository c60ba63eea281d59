"""A level ground: collision as with the body, and what friction needs to know of it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from eslr_jax.contact.ground import clear_of_ground, ground_contacts
from eslr_jax.errors import ConfigError
from eslr_jax.ranges import Range, check_number
from eslr_jax.terms.collision import Barrier, BodyContact, contact_forces
from eslr_jax.terms.stretch import contact_excess
from eslr_jax.terms.term import CONTACT_STIFFNESS, CONTACT_THICKNESS, FrameProblem, Term
from eslr_jax.terms.worn import Worn
from eslr_jax.types import Contacts, Garment, Obstacle


@struct.dataclass
class Ground(Barrier):
    """A level ground, which no vertex passes.

    Without a height it lies under the lowest point of the moving body, where cloth could reach it. It is flat and
    stands still: no edge dips into it, and where the cloth is tells how hard it presses.
    """

    unless_needed = "out of reach"

    height: Float[Array, ""] | float | None = None  # [m]; None: to be planned
    # Modelled also where no cloth reaches it.
    is_always: bool = struct.field(pytree_node=False, default=False)
    stiffness: Float[Array, ""] | float = CONTACT_STIFFNESS  # [J/m^5]
    thickness: Float[Array, ""] | float = CONTACT_THICKNESS  # distance that vertices keep [m]

    def check(self) -> None:
        """Check its constants and its height (host)."""
        super().check()
        if self.height is not None:
            check_number("ground height", self.height, Range(-1e3, 1e3, "m"))

    def plan(self, worn: Worn, others: Sequence[Term]) -> Ground | None:
        """Return the ground under the body, or None where no cloth could reach it."""
        is_needed = self.height is not None or self.is_always or worn.could_fall()
        return self.alike(worn, ()) if is_needed or worn.reaches(worn.lowest_point) else None

    def alike(self, worn: Worn, planned: Sequence[Any]) -> Ground:
        """Return the ground under this scene's body."""
        return self.replace(height=np.float32(worn.lowest_point if self.height is None else self.height))

    def start(
        self, position: Float[Array, "vertices 3"], garment: Garment, body: Obstacle | None
    ) -> Float[Array, "vertices 3"]:
        """Return positions [m] lifted off the ground."""
        height = jnp.asarray(self.height, position.dtype)
        return clear_of_ground(position, height, garment.is_pinned)

    def prepare(self, problem: FrameProblem) -> BodyContact:
        """Return the points of the ground under the vertices."""
        if self.height is None:
            raise ConfigError("a ground without a height; give it one, or take the terms of plan_scene")
        contacts = ground_contacts(problem.position, jnp.asarray(self.height, problem.position.dtype))
        return BodyContact(contacts, None, self.thickness, self.stiffness * contact_excess(problem.material))

    def touched(self, problem: FrameProblem, data: BodyContact) -> tuple[Contacts, Float[Array, " vertices"]]:
        """Return the points of the ground with the forces at t."""
        limits = problem.garment, data.stiffness, data.thickness
        return data.nearest, contact_forces(problem.position, data.nearest, *limits)

    def describe(self, garment: Garment) -> str:
        """Return where it is."""
        return f"at {float(self.height or 0.0):.2f} m"
