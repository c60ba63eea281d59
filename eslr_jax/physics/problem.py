"""The minimisation problem of one frame: everything that stays constant while its cloth moves."""

from __future__ import annotations

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from eslr_jax.contact.self_contact import FacePairs
from eslr_jax.physics.repulsion import push_apart
from eslr_jax.types import ClothState, Contacts, Garment

_LIMB_RADIUS = 0.05  # [m], of an upper arm or a shoulder: the sharpest that cloth rests on


@struct.dataclass
class PhysicsParameters:
    """Constants of the scene; traced, so that changing one does not compile anew."""

    gravity: Float[Array, ""] | float = 9.81  # [m/s^2], along -y
    collision_stiffness: Float[Array, ""] | float = 3.5e7
    """[J/m^5] per cloth area: HOOD's weight of 5e3 J/m^3 a vertex on its 4424-vertex, 0.628 m^2 T-shirt."""
    collision_thickness: Float[Array, ""] | float = 2e-3  # [m] (HOOD), see `contact_thickness`
    friction_coefficient: Float[Array, ""] | float = 0.5  # (HOOD)
    friction_speed: Float[Array, ""] | float = 9e-4
    """[m/s] below which friction sticks: creep on a 20 degree slope stays under 1 mm/s at 0.5."""
    repulsion_stiffness: Float[Array, ""] | float = 3.5e7  # [J/m^5], between layers of cloth; as for the body
    repulsion_thickness: Float[Array, ""] | float = 3e-3  # [m] (ContourCraft)


@struct.dataclass
class FrameProblem:
    """One step of implicit Euler as a minimisation."""

    position: Float[Array, "vertices 3"]  # at t [m]
    inertial_guess: Float[Array, "vertices 3"]  # position + timestep * velocity [m]
    timestep: Float[Array, ""]  # [s]
    pin_targets: Float[Array, "vertices 3"] | None  # positions of pinned vertices at t + 1; None: no pins
    contacts: Contacts | None  # None: no body in the scene
    friction_load: Float[Array, " vertices"] | None  # normal force at t [N]
    collision_thickness: Float[Array, ""] | None  # of `contact_thickness` [m]
    parameters: PhysicsParameters
    opposing: Contacts | None = None  # with the body part on the other side of the cloth; None without a body
    self_contacts: FacePairs | None = None  # None: layers of cloth pass through each other
    repulsion_thickness: Float[Array, ""] | None = None  # between layers, likewise [m]
    tips: FacePairs | None = None  # of body vertices with the cloth; None: a tip may pass between vertices
    next_body: Float[Array, "surface_vertices 3"] | None = None  # at t + 1 [m], where there are tips


def contact_thickness(garment: Garment, thickness: Float[Array, ""] | float) -> Float[Array, ""]:
    """Return the distance that vertices keep from the body, or from other layers of cloth [m].

    Only vertices collide. Between two of them a straight edge of length l dips l^2 / (8 r) towards a limb of
    radius r, so that much is added to the thickness: at 27 mm spacing (1k vertices) 1.8 mm, at 13 mm 0.4 mm.
    """
    mean_area = jnp.sum(garment.vertex_areas) / jnp.sum(garment.vertex_mask)
    squared_edge = 2.0 / jnp.sqrt(3.0) * mean_area  # of equilateral triangles, two per vertex
    return thickness + squared_edge / (8.0 * _LIMB_RADIUS)


def make_problem(
    garment: Garment,
    state: ClothState,
    contacts: Contacts | None,
    pin_targets: Float[Array, "vertices 3"] | None,
    timestep: Float[Array, ""],
    parameters: PhysicsParameters,
    self_contacts: FacePairs | None = None,
    opposing: Contacts | None = None,
    tips: FacePairs | None = None,
    next_body: Float[Array, "surface_vertices 3"] | None = None,
) -> FrameProblem:
    """Collect what one frame's potential depends on.

    Args:
        garment: Rest mesh.
        state: Cloth at time t.
        contacts: Nearest body points of every vertex, or None without a body.
        pin_targets: Where pinned vertices are at t + 1, or None without pins.
        timestep: Duration of the frame [s].
        parameters: Constants of the scene.
        self_contacts: Pairs of vertices and faces of the cloth that are close, or None.
        opposing: Contacts with the body part on the other side of the cloth, or None.
        tips: Pairs of body vertices and faces of the cloth that are close, or None.
        next_body: Body vertices at t + 1 [m]; needed with tips.
    """
    return FrameProblem(
        position=state.position,
        inertial_guess=state.position + timestep * state.velocity,
        timestep=timestep,
        pin_targets=pin_targets,
        contacts=contacts,
        friction_load=None if contacts is None else state.friction_load,
        collision_thickness=(
            None if contacts is None else contact_thickness(garment, parameters.collision_thickness)
        ),
        parameters=parameters,
        opposing=opposing,
        self_contacts=self_contacts,
        repulsion_thickness=(
            None if self_contacts is None else contact_thickness(garment, parameters.repulsion_thickness)
        ),
        tips=tips,
        next_body=None if tips is None else next_body,
    )


def pin(
    problem: FrameProblem, garment: Garment, position: Float[Array, "vertices 3"]
) -> Float[Array, "vertices 3"]:
    """Put pinned vertices where the body carries them."""
    if problem.pin_targets is None:
        return position
    return jnp.where(garment.is_pinned[:, None], problem.pin_targets, position)


def push_out(
    problem: FrameProblem, garment: Garment, position: Float[Array, "vertices 3"]
) -> Float[Array, "vertices 3"]:
    """Move vertices onto the offset tangent plane of their nearest body point where they are behind it.

    The cubic collision energy has no curvature at first touch, so a minimiser that starts deep inside only
    halves the depth per iteration; this start costs nothing and is 30 to 2000 times lower in energy.
    """
    position = pin(problem, garment, position)
    contacts = problem.contacts
    if contacts is None:
        return position
    assert problem.collision_thickness is not None
    height = jnp.sum((position - contacts.next_points) * contacts.next_normals, axis=-1)
    lift = jnp.maximum(problem.collision_thickness - height, 0.0)
    lift = jnp.where(contacts.is_near, lift, 0.0)
    return pin(problem, garment, position + lift[:, None] * contacts.next_normals)


def start_guess(problem: FrameProblem, garment: Garment) -> Float[Array, "vertices 3"]:
    """Return the inertial guess pushed out of the body: the best cheap start that was found.

    With self-contact its layers are pushed apart as well, and its faces off the body's tips.
    """
    return separate(problem, garment, push_out(problem, garment, problem.inertial_guess))


def separate(
    problem: FrameProblem, garment: Garment, position: Float[Array, "vertices 3"]
) -> Float[Array, "vertices 3"]:
    """Push layers apart and faces off the body's tips, as far as the scene has either.

    Like the body's, their barriers have no curvature at first touch: from deep inside, an iteration of the solver
    only halves the depth.
    """
    parameters = problem.parameters
    if problem.tips is not None:
        position = push_apart(position, problem.tips, parameters.collision_thickness, problem.next_body)
        position = push_out(problem, garment, position)
    if problem.self_contacts is not None:
        assert problem.repulsion_thickness is not None
        position = push_apart(position, problem.self_contacts, problem.repulsion_thickness)
        position = push_out(problem, garment, position)
    return position
