"""Contact that cannot be passed: pairs that are near repel each other, and what would cross is pushed back."""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import MappingProxyType
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from eslr_jax.contact.ground import still_contacts
from eslr_jax.contact.lists import Meshes, Motion, find_pairs, joint_meshes, without_body_faces
from eslr_jax.contact.nearest import CLEARANCE, clear_of_body, is_inside
from eslr_jax.contact.pairs import CHUNK, closest, corners_of
from eslr_jax.contact.ways import move_clear
from eslr_jax.errors import Status
from eslr_jax.numerics import (
    Vector3,
    components,
    dot3,
    safe_norm,
    safe_normalize,
    segment_sum,
    sub3,
    true_rows,
    vertex_normals,
)
from eslr_jax.terms.collision import BodyContact, Collision, collision_energies, penetration
from eslr_jax.terms.friction import Friction, slip_energies
from eslr_jax.terms.stretch import contact_excess
from eslr_jax.terms.term import (
    CONTACT_STIFFNESS,
    STIFFNESS_RANGE,
    THICKNESS_RANGE,
    Elements,
    FrameProblem,
    MovingBody,
    Term,
    free_vertices,
)
from eslr_jax.terms.worn import Worn, parted_body
from eslr_jax.types import BodyMotion, BodySurface, Garment, Obstacle, Scene

_GROWTH = 16e-3  # [m] under its skin, from which a body grows at the start: edges of the cloth dip in less
_ROWS = 8  # per vertex of the cloth, of the tables that a scene begins with; a T-shirt needs one, a dress two
_HEADROOM = 1.5  # of larger tables
# Pairs that have an energy have a table of one row in so many, or of the least number: a T-shirt needs one in 60
# at 1k and one in 37 at 4k and 10k, a dress at 4k one in 41. The tables in which they are looked for have so many
# times its rows, for the rest.
_NEAR_SHARE, _LEAST_NEAR = 32, 256
_LOOKED_AT = 4
# [m] from which pairs are near. It is more than the thickness, so that those that repel each other in one frame
# are still known in the next; less for the body, off which its own term keeps vertices.
_NEAR_CLOTH, _NEAR_BODY = 4e-3, 1.5e-3
_RIM = 1e-3  # weight of a vertex below which the nearest point lies on the rim
# [m] that a vertex is pushed, which cloth around it has to follow; a T-shirt's are by 1 to 3 mm. There vertices
# that are pushed by more than the second length are held; the rest is left to pushes.
_FAR, _HELD = 5e-3, 5e-4
_SWEEPS = 2  # in which the guess is pushed out; a third one measured no better


def starting_rows(num_vertices: int) -> int:
    """Return the rows of either table that a scene of a garment of so many vertices begins with."""
    return CHUNK * math.ceil(_ROWS * num_vertices / CHUNK)


def _friction(problem: FrameProblem) -> Friction:
    """Return the friction of the scene; without one nothing rubs."""
    return next((term for term in problem.terms if isinstance(term, Friction)), Friction(coefficient=0.0))


def _under_skin(
    body: Float[Array, "surface_vertices 3"], surface: BodySurface
) -> Float[Array, "surface_vertices 3"]:
    """Return a body's vertices [m] so far under its skin that no edge of cloth on the skin dips into it."""
    return body - _GROWTH * vertex_normals(body, surface.faces, surface.face_incidence)


def _freedom(garment: Garment, is_free: Bool[Array, " vertices"]) -> Int[Array, " vertices"]:
    """Return 2 for vertices that are free, and 1 for what is pinned: it yields where nothing else can."""
    return garment.vertex_mask.astype(jnp.int32) + is_free.astype(jnp.int32)


