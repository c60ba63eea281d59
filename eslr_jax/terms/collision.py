"""Collision with the body and the ground: a one-sided cubic barrier."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from eslr_jax.contact.skin import SkinContacts, skin_heights
from eslr_jax.numerics import Vector3, components, dot3, in_memory, segment_sum, sub3
from eslr_jax.terms.problem import FrameProblem
from eslr_jax.terms.term import Elements, Term
from eslr_jax.types import Contacts, Garment


@struct.dataclass
class Collision(Term):
    """Vertices against the tangent planes of the body's nearest points, on both sides, and of the ground's."""

    name = "collision"
    on = "vertices"

    def corner_energies(
        self, corners: tuple[Vector3, ...], problem: FrameProblem, data: Any
    ) -> Float[Array, " vertices"]:
        """Return the energy of every vertex [J]; see `collision_energies`."""
        stiffness = problem.constants.collision_stiffness
        energies = [
            collision_energies(corners[0], contacts, problem.garment, stiffness, thickness)
            for contacts, thickness in _planes(problem)
        ]
        return sum(energies, jnp.zeros_like(corners[0][0]))

    def diagonal(self, x: Vector3, problem: FrameProblem, data: Any) -> Float[Array, " vertices"] | float:
        """Return a third of the curvature along the normal [N/m]: it acts along one of three axes."""
        stiffness = 2.0 * problem.constants.collision_stiffness * problem.garment.vertex_areas
        return sum((stiffness * penetration(x, *plane) for plane in _planes(problem)), 0.0)


def _planes(problem: FrameProblem) -> Iterator[tuple[Contacts, Float[Array, ""] | float]]:
    """Return the planes that the vertices keep off, with the distance that they keep [m]."""
    if problem.body is not None:
        yield problem.body.nearest, problem.body.thickness
        yield problem.body.opposing, problem.body.thickness
    if problem.ground is not None:
        yield problem.ground.contacts, problem.ground.thickness


@struct.dataclass
class SkinCollision(Term):
    """Places of the body against the faces of cloth over them, so that no skin shows between vertices."""

    name = "collision"

    def elements(self, x: Vector3, problem: FrameProblem, data: Any) -> tuple[Elements, ...]:
        """Return stiffness a_p max(thickness - d_p, 0)^3 of places p of the body under the cloth [J]."""
        skin, constants = _skin(problem), problem.constants
        distances = constants.collision_stiffness, constants.collision_thickness
        return (Elements(skin_energies(x, skin, *distances), skin.corners),)

    def diagonal(self, x: Vector3, problem: FrameProblem, data: Any) -> Float[Array, " vertices"]:
        """Return a third of the curvature along the normal [N/m]."""
        skin, constants = _skin(problem), problem.constants
        return skin_diagonal(x, skin, constants.collision_stiffness, constants.collision_thickness)

    def describe(self, garment: Garment) -> str:
        """Return what touches what."""
        return "faces off the skin"


def _skin(problem: FrameProblem) -> SkinContacts:
    return problem.body.skin  # type: ignore[union-attr, return-value]: a scene with this term has found them


def penetration(
    position: Float[Array, "vertices 3"] | Vector3, contacts: Contacts, thickness: Float[Array, ""] | float
) -> Float[Array, " vertices"]:
    """Return max(thickness - d, 0) [m], d the height over the tangent plane at t + 1; zero where far."""
    offset = sub3(components(position), components(contacts.next_points))
    height = dot3(offset, components(contacts.next_normals))
    return jnp.where(contacts.is_near, jnp.maximum(thickness - height, 0.0), 0.0)


def collision_energies(
    position: Float[Array, "vertices 3"] | Vector3,
    contacts: Contacts,
    garment: Garment,
    stiffness: Float[Array, ""] | float,
    thickness: Float[Array, ""] | float,
) -> Float[Array, " vertices"]:
    """Return stiffness a_v max(thickness - d_v, 0)^3 of every vertex [J].

    Weighting by the vertex area a_v makes the energy independent of resolution; HOOD sums over vertices.

    Args:
        position: Vertex positions at t + 1 [m].
        contacts: The nearest body point of each vertex at t, carried to t + 1 by the body.
        garment: Vertex areas [m^2].
        stiffness: [J/m^5].
        thickness: Distance kept from the body [m].

    Source: HOOD (arXiv 2212.07242), with the closest point on the triangle in place of its centroid.
    """
    depth = penetration(position, contacts, thickness)
    (areas,) = in_memory(stiffness * garment.vertex_areas)
    return areas * depth * depth * depth


def skin_depths(
    position: Float[Array, "vertices 3"] | Vector3, skin: SkinContacts, thickness: Float[Array, ""] | float
) -> Float[Array, " rows"]:
    """Return max(thickness - d, 0) [m], d the height of the cloth's face over the skin; zero where far."""
    return jnp.where(skin.is_near, jnp.maximum(thickness - skin_heights(position, skin), 0.0), 0.0)


def skin_energies(
    position: Float[Array, "vertices 3"] | Vector3,
    skin: SkinContacts,
    stiffness: Float[Array, ""] | float,
    thickness: Float[Array, ""] | float,
) -> Float[Array, " rows"]:
    """Return stiffness a_p max(thickness - d_p, 0)^3 of every place p of the body under the cloth [J].

    Args:
        position: Vertex positions at t + 1 [m].
        skin: Places of the body, the places of the cloth over them, and the areas a_p.
        stiffness: [J/m^5].
        thickness: Distance kept from the body [m].

    Source: the barrier is `collision_energies`'.
    """
    depth = skin_depths(position, skin, thickness)
    (areas,) = in_memory(stiffness * skin.areas)
    return areas * depth * depth * depth


def skin_diagonal(
    position: Float[Array, "vertices 3"] | Vector3,
    skin: SkinContacts,
    stiffness: Float[Array, ""] | float,
    thickness: Float[Array, ""] | float,
) -> Float[Array, " vertices"]:
    """Return an estimate of the curvature per vertex [N/m], a third of that along the normal."""
    values = (
        skin.weights**2 * (2.0 * stiffness * skin.areas * skin_depths(position, skin, thickness))[:, None]
    )
    num_vertices = components(position)[0].shape[0]
    return segment_sum(values.T.ravel(), skin.corners.T.ravel(), num_vertices)


def contact_forces(
    position: Float[Array, "vertices 3"],
    contacts: Contacts,
    garment: Garment,
    stiffness: Float[Array, ""] | float,
    thickness: Float[Array, ""] | float,
) -> Float[Array, " vertices"]:
    """Return the normal force on every vertex [N], the negative derivative of its collision energy."""
    depth = penetration(position, contacts, thickness)
    return 3.0 * stiffness * garment.vertex_areas * depth * depth
