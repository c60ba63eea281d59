"""The incremental potential: the sum of the energies whose minimum is one step of the integrator.

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
| repulsion | between layers of cloth, where they can meet  | none                                        |
| ground    | collision and friction as with the body       | none                                        |
| air       | drag and lift of faces, `physics.air`         | none                                        |
| damping   | of the fabric's strain, `physics.damping`     | none                                        |
| own       | terms that the scene was given                | none                                        |
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from eslr_jax.numerics import Vector3, components
from eslr_jax.physics.air import air_energy
from eslr_jax.physics.bending import bending_energy
from eslr_jax.physics.collision import collision_energy, contact_forces, skin_energy
from eslr_jax.physics.damping import damping_energy
from eslr_jax.physics.friction import friction_energy
from eslr_jax.physics.gravity import gravity_energy
from eslr_jax.physics.inertia import inertia_energy
from eslr_jax.physics.membrane import stretch_energy
from eslr_jax.physics.problem import FrameProblem, pin
from eslr_jax.physics.repulsion import repulsion_energy
from eslr_jax.types import Contacts, PotentialTerms


class Point(NamedTuple):
    """Positions with the potential and its gradient there, so that neither is computed twice."""

    position: Float[Array, "*shape"]  # [m]
    value: Float[Array, ""]  # [J]
    gradient: Float[Array, "*shape"]  # [N]


@jax.jit  # so that it is traced once, where a step evaluates it four times
def potential_terms(position: Float[Array, "vertices 3"], problem: FrameProblem) -> PotentialTerms:
    """Return every energy of the frame [J] (set `consistent`).

    Args:
        position: Candidate positions at t + 1 [m], shape [vertices, 3]. Pinned vertices are put in place first,
            so that the gradient vanishes there.
        problem: The frame's problem.
    """
    position = pin(problem, position)
    x = components(position)  # once: gradients of all terms are then summed by components, and joined once
    local, (on_body, repulsion) = vertex_terms(x, problem), pair_energies(x, problem)
    return local._replace(
        stretch=stretch_energy(x, problem.garment, problem.material),
        bending=bending_energy(x, problem.garment, problem.material),
        collision=local.collision + on_body,
        repulsion=repulsion,
        air=air_energy(x, problem),
        damping=damping_energy(x, problem),
        own=own_energy(position, problem),
    )


def vertex_terms(position: Vector3, problem: FrameProblem) -> PotentialTerms:
    """Return the energies that are sums over single vertices [J]; the others are zero.

    Args:
        position: Candidate positions at t + 1 [m], by components.
        problem: The frame's problem.
    """
    constants = problem.constants
    zero = collision = friction = jnp.zeros((), position[0].dtype)
    planes = []
    if problem.body is not None:
        body = problem.body
        planes += [(contacts, body.thickness) for contacts in (body.nearest, body.opposing)]
        friction += _friction(position, body.nearest, body.friction_load, problem)
    if problem.ground is not None:
        ground = problem.ground
        planes.append((ground.contacts, ground.thickness))
        friction += _friction(position, ground.contacts, ground.friction_load, problem)
    for contacts, thickness in planes:
        stiffness = constants.collision_stiffness
        collision += collision_energy(position, contacts, problem.garment, stiffness, thickness)
    return PotentialTerms(
        stretch=zero,
        bending=zero,
        inertia=inertia_energy(position, problem.inertial_guess, problem.masses, problem.inertial_timestep),
        gravity=gravity_energy(position, problem.position, problem.masses, constants.gravity),
        collision=collision,
        friction=friction,
        repulsion=zero,
        air=zero,
        damping=zero,
        own=zero,
    )


def _friction(
    position: Vector3, contacts: Contacts, load: Float[Array, " vertices"], problem: FrameProblem
) -> Float[Array, ""]:
    """Return the friction energy of a frame with the body, or with the ground [J]."""
    constants = problem.constants
    slip = constants.friction_speed * problem.timestep
    return friction_energy(position, problem.position, contacts, load, constants.friction_coefficient, slip)


def pair_energies(position: Vector3, problem: FrameProblem) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the energies of faces of cloth against the body's vertices, and against cloth [J].

    Args:
        position: Candidate positions at t + 1 [m], by components.
        problem: The frame's problem.
    """
    constants, body, layers = problem.constants, problem.body, problem.layers
    on_body = repulsion = jnp.zeros((), position[0].dtype)
    if body is not None:
        stiffness, thickness = constants.collision_stiffness, constants.collision_thickness
        if body.skin is not None:
            on_body += skin_energy(position, body.skin, stiffness, thickness)
        if body.tips is not None:
            on_body += repulsion_energy(position, body.tips, stiffness, thickness)
    if layers is not None:
        stiffness = constants.repulsion_stiffness
        repulsion = repulsion_energy(position, layers.pairs, stiffness, layers.thickness, layers.limit)
    return on_body, repulsion


def own_energy(position: Float[Array, "vertices 3"], problem: FrameProblem) -> Float[Array, ""]:
    """Return the sum of a user's own terms [J] at positions [m], shape [vertices, 3]; see `SceneOptions`."""
    return sum((energy(position, problem) for energy in problem.energies), jnp.zeros((), position.dtype))


def potential(position: Float[Array, "vertices 3"], problem: FrameProblem) -> Float[Array, ""]:
    """Return the incremental potential [J]: the sum of all terms at positions [m], shape [vertices, 3]."""
    return sum(potential_terms(position, problem))  # type: ignore[return-value]


def evaluate(position: Float[Array, "vertices 3"], problem: FrameProblem) -> Point:
    """Return positions [m], shape [vertices, 3], with the frame's potential and its gradient there."""
    return Point(position, *jax.value_and_grad(potential)(position, problem))


def contact_load(position: Float[Array, "vertices 3"], problem: FrameProblem) -> Float[Array, " vertices"]:
    """Return the normal force of the nearest body point on every vertex [N]; it loads the next frame's friction.

    The force of an opposing body part loads none: between two limbs the nearer one alone rubs.

    Args:
        position: Positions at t + 1 [m], shape [vertices, 3].
        problem: The frame's problem; without a body the forces are zero.
    """
    if problem.body is None:
        return jnp.zeros(position.shape[0], position.dtype)
    body = problem.body
    return contact_forces(
        position, body.nearest, problem.garment, problem.constants.collision_stiffness, body.thickness
    )