def _begun(problem: FrameProblem) -> tuple[Float[Array, "all_vertices 3"], Bool[Array, ""] | bool]:
    """Return where the ways of cloth, and of the body behind it, begin at t [m], and whether cloth comes out.

    They begin where they are. But cloth inside the body begins on its skin, and then all of the body under it, as
    at a scene's start: so cloth that was put inside, or was let through, comes out again. On that way it may pass
    through other cloth.
    """
    body, position = problem.body, problem.position
    if body is None:
        return position, False
    start, touched, comes_out = body.start, problem.data_of(Collision), False
    if touched is not None:
        nearest = touched.nearest
        may_be = nearest.is_near & (nearest.distances < 0) & problem.garment.vertex_mask
        inside = is_inside(*jax.lax.stop_gradient((may_be, position, start, body.surface)))
        position = jnp.where(inside[:, None], nearest.points + CLEARANCE * nearest.normals, position)
        comes_out = jnp.any(inside)
        start = jax.lax.cond(comes_out, _under_skin, lambda body, _: body, start, body.surface)
    return jnp.concatenate([position, start]), comes_out


def keeps_layers(scene: Scene) -> bool:
    """Tell whether a scene keeps cloth from passing through cloth."""
    contact = scene.term(Contact)
    return contact is not None and contact.has_layers


Corners = tuple[Vector3, ...]
"""The four vertices of every pair, by components [m]."""


class NearPairs(NamedTuple):
    """Pairs that are near each other at t, and the direction that parts them there."""

    # Of the cloth. Where a corner is the body's, a vertex of the pair's cloth with the weight zero.
    vertices: Int[Array, "corners rows"]
    weights: Float[Array, "corners rows"]  # of the vertices in the offset, see `offsets`
    base: Vector3  # that the body's corners add to the offset at t + 1 [m]
    start: Vector3  # offset at t [m]
    normal: Vector3
    thickness: Float[Array, " rows"]  # [m]
    stiffness: Float[Array, " rows"]  # [J/m^3], times the cloth's area; zero where not in use
    rubbing: Float[Array, " rows"]  # Coulomb's greatest friction force at t [N]

    def offsets(self, x: Vector3) -> Vector3:
        """Return the ways from the second primitives to the first [m], where they were nearest at t."""
        own = _weighted(self.weights, corners_of(x, self.vertices))
        return tuple(base + part for base, part in zip(self.base, own, strict=True))  # type: ignore[return-value]

    def depths(self, offset: Vector3) -> Float[Array, " rows"]:
        """Return max(thickness - h, 0) [m], h the height of a pair's first primitive over its second."""
        depth = jnp.maximum(self.thickness - dot3(self.normal, offset), 0.0)
        return jnp.where(self.stiffness > 0, depth, 0.0)


def _with_body(position: Float[Array, "vertices 3"], problem: FrameProblem) -> Float[Array, "all_vertices 3"]:
    """Return positions of the cloth [m] with the body's at t + 1 behind them."""
    return position if problem.body is None else jnp.concatenate([position, problem.body.end])


def _weighted(weights: Float[Array, "corners rows"], corners: Sequence[Vector3]) -> Vector3:
    """Return the weighted sums of four corners [m]."""
    return tuple(  # type: ignore[return-value]
        sum(weight * corner[axis] for weight, corner in zip(weights, corners, strict=True))
        for axis in range(3)
    )


class Meetings(NamedTuple):
    """Pairs of a frame, and what came of its ends."""

    start: Float[Array, "all_vertices 3"]  # of `_begun`
    near: NearPairs
    held: BodyContact  # with planes across the pushes of vertices, which keep them where they were pushed to
    most_near: Int[Array, ""]  # rows that their table would have needed
    slip: Float[Array, ""] | float  # [m] in a frame, below which friction sticks
    comes_out: Bool[Array, ""] | bool  # cloth was inside the body
    is_passed: Bool[Array, ""] | bool = False  # as pushes did not end
    most: Int[Array, ""] | int = 0  # rows that the fullest search of ends would have needed
    is_far: Bool[Array, ""] | bool = False  # an end was pushed by `_FAR`


