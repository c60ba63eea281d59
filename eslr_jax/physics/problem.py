"""The minimisation problem of one frame: all that its potential reads, constant while the cloth moves."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
from flax import struct
from jax.tree_util import Partial
from jaxtyping import Array, Float

from eslr_jax.contact.layer_edges import LayerPairs
from eslr_jax.contact.self_contact import TipPairs
from eslr_jax.contact.skin import SkinContacts
from eslr_jax.numerics import safe_norm
from eslr_jax.physics.air import AirFlow
from eslr_jax.physics.collision import penetration
from eslr_jax.physics.damping import PastStrain
from eslr_jax.physics.inertia import vertex_masses
from eslr_jax.physics.repulsion import push_apart
from eslr_jax.types import Air, Contacts, Garment, Material, PhysicsConstants

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
    inertial_guess: Float[
        Array, "vertices 3"
    ]  # where inertia alone takes the cloth [m], see `simulation.frame`
    body: BodyContact | None = None
    ground: GroundContact | None = None
    layers: SelfContact | None = None
    air: Air | None = None
    flow: AirFlow | None = None  # of that air, around the faces
    strain: PastStrain | None = None  # None: the fabric has no damping
    energies: tuple[Partial, ...] = ()  # of positions and this problem to joules
    pin_targets: Float[Array, "vertices 3"] | None = None  # positions of pinned vertices at t + 1 [m]
    bdf2: SecondOrder | None = None  # None: implicit Euler

    @property
    def inertial_timestep(self) -> Any:  # NumPy in float64 references
        """Time for which a frame's acceleration acts [s]."""
        return self.timestep if self.bdf2 is None else self.bdf2.timestep

    @property
    def masses(self) -> Float[Array, " vertices"]:
        """Lumped masses [kg], shape [vertices]; zero where padded."""
        return vertex_masses(self.garment, self.material)


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


def push_out(problem: FrameProblem, position: Float[Array, "vertices 3"]) -> Float[Array, "vertices 3"]:
    """Return positions [m], shape [vertices, 3], with vertices inside the body or the ground lifted out of it.

    A vertex goes to the tangent plane of its nearest body point, offset by the contact thickness. The cubic
    collision energy has no curvature at first touch, so a minimiser that begins deep inside only halves the
    depth per iteration. This projection costs little and ends 30 to 2000 times lower in energy.
    """
    position = pin(problem, position)
    if problem.body is not None:
        position = _lifted(position, problem.body.nearest, problem.body.thickness)
    if problem.ground is not None:
        position = _lifted(position, problem.ground.contacts, problem.ground.thickness)
    return pin(problem, position)


def _lifted(
    position: Float[Array, "vertices 3"], contacts: Contacts, thickness: Float[Array, ""] | float
) -> Float[Array, "vertices 3"]:
    """Return positions [m], shape [vertices, 3], a thickness [m] or more above their tangent planes."""
    lift = penetration(position, contacts, thickness)
    return position + lift[:, None] * contacts.next_normals


def separate(problem: FrameProblem, position: Float[Array, "vertices 3"]) -> Float[Array, "vertices 3"]:
    """Return positions [m], shape [vertices, 3], with layers pushed apart and faces pushed off the body's tips.

    Like the body's, their barriers have no curvature at first touch: from deep inside, an iteration of the
    solver only halves the depth.
    """
    if problem.body is not None and problem.body.tips is not None:
        position = push_apart(position, problem.body.tips, problem.constants.collision_thickness)
        position = push_out(problem, position)
    if problem.layers is not None:
        position = push_apart(position, problem.layers.pairs, problem.layers.thickness)
        position = push_out(problem, position)
    return position


def pushed_out_guess(problem: FrameProblem) -> Float[Array, "vertices 3"]:
    """Return the inertial guess [m], pushed out of the body and its layers apart, shape [vertices, 3].

    The initial gap of a frame counts from its energy.
    """
    return separate(problem, push_out(problem, problem.inertial_guess))
