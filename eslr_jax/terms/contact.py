"""Contact: cloth keeps off the body and off itself, and nothing passes through anything."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int

from eslr_jax.contact import course as courses
from eslr_jax.contact.course import Around, Course
from eslr_jax.contact.lists import Meshes, joint_meshes
from eslr_jax.contact.nearest import clear_of_body, find_contacts
from eslr_jax.contact.pairs import CHUNK, Rows, diagonal, energies, energy, loads
from eslr_jax.errors import Status
from eslr_jax.numerics import Vector3, vertex_normals
from eslr_jax.terms.problem import CONTACT_STIFFNESS, STIFFNESS_RANGE, THICKNESS_RANGE, FrameProblem
from eslr_jax.terms.stretch import contact_excess
from eslr_jax.terms.term import Domain, Elements, Term, sum_elements
from eslr_jax.terms.worn import Worn, parted_body
from eslr_jax.types import BodyMotion, Contacts, Garment, Obstacle

_FADES = 0.02  # [m] from the body, beyond which it takes cloth along less and less
_FADING = 0.05  # [m] over which it does, or half as much more than the body moves in a frame
_SMOOTHINGS = 4  # of the motion by which the body takes cloth along
_GROWTH = 16e-3  # [m] under its skin, from which a body grows at the start: edges of the cloth dip in less
_WIDE_ROWS, _FINE_ROWS = 64, 4  # per vertex of the cloth, of the tables that a scene begins with


class ContactData(NamedTuple):
    """Contact during a frame."""

    around: Around
    nearest: Contacts | None  # of the body; friction and networks read it
    stiffness: Float[Array, ""]  # [J/m^5]
    course: Course


@struct.dataclass
class Contact(Term):
    """Vertices keep off faces, and edges off edges, of the cloth and of the body.

    Steps are cut so that no pair passes through another. It takes the place of `Collision` and `Repulsion`, at
    several times their cost. The body yields where its own parts pass through each other (`mesh.parting`).
    Where that does not make room, cloth is let through, and the status says so.
    """

    name = "contact"
    reads_body = True
    ranges = MappingProxyType({"stiffness": STIFFNESS_RANGE, "reach": THICKNESS_RANGE})

    stiffness: Float[Array, ""] | float = CONTACT_STIFFNESS  # [J/m^5]
    reach: Float[Array, ""] | float = 3e-3  # [m] below which a pair acts
    # Which layers of cloth keep apart: those of different pieces, or also those of one piece.
    layers: Literal["pieces", "all"] = struct.field(pytree_node=False, default="all")
    rows: tuple[int, int] | None = struct.field(pytree_node=False, default=None)
    pieces: Int[Array, " vertices"] | None = None
    # [m] by which cloth that the first pose folds through itself is moved, see `mesh.parting.uncrossed`
    unfolding: Float[Array, "vertices 3"] | float = 0.0

    def plan(self, worn: Worn, others: Sequence[Term]) -> Contact:
        """Return itself, with the pieces of the cloth where only different ones keep apart."""
        pieces = jnp.asarray(worn.pieces) if self.layers == "pieces" else None
        return self.replace(pieces=pieces, unfolding=jnp.asarray(worn.unfolding))

    def alike(self, worn: Worn, planned: Sequence[Contact]) -> Contact:
        """Return itself, with the pieces and the folds of this scene's cloth."""
        return self.plan(worn, ())

    def clear_body(self, poses: BodyMotion) -> BodyMotion:
        """Return the motion of a body whose parts don't pass through each other, see `mesh.parting`."""
        return parted_body(poses)

    def start(
        self, position: Float[Array, "vertices 3"], garment: Garment, body: Obstacle | None
    ) -> Float[Array, "vertices 3"]:
        """Return unfolded positions [m], which the body, grown from under its skin, has pushed off."""
        position = position + self.unfolding
        if body is None:
            return position
        now = body.positions[0]
        position = clear_of_body(position, now, body.surface, garment)
        inwards = -_GROWTH * vertex_normals(now, body.surface.faces, body.surface.face_incidence)
        around = self._around(
            position,
            joint_meshes(garment, body.surface),
            body=(now + inwards).T,
            way=-inwards.T,
            carried=jnp.zeros_like(position.T),
            is_free=garment.vertex_mask & ~garment.is_pinned,
        )
        begin = position.T, courses.start_course(position, self._tables(position))
        grown, _ = jax.lax.while_loop(
            lambda carry: carry[1].share < 1.0, lambda carry: courses.move_on(*carry, around), begin
        )
        return grown.T

    def _around(self, position: Float[Array, "vertices 3"], meshes: Meshes, **parts: Array) -> Around:
        """Return what a course depends on whose goal is where it begins."""
        reach = jnp.asarray(self.reach, position.dtype)
        return Around(meshes=meshes, goal=position.T, reach=reach, pieces=self.pieces, **parts)

    def _tables(self, position: Float[Array, "vertices 3"]) -> tuple[int, int]:
        """Return the sizes of its tables."""
        if self.rows is not None:
            return self.rows
        return tuple(-(-share * position.shape[0] // CHUNK) * CHUNK for share in (_WIDE_ROWS, _FINE_ROWS))  # type: ignore[return-value]

    def prepare(self, problem: FrameProblem) -> ContactData:
        """Return what the frame's course depends on; pairs are found on the way."""
        garment, body, position = problem.garment, problem.body, problem.position
        nearest = None
        if body is None:
            start = way = jnp.zeros((3, 0), position.dtype)
            carried = jnp.zeros_like(position.T)
        else:
            start, way = body.start.T, (body.end - body.start).T
            nearest = find_contacts(position, body.start, body.end, body.surface, garment.vertex_blocks)
            carried = _taken_along(nearest, way, garment)
        is_free = garment.vertex_mask
        if problem.pin_targets is not None:
            is_free = is_free & ~garment.is_pinned
            pins = (problem.pin_targets - position).T
            carried = jnp.where(garment.is_pinned[None], pins, carried)
        meshes = joint_meshes(garment, None if body is None else body.surface)
        around = self._around(position, meshes, body=start, way=way, carried=carried, is_free=is_free)
        stiffness = self.stiffness * contact_excess(problem.material)
        return ContactData(around, nearest, stiffness, courses.start_course(position, self._tables(position)))

    def domain(self, problem: FrameProblem, data: ContactData, goal: Float[Array, "vertices 3"]) -> Domain:
        """Return the domain of steps that nothing crosses."""
        around = data.around.replace(goal=goal.T)
        shape = goal.T.shape

        def follow(x: Array, course: Course) -> tuple[Array, Course]:
            x, course = courses.follow(x.reshape(shape), course, around)
            return x.reshape(-1), course

        def limit(x: Array, step: Array, course: Course) -> Array:
            return courses.limited(x.reshape(shape), step.reshape(shape), course, around).reshape(-1)

        return Domain(
            begin=problem.position.T.reshape(-1),
            course=data.course,
            follow=follow,
            is_open=lambda course: course.share >= 1.0,
            is_spent=lambda x, course: courses.is_spent(x.reshape(shape), course, around),
            limit=limit,
        )

    def on_course(self, data: ContactData, course: Course) -> ContactData:
        """Return its data with the pairs of a place of the course."""
        return data._replace(course=course)

    def elements(self, x: Vector3, problem: FrameProblem, data: ContactData) -> tuple[Elements, ...]:
        """Return the energies of all pairs [J]; vertices of the body count as the last one of the cloth."""
        last = x[0].shape[0] - 1
        rows = energies(_joined(x, data), data.course.pairs)
        return tuple(
            Elements(data.stiffness * values, jnp.minimum(kind.ids, last).T)
            for values, (kind, _) in zip(rows, data.course.pairs.kinds, strict=True)
        )

    def energy(self, x: Vector3, problem: FrameProblem, data: ContactData) -> Float[Array, ""]:
        """Return the energy of the pairs in use [J]."""
        return data.stiffness * energy(_joined(x, data), data.course.pairs)

    def remainder(self, problem: FrameProblem) -> Callable[[Vector3, Any], Float[Array, ""]]:
        """Return the energy of all pairs, which no block of the mesh holds."""
        return lambda x, data: sum_elements(self.elements(x, problem, data), x)

    def diagonal(self, x: Vector3, problem: FrameProblem, data: ContactData) -> Float[Array, " vertices"]:
        """Return a third of the curvature along the pairs' offsets [N/m]."""
        return data.stiffness * diagonal(_joined(x, data), data.course.pairs)[: x[0].shape[0]]

    def touched(
        self, problem: FrameProblem, data: ContactData
    ) -> tuple[Contacts, Float[Array, " vertices"]] | None:
        """Return the nearest points of the body with the force of the frame before."""
        return None if data.nearest is None else (data.nearest, problem.friction_load)  # type: ignore[return-value]

    def load(
        self, position: Float[Array, "vertices 3"], problem: FrameProblem, data: ContactData
    ) -> Float[Array, " vertices"]:
        """Return the sizes of the body's forces on every vertex [N]."""
        count = position.shape[0]

        def is_load(rows: Rows) -> Array:
            return jnp.any(rows.ids >= count, axis=0)

        x = (position[:, 0], position[:, 1], position[:, 2])
        return data.stiffness * loads(_joined(x, data), data.course.pairs, is_load)[:count]

    def status(self, problem: FrameProblem, data: ContactData) -> Int[Array, ""]:
        """Return whether cloth was let through, or a table too small."""
        passed = jnp.where(data.course.is_passed, int(Status.BODY_TOO_FAST), int(Status.OK))
        return passed | jnp.where(data.course.is_full, int(Status.SELF_CONTACT_OVERFLOW), int(Status.OK))

    def demand(self, data: ContactData) -> Int[Array, ""]:
        """Return the rows that the fullest search asked for."""
        return data.course.most

    def describe(self, garment: Garment) -> str:
        """Return what keeps off what."""
        return "cloth and body"


def _joined(x: Vector3, data: ContactData) -> Vector3:
    """Return the vertices of the cloth and of the body at t + 1."""
    end = data.around.body + data.around.way
    return tuple(jnp.concatenate([own, body.astype(own.dtype)]) for own, body in zip(x, end, strict=True))  # type: ignore[return-value]


def _taken_along(
    nearest: Contacts, way: Float[Array, "3 surface_vertices"], garment: Garment
) -> Float[Array, "3 vertices"]:
    """Return by how much the body takes the cloth near it along [m]."""
    fastest = jnp.sqrt(jnp.max(jnp.sum(way * way, axis=0)))
    beyond = jnp.maximum(jnp.abs(nearest.distances) - _FADES, 0.0)
    share = jnp.exp(-beyond / jnp.maximum(_FADING, 1.5 * fastest))
    moves = share[:, None] * (nearest.next_points - nearest.points)
    degree = 1.0 + jnp.sum(garment.neighbor_mask, axis=1, keepdims=True, dtype=moves.dtype)

    def smooth(_, moves: Array) -> Array:
        around = jnp.where(garment.neighbor_mask[:, :, None], moves[garment.neighbors], 0.0)
        return (moves + jnp.sum(around, axis=1)) / degree

    return jax.lax.fori_loop(0, _SMOOTHINGS, smooth, moves).T