@struct.dataclass
class Contact(Term):
    """Nothing passes through cloth: not the body, and not cloth.

    Pairs of a vertex and a face, or of two edges, that are near at a frame's start have an energy: a cubic
    barrier on the height along the normal between them, as vertices have over the body (`Collision`). They rub,
    with the barrier's force at the start and the constants of `Friction`.

    An energy can be overcome, and pairs that come near within the frame have none. So the positions that the
    frame would end with are pushed until no pair has met on the straight ways from the frame's start. Cloth that
    starts uncrossed stays so, and vertices that start inside the body are taken out of it. Where ends are pushed
    far, the cloth around has to follow: what was pushed is held by planes with the same barrier, and the frame is
    solved again. Pinned cloth is pushed where nothing else of a pair can be. The body yields where its own parts
    pass through each other (`mesh.parting`). Where that makes no room, something is let through, and the
    trajectory says in which frame.

    A derivative takes no notice of the pushes.

    Source: after Bridson, Fedkiw and Anderson 2002, doi 10.1145/566654.566623, who end a step likewise, by
    repulsions and impulses; here a pair is left alone where directions part it for certain.
    """

    name = "contact"
    reads_body = True
    unless_needed = "no body in reach, and no layers that can meet"
    ranges = MappingProxyType({"stiffness": STIFFNESS_RANGE, "thickness": THICKNESS_RANGE})

    # [J/m^5] Twice that of vertices: with one, half as much again is left to pushes; with four, tolerance takes a
    # tenth more iterations.
    stiffness: Float[Array, ""] | float = 2.0 * CONTACT_STIFFNESS
    # [m] of every cloth of a pair: layers keep 2 mm, as off a body.
    thickness: Float[Array, ""] | float = 1e-3
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
        under = _under_skin(now, body.surface)
        grown = move_clear(
            position.T,
            jnp.zeros_like(position.T),
            under.T,
            (now - under).T,
            self._meshes(garment, body),
            _freedom(garment, garment.vertex_mask & ~garment.is_pinned),
            self._num_rows(len(position)),
        )
        return grown.position.T

    def _meshes(self, garment: Garment, body: Obstacle | MovingBody | None) -> Meshes:
        return joint_meshes(garment, None if body is None else body.surface, has_layers=self.has_layers)

    def _num_rows(self, num_vertices: int) -> int:
        return starting_rows(num_vertices) if self.rows is None else self.rows

    def _near_rows(self, num_vertices: int) -> int:
        return max(self._num_rows(num_vertices) // _NEAR_SHARE, _LEAST_NEAR)

    def prepare(self, problem: FrameProblem) -> Meetings:
        """Return the pairs that are near at t."""
        count = len(problem.position)
        start, comes_out = _begun(problem)
        end = _with_body(start[:count], problem)
        x, y = components(start), components(end)
        is_cloth = jnp.arange(len(start)) < count
        half = 0.5 * _NEAR_CLOTH
        radius = jnp.where(is_cloth, half, _NEAR_BODY - half).astype(start.dtype)
        still = jax.tree.map(jnp.zeros_like, x)
        motion = jax.lax.stop_gradient(Motion(x, still, radius))
        # A vertex over the body is `Collision`'s, which knows what is near at t.
        meshes = without_body_faces(self._meshes(problem.garment, problem.body))
        rows = self._near_rows(count)
        found = find_pairs(motion, meshes, _LOOKED_AT * rows)
        stiffness = self.stiffness * contact_excess(problem.material)
        kinds = []
        for pairs, is_edge in found.pairs.kinds:
            here, there = corners_of(x, pairs.ids), corners_of(y, pairs.ids)
            kinds.append(self._near(pairs.ids, pairs.count, is_edge, here, there, stiffness, problem))
        near = jax.tree.map(lambda *parts: jnp.concatenate(parts, axis=-1), *kinds)
        # Every iteration goes through the whole table: those that have no energy leave it.
        in_use, num_used = true_rows(near.stiffness > 0, rows)
        near = jax.tree.map(lambda leaf: jnp.take(leaf, in_use, axis=-1, mode="fill", fill_value=0), near)
        nowhere = jnp.zeros_like(problem.position)
        none = still_contacts(nowhere, nowhere, nowhere[:, 0], jnp.zeros(count, bool))
        held = BodyContact(none, None, self.thickness, stiffness)
        most_near = jnp.maximum(num_used, -(-found.most // _LOOKED_AT))
        return Meetings(start, near, held, most_near, _friction(problem).slip(problem), comes_out)

    def _near(
        self,
        ids: Int[Array, "corners rows"],
        count: Int[Array, ""],
        is_edge: bool,
        start: Corners,
        end: Corners,
        stiffness: Float[Array, ""],
        problem: FrameProblem,
    ) -> NearPairs:
        """Return pairs from their vertices at t and at t + 1, where it is the body's that are read.

        The stiffness is of the barrier [J/m^5].
        """
        areas = problem.garment.vertex_areas
        is_cloth = ids < len(areas)
        near = closest(start, is_edge)
        weights = jnp.stack(near.weights)
        of_body = jnp.where(is_cloth, 0.0, weights)
        # Corners of the cloth stand in for those of the body: a first primitive's, or else a second one's.
        vertices = jnp.where(is_cloth, ids, jnp.where(is_cloth[0], ids[0], ids[3]))
        own = jnp.where(is_cloth, weights, 0.0)
        sides = jnp.sum(jnp.abs(own), axis=0)  # that are cloth, one or two
        area = jnp.sum(jnp.abs(own) * areas[vertices], axis=0) / jnp.maximum(sides, 1.0)
        # Where a pair is nearest on the rim, the normal leans, and would stand in the way of what slides: its
        # neighbours hold it.
        is_counted = jnp.min(jnp.abs(weights), axis=0) > _RIM
        is_counted = is_counted & (jnp.arange(ids.shape[1]) < count)
        near_pairs = NearPairs(
            vertices=vertices,
            weights=own,
            base=_weighted(of_body, end),
            start=_weighted(weights, start),
            normal=near.normal,
            thickness=self.thickness * jnp.maximum(sides, 1.0),
            stiffness=jnp.where(is_counted, stiffness * area, 0.0),
            rubbing=jnp.zeros_like(area),
        )
        depth = near_pairs.depths(near_pairs.start)
        rubbing = _friction(problem).coefficient * 3.0 * near_pairs.stiffness * depth * depth
        return near_pairs._replace(rubbing=rubbing)

    def push_out(
        self, position: Float[Array, "vertices 3"], problem: FrameProblem, data: Meetings
    ) -> Float[Array, "vertices 3"]:
        """Return positions [m] at which pairs that are near keep their thickness, in the mean."""
        near = data.near
        # Vertices move by their weights, so the height grows by the sum of the squares, which is a third or more.
        lever = 1.0 / jnp.maximum(jnp.sum(near.weights * near.weights, axis=0), 0.25)

        def sweep(_: Array, position: Float[Array, "vertices 3"]) -> Float[Array, "vertices 3"]:
            lack = lever * near.depths(near.offsets(components(position)))
            moves = jnp.zeros((len(position), 4), position.dtype)
            for ids, weight in zip(near.vertices, near.weights, strict=True):
                is_moved = ((lack > 0) & (weight != 0)).astype(position.dtype)
                way = [lack * weight * part for part in near.normal]
                moves = moves + segment_sum(jnp.stack([*way, is_moved], axis=1), ids, len(position))
            return position + moves[:, :3] / jnp.maximum(moves[:, 3:], 1.0)

        return jax.lax.fori_loop(0, _SWEEPS, sweep, position)

    def correct(
        self, position: Float[Array, "vertices 3"], problem: FrameProblem, data: Meetings
    ) -> tuple[Float[Array, "vertices 3"], Meetings]:
        """Return positions at t + 1 [m] that are reached without crossing, and what came of it."""
        count, end = len(position), _with_body(position, problem)
        start, is_free = data.start.T, free_vertices(problem)
        ways = end.T - start
        ended = move_clear(
            *jax.lax.stop_gradient((start[:, :count], ways[:, :count], start[:, count:], ways[:, count:])),
            self._meshes(problem.garment, problem.body),
            _freedom(problem.garment, is_free),
            self._num_rows(count),
        )
        reached = ended.position.T
        pushed = reached - jax.lax.stop_gradient(position)
        length = safe_norm(pushed, axis=1)
        is_far = jnp.any(is_free & (length > _FAR))
        is_held = is_far & (length > _HELD)
        last, is_new = data.held.nearest, is_held[:, None]
        nearest = still_contacts(
            jnp.where(is_new, reached, last.next_points),
            jnp.where(is_new, safe_normalize(pushed), last.next_normals),
            last.distances,
            is_held | last.is_near,
        )
        held = data.held._replace(nearest=jax.lax.stop_gradient(nearest))
        found = data._replace(held=held, is_passed=ended.is_passed, most=ended.most, is_far=is_far)
        return position + pushed, found

    def elements(self, x: Vector3, problem: FrameProblem, data: Meetings) -> tuple[Elements, ...]:
        """Return the energy of every near pair, and of every vertex over its plane [J].

        That is stiffness a max(thickness - h, 0)^3, with the area a of the cloth [m^2], and for pairs that of
        friction, see `friction.friction_energies`.
        """
        near, held = data.near, data.held
        offset = near.offsets(x)
        depth = near.depths(offset)
        slipped = slip_energies(sub3(offset, near.start), near.normal, near.rubbing, data.slip)
        pairs = Elements(near.stiffness * depth * depth * depth + slipped, near.vertices.T)
        planes = collision_energies(x, held.nearest, problem.garment, held.stiffness, held.thickness)
        vertices = jnp.arange(len(planes), dtype=near.vertices.dtype)[:, None]
        return pairs, Elements(planes, vertices)

    def diagonal(self, x: Vector3, problem: FrameProblem, data: Meetings) -> Float[Array, " vertices"]:
        """Return a third of the curvatures [N/m]: along the normals, and across them where pairs stick."""
        near, held = data.near, data.held
        below = penetration(x, held.nearest, held.thickness)
        curvature = 2.0 * near.stiffness * near.depths(near.offsets(x)) + near.rubbing / (3.0 * data.slip)
        corners = zip(near.vertices, near.weights, strict=True)
        parts = [segment_sum(curvature * w * w, ids, len(x[0])) for ids, w in corners]
        return sum(parts, 2.0 * held.stiffness * problem.garment.vertex_areas * below)

    def status(self, problem: FrameProblem, data: Meetings) -> Int[Array, ""]:
        """Return whether a table was too small."""
        count = len(problem.position)
        is_full = (data.most_near > self._near_rows(count)) | (data.most > self._num_rows(count))
        return jnp.where(is_full, jnp.int32(Status.SELF_CONTACT_OVERFLOW), jnp.int32(Status.OK))

    def is_passed(self, data: Meetings) -> Bool[Array, ""] | None:
        """Return whether something was let through."""
        return jnp.asarray(data.is_passed) | data.comes_out

    def is_far(self, data: Meetings) -> Bool[Array, ""] | bool:
        """Return whether an end was pushed so far that cloth around it has to follow."""
        return data.is_far

    def demand(self, data: Meetings) -> Int[Array, ""]:
        """Return the rows that the fullest search asked for."""
        near = jnp.where(data.most_near > _LEAST_NEAR, _NEAR_SHARE * data.most_near, 0)
        return jnp.maximum(near, data.most)

    def enlarged(self, demand: int) -> Contact | None:
        """Return itself with tables for so many rows and half as many more; None where they have room.

        Sizes double, so that scenes share compiled programs.
        """
        if self.rows is None or demand <= self.rows:
            return None
        return self.replace(rows=CHUNK * 2 ** math.ceil(math.log2(_HEADROOM * demand / CHUNK)))

    def describe(self, garment: Garment) -> str:
        """Return what passes through what no more."""
        return "cloth and body" if self.has_layers else "body"
