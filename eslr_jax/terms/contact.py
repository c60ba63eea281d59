"""Contact that cannot be passed: what other terms push apart is kept from crossing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from eslr_jax.contact.lists import joint_meshes
from eslr_jax.contact.nearest import clear_of_body
from eslr_jax.contact.pairs import CHUNK
from eslr_jax.contact.ways import Moved, move_clear
from eslr_jax.errors import Status
from eslr_jax.numerics import Vector3, vertex_normals
from eslr_jax.terms.problem import FrameProblem
from eslr_jax.terms.term import Elements, Term
from eslr_jax.terms.worn import Worn, parted_body
from eslr_jax.types import BodyMotion, Garment, Obstacle, Scene

_GROWTH = 16e-3  # [m] under its skin, from which a body grows at the start: edges of the cloth dip in less
_ROWS = 8  # per vertex of the cloth, of the tables that a scene begins with; a T-shirt needs one, a dress two
_HEADROOM = 1.5  # of larger tables


def starting_rows(num_vertices: int) -> int:
    """Return the rows of either table that a scene of a garment of so many vertices begins with."""
    return CHUNK * math.ceil(_ROWS * num_vertices / CHUNK)


def keeps_layers(scene: Scene) -> bool:
    """Tell whether a scene keeps cloth from passing through cloth."""
    contact = scene.term(Contact)
    return contact is not None and contact.has_layers


class Ends(NamedTuple):
    """What came of a frame's ends."""

    is_passed: Bool[Array, ""]
    most: Int[Array, ""]  # rows that the fullest table would have needed


@struct.dataclass
class Contact(Term):
    """Nothing passes through cloth: not the body, and not cloth.

    An energy such as that of `Collision` can be overcome. This term has none. It takes
    the positions that a frame would end with, and pushes them until no vertex has met a face, and no edge an
    edge, on the straight ways from the frame's start. So cloth that starts uncrossed stays so. The body yields
    where its own parts pass through each other (`mesh.parting`). Where that does not make room, something is let
    through, and the trajectory says in which frame.

    A derivative takes no notice of the pushes.

    Source: after Bridson, Fedkiw and Anderson 2002, doi 10.1145/566654.566623, who end a step likewise, by
    impulses; here a pair is left alone where directions part it for certain.
    """

    name = "contact"
    reads_body = True
    unless_needed = "no body in reach, and no layers that can meet"

    rows: int | None = struct.field(pytree_node=False, default=None)  # of either table; None: to be planned
    has_layers: bool = struct.field(pytree_node=False, default=True)  # cloth does not pass through cloth
    # [m] by which cloth that the first pose folds through itself is moved, see `mesh.parting.uncrossed`
    unfolding: Float[Array, "vertices 3"] | float = 0.0

    def plan(self, worn: Worn, others: Sequence[Term]) -> Contact | None:
        """Return itself with sizes of its tables; None where cloth can meet neither the body nor cloth."""
        has_layers = worn.num_pieces > 1 or worn.meets_itself()
        if worn.surface is None and not has_layers:
            return None
        unfolding = jnp.asarray(worn.unfolding) if has_layers else 0.0
        return self.replace(rows=self._num_rows(len(worn.pieces)), has_layers=has_layers, unfolding=unfolding)

    def alike(self, worn: Worn, planned: Sequence[Contact]) -> Contact:
        """Return itself, with the largest of the tables and the folds of this scene's cloth."""
        rows = max(one.rows or 0 for one in planned)
        has_layers = any(one.has_layers for one in planned)
        unfolding = jnp.asarray(worn.unfolding) if has_layers else 0.0
        return self.replace(rows=rows, has_layers=has_layers, unfolding=unfolding)

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
        grown = move_clear(
            position.T,
            jnp.zeros_like(position.T),
            (now + inwards).T,
            -inwards.T,
            joint_meshes(garment, body.surface, has_layers=self.has_layers),
            garment.vertex_mask & ~garment.is_pinned,
            self._num_rows(len(position)),
        )
        return grown.position.T

    def _num_rows(self, num_vertices: int) -> int:
        return starting_rows(num_vertices) if self.rows is None else self.rows

    def correct(
        self, position: Float[Array, "vertices 3"], problem: FrameProblem, data: None
    ) -> tuple[Float[Array, "vertices 3"], Ends]:
        """Return positions at t + 1 [m] that are reached without crossing, and what came of it."""
        garment, body = problem.garment, problem.body
        is_free = garment.vertex_mask
        if problem.pin_targets is not None:
            is_free = is_free & ~garment.is_pinned
        nothing = jnp.zeros((3, 0), position.dtype)

        def moved(position: Array, problem: FrameProblem) -> Moved:
            start = problem.position.T
            ways = (nothing, nothing) if body is None else (body.start.T, (body.end - body.start).T)
            surface = None if body is None else body.surface
            meshes = joint_meshes(garment, surface, has_layers=self.has_layers)
            return move_clear(
                start, position.T - start, *ways, meshes, is_free, self._num_rows(len(position))
            )

        ended = moved(*jax.lax.stop_gradient((position, problem)))
        pushed = ended.position.T - jax.lax.stop_gradient(position)
        return position + pushed, Ends(ended.is_passed, ended.most)

    def elements(self, x: Vector3, problem: FrameProblem, data: Ends | None) -> tuple[Elements, ...]:
        """Return no element: it has no energy."""
        return ()

    def status(self, problem: FrameProblem, data: Ends | None) -> Int[Array, ""]:
        """Return whether a table was too small."""
        if data is None:
            return jnp.int32(Status.OK)
        is_full = data.most > self._num_rows(len(problem.position))
        return jnp.where(is_full, jnp.int32(Status.SELF_CONTACT_OVERFLOW), jnp.int32(Status.OK))

    def is_passed(self, data: Ends | None) -> Bool[Array, ""] | None:
        """Return whether something was let through."""
        return None if data is None else data.is_passed

    def demand(self, data: Ends | None) -> Int[Array, ""] | None:
        """Return the rows that the fullest search asked for."""
        return None if data is None else data.most

    def enlarged(self, demand: int) -> Contact | None:
        """Return itself with tables for so many rows and half as many more; None where they have room."""
        if self.rows is None or demand <= self.rows:
            return None
        return self.replace(rows=CHUNK * math.ceil(_HEADROOM * demand / CHUNK))

    def describe(self, garment: Garment) -> str:
        """Return what passes through what no more."""
        return "cloth and body" if self.has_layers else "body"
