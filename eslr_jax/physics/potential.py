"""The incremental potential: the sum of the energies whose minimum is one step of implicit Euler.

This is energy set `consistent`, which simulates and trains. Set `hood` (`physics.hood`) reproduces HOOD's
published losses for its tables. Side by side, from x_t to x_{t+1}:

| term      | `consistent`                                  | `hood`                                      |
|-----------|-----------------------------------------------|---------------------------------------------|
| stretch   | StVK: A h (mu tr G^2 + lambda/2 tr(G)^2)      | the same                                    |
| bending   | k l^2 / (4 sum A) theta^2 / 2, l at rest      | l of the predicted mesh, differentiated     |
| inertia   | m abs(x - x_t - dt v)^2 / (2 dt^2)            | with dt v = x_t - x_{t-1}; pins count       |
| gravity   | m g height above x_t                          | m g height above the world's origin         |
| collision | k a max(eps - d, 0)^3, a vertex area [J/m^5]  | w max(eps - d, 0)^3 per vertex [J/m^3]      |
|   plane   | of the closest point on the triangles, smooth | of the face whose centroid is nearest       |
|           | normal; found at t, carried to t + 1          | found at t or, in tables, at t + 1          |
|   eps     | 2 mm plus the sagitta of the mesh's edges     | 2 mm in training, 1 mm in tables            |
|   sides   | also the body part on the cloth's other side  | one                                         |
| friction  | mu N (sqrt(u^2 + s^2) - s), N contact force   | mu m g s abs(u) within 5.5 cm, whatever the |
|           | at t, u in the tangent plane                  | contact force; s a slope against the z axis |
|   motion  | of the body under the vertex, t to t + 1      | of a face centroid, t - 1 to t in training  |
| repulsion | between layers of cloth, on request           | none                                        |
"""

from __future__ import annotations

from typing import NamedTuple

from jaxtyping import Array, Float

from eslr_jax.physics.bending import bending_energy
from eslr_jax.physics.collision import collision_energy, contact_forces
from eslr_jax.physics.friction import friction_energy
from eslr_jax.physics.gravity import gravity_energy
from eslr_jax.physics.inertia import inertia_energy, vertex_masses
from eslr_jax.physics.membrane import stretch_energy
from eslr_jax.physics.problem import FrameProblem, pin
from eslr_jax.physics.repulsion import repulsion_energy
from eslr_jax.types import Garment, Material


class PotentialTerms(NamedTuple):
    """The energies of one frame [J]."""

    stretch: Float[Array, ""]
    bending: Float[Array, ""]
    inertia: Float[Array, ""]
    gravity: Float[Array, ""]
    collision: Float[Array, ""] | float
    friction: Float[Array, ""] | float
    repulsion: Float[Array, ""] | float = 0.0  # of self-contact


def potential_terms(
    position: Float[Array, "vertices 3"], problem: FrameProblem, garment: Garment, material: Material
) -> PotentialTerms:
    """Return every energy of the frame at `position` (set `consistent`).

    Args:
        position: Candidate positions at t + 1 [m]; pinned vertices are put in place first, so that the
            gradient vanishes there.
        problem: What the frame holds constant.
        garment: Rest mesh.
        material: Fabric.
    """
    position = pin(problem, garment, position)
    parameters, contacts = problem.parameters, problem.contacts
    masses = vertex_masses(garment, material)
    collision: Float[Array, ""] | float = 0.0
    friction: Float[Array, ""] | float = 0.0
    if contacts is not None:
        assert problem.friction_load is not None
        assert problem.collision_thickness is not None
        collision = collision_energy(
            position, contacts, garment, parameters.collision_stiffness, problem.collision_thickness
        )
        if problem.opposing is not None:
            collision = collision + collision_energy(
                position,
                problem.opposing,
                garment,
                parameters.collision_stiffness,
                problem.collision_thickness,
            )
        if problem.tips is not None:
            collision = collision + repulsion_energy(
                position,
                problem.tips,
                parameters.collision_stiffness,
                parameters.collision_thickness,
                problem.next_body,
            )
        friction = friction_energy(
            position,
            problem.position,
            contacts,
            problem.friction_load,
            parameters.friction_coefficient,
            parameters.friction_speed * problem.timestep,
        )
    repulsion: Float[Array, ""] | float = 0.0
    if problem.self_contacts is not None:
        assert problem.repulsion_thickness is not None
        repulsion = repulsion_energy(
            position,
            problem.self_contacts,
            parameters.repulsion_stiffness,
            problem.repulsion_thickness,
        )
    return PotentialTerms(
        stretch=stretch_energy(position, garment, material),
        bending=bending_energy(position, garment, material),
        inertia=inertia_energy(position, problem.inertial_guess, masses, problem.timestep),
        gravity=gravity_energy(position, problem.position, masses, parameters.gravity),
        collision=collision,
        friction=friction,
        repulsion=repulsion,
    )


def potential(
    position: Float[Array, "vertices 3"], problem: FrameProblem, garment: Garment, material: Material
) -> Float[Array, ""]:
    """Return the incremental potential [J]: the sum of all terms."""
    return sum(potential_terms(position, problem, garment, material))  # type: ignore[return-value]


def next_friction_load(
    position: Float[Array, "vertices 3"], problem: FrameProblem, garment: Garment
) -> Float[Array, " vertices"]:
    """Return the contact force at t + 1 [N], which loads the next frame's friction."""
    assert problem.contacts is not None
    assert problem.collision_thickness is not None
    parameters = problem.parameters
    return contact_forces(
        position, problem.contacts, garment, parameters.collision_stiffness, problem.collision_thickness
    )
