"""The minimisation problem of one frame: all that its potential reads, constant while the cloth moves."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from eslr_jax.contact.layer_edges import LayerPairs
from eslr_jax.contact.self_contact import TipPairs
from eslr_jax.contact.skin import SkinContacts
from eslr_jax.numerics import safe_norm
from eslr_jax.terms.term import Term
from eslr_jax.types import Contacts, Garment, Material, PhysicsConstants

_LIMB_RADIUS = 0.05  # [m], of an upper arm or a shoulder: the sharpest that cloth rests on


@struct.dataclass
class BodyContact:
    """Contact of the cloth's vertices with the body."""

    nearest: Contacts
    opposing: Contacts  # with the body part on the other side of the cloth
    friction_load: Float[Array, " vertices"]  # normal force at t [N]
    thickness: Float[Array, ""]  # distance kept [m], of `contact_thickness`
    skin: SkinContacts | None = None  # None: skin may show between vertices
    tips: TipPairs | None = None  # None: a tip may pass between vertices


@struct.dataclass
class GroundContact:
    """Contact of the cloth's vertices with a level ground."""

    contacts: Contacts  # the points of the ground under the vertices
    friction_load: Float[Array, " vertices"]  # normal force at t [N]
    thickness: Float[Array, ""] | float  # distance kept [m]


@struct.dataclass
class SelfContact:
    """Contact between layers of the cloth."""

    pairs: LayerPairs
    thickness: Float[Array, " pairs"]  # distance kept [m], see `simulation.frame`
    limit: Float[Array, ""]  # overlap beyond which the force grows no further [m]


class SecondOrder(NamedTuple):
    """What BDF2 puts in the place of a frame's first positions and timestep, see `simulation.frame`."""

    origin: Float[Array, "vertices 3"]  # [m]
    timestep: Float[Array, ""]  # [s]


@struct.dataclass
class FrameProblem:
    """One step of implicit Euler, or of BDF2, as a minimisation. A part that is None is not modelled."""

    garment: Garment
    material: Material
    constants: PhysicsConstants
    timestep: Float[Array, ""]  # [s]
    position: Float[Array, "vertices 3"]  # at t [m]
    # Where inertia alone takes the cloth [m], see `simulation.frame`.
    inertial_guess: Float[Array, "vertices 3"]
    time: Float[Array, ""] | float = 0.0  # at t + 1, since the scene's first frame [s]
    body: BodyContact | None = None
    ground: GroundContact | None = None
    layers: SelfContact | None = None
    pin_targets: Float[Array, "vertices 3"] | None = None  # positions of pinned vertices at t + 1 [m]
    bdf2: SecondOrder | None = None  # None: implicit Euler
    terms: tuple[Term, ...] = ()  # whose sum is the potential
    data: tuple[Any, ...] = ()  # what each of them has prepared, see `with_terms`

    @property
    def inertial_timestep(self) -> Any:  # NumPy in float64 references
        """Time for which a frame's acceleration acts [s]."""
        return self.timestep if self.bdf2 is None else self.bdf2.timestep

    @property
    def origin(self) -> Float[Array, "vertices 3"]:
        """Positions from which a frame's velocity counts [m]: those at t, or what BDF2 puts in their place."""
        return self.position if self.bdf2 is None else self.bdf2.origin

    @property
    def masses(self) -> Float[Array, " vertices"]:
        """Lumped masses [kg], shape [vertices]; zero where padded."""
        return vertex_masses(self.garment, self.material)


def vertex_masses(garment: Garment, material: Material) -> Float[Array, " vertices"]:
    """Return lumped masses [kg]; zero for padded vertices."""
    return material.density * garment.vertex_areas


def with_terms(problem: FrameProblem, terms: tuple[Term, ...]) -> FrameProblem:
    """Return a problem whose potential is the sum of some terms, each prepared for the frame."""
    return problem.replace(terms=terms, data=tuple(term.prepare(problem) for term in terms))


def contact_thickness(garment: Garment, thickness: Float[Array, ""] | float) -> Float[Array, ""]:
    """Return the distance that vertices keep from the body, or from other layers of cloth [m].

    Only vertices collide. Between two of them a straight edge of length l dips l^2 / (8 r) towards a limb of
    radius r, so that much is added to the thickness: at 27 mm spacing (1k vertices) 1.8 mm, at 13 mm 0.4 mm.

    Args:
        garment: Rest mesh; its mean vertex area gives the spacing.
        thickness: Distance that a smooth sheet would keep [m].
    """
    squared_edge = 2.0 / jnp.sqrt(3.0) * garment.mean_vertex_area  # of equilateral triangles, two per vertex
    return thickness + squared_edge / (8.0 * _LIMB_RADIUS)


def weight_norm(problem: FrameProblem) -> Float[Array, ""]:
    """Return the norm of the vertices' weights [N], the unit of residuals."""
    return problem.constants.gravity * safe_norm(problem.masses)


def pin(problem: FrameProblem, position: Float[Array, "vertices 3"]) -> Float[Array, "vertices 3"]:
    """Return positions [m], shape [vertices, 3], with pinned vertices where the body carries them."""
    if problem.pin_targets is None:
        return position
    return jnp.where(problem.garment.is_pinned[:, None], problem.pin_targets, position)
