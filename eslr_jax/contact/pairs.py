"""Pairs of primitives: their closest points, whether they meet on straight ways, and pushes that keep them apart.

Cloth and body share one numbering, cloth first. A pair is a vertex over a face, (v, a, b, c), or an edge over an
edge, (a0, a1, b0, b1). Its offset is the way from the closest point of the second primitive to that of the first:
its length is their exact distance, and its direction separates the two, since both are convex.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from eslr_jax.contact.triangle import point_triangle
from eslr_jax.numerics import Vector3, cross3, dot3, sub3

GAP = 1e-4  # [m] within which pairs are looked for
# [m] that pushed pairs are left. It is far more than they need, since pushes of many pairs are averaged.
_PUSHED = 5e-4
# [m] that pairs may end with, so that gaps do not shrink from frame to frame: in float32 the normal across a gap
# of a micrometre is off by 1e-2, which is more than the gap over the length of a face.
FLOOR = 0.5 * GAP
CHUNK = 512  # rows that are looked at together, and of which tables hold a multiple
_SECTIONS = 4  # of a straight way, each with separating directions of its own
_LEAST = 0.1  # of the distance at the start, of the gap with which a pair still counts as parted
_OVERSHOOT = 1.05  # of a push, so that sweeps end
_SHORT = 1e-9  # [m] below which two primitives touch, and have no direction


class Rows(NamedTuple):
    """Pairs of one kind, in a table of fixed size; those in use come first."""

    ids: Int[Array, "corners rows"]  # four vertices; what is not used names the first one
    count: Int[Array, ""]  # rows in use


class Pairs(NamedTuple):
    """Both kinds of pairs."""

    faces: Rows  # vertices over faces
    edges: Rows  # edges over edges

    @property
    def kinds(self) -> tuple[tuple[Rows, bool], tuple[Rows, bool]]:
        """Each kind, and whether it is of edges."""
        return (self.faces, False), (self.edges, True)


class Closest(NamedTuple):
    """Where pairs are closest."""

    offset: Vector3  # [m], from the second primitive to the first
    distance: Float[Array, " rows"]  # [m], not less than `_SHORT`
    weights: tuple[Float[Array, " rows"], ...]  # of the four vertices, whose sum with them is the offset

    @property
    def normal(self) -> Vector3:
        """Direction of the offset, which separates the two."""
        return tuple(part / self.distance for part in self.offset)  # type: ignore[return-value]


def signs(is_edge: bool) -> tuple[int, int, int, int]:
    """Return 1 for the vertices of a pair's first primitive, and -1 for those of its second."""
    return (1, 1, -1, -1) if is_edge else (1, -1, -1, -1)


def corners_of(x: Vector3, ids: Int[Array, "corners rows"]) -> tuple[Vector3, ...]:
    """Return the four vertices of every row, by components.

    One gather each: jaxlib 0.10.2 sums products with gathers of [3, 4, rows] wrongly on a CPU.
    """
    return tuple((x[0][row], x[1][row], x[2][row]) for row in ids)


def closest(p: tuple[Vector3, ...], is_edge: bool) -> Closest:
    """Return the closest points of every pair, from its four vertices by components [m]."""
    if is_edge:
        s, t = _closest_on_edges(*p)
        shares, weights = (s, t), (1.0 - s, s, t - 1.0, -t)
    else:
        _, u, v = point_triangle(*p)
        shares, weights = (u, v), (jnp.ones_like(u), u + v - 1.0, -u, -v)
    offset = []
    for axis in range(3):  # differences first: their rounding is that of the offset, not of the place
        a, b, c, d = (corner[axis] for corner in p)
        if is_edge:
            offset.append((a - c) + shares[0] * (b - a) - shares[1] * (d - c))
        else:
            offset.append((a - b) - shares[0] * (c - b) - shares[1] * (d - b))
    x, y, z = offset
    distance = jnp.sqrt(jnp.maximum(dot3((x, y, z), (x, y, z)), _SHORT**2))
    return Closest((x, y, z), distance, weights)


def _closest_on_edges(p0: Vector3, p1: Vector3, q0: Vector3, q1: Vector3) -> tuple[Array, Array]:
    """Return where two segments are closest, as shares of their lengths.

    Source: Ericson 2005, Real-Time Collision Detection, section 5.1.9.
    """
    first, second, between = sub3(p1, p0), sub3(q1, q0), sub3(p0, q0)
    a, e, b = dot3(first, first), dot3(second, second), dot3(first, second)
    c, f = dot3(first, between), dot3(second, between)
    a, e = (jnp.where(squared > 0, squared, 1.0) for squared in (a, e))
    determinant = a * e - b * b
    is_crossed = determinant > 1e-6 * a * e
    s = jnp.where(is_crossed, (b * f - c * e) / jnp.where(is_crossed, determinant, 1.0), 0.5)
    s = jnp.clip(s, 0.0, 1.0)
    t = jnp.clip((b * s + f) / e, 0.0, 1.0)
    s = jnp.clip((b * t - c) / a, 0.0, 1.0)
    return s, jnp.clip((b * s + f) / e, 0.0, 1.0)  # once more: exact where s was clipped last


class _Course(NamedTuple):
    """How far pairs have been followed along their ways."""

    corners: tuple[Vector3, ...]  # at the end of the last section [m]
    normal: Vector3  # which separated them there
    least: Float[Array, " rows"]  # gap that a direction has to show [m]
    is_parted: Bool[Array, " rows"]  # nothing has met so far
    last: Vector3  # the normal where the first section begins that no direction separates


def _followed(start: tuple[Vector3, ...], end: tuple[Vector3, ...], is_edge: bool) -> _Course:
    """Return which pairs do not meet on straight ways, for certain, and along which direction to part the others.

    A direction that separates two convex primitives at both ends of straight motions separates them all the way:
    heights along it change linearly. So a way is cut into sections, and each is tried with the normals at its two
    ends, their mean, and what stands across both edges or the face. Pairs that come very near may be taken for
    such that meet.
    """
    side = signs(is_edge)

    def section(number: Array, course: _Course) -> _Course:
        share = number.astype(start[0][0].dtype) / _SECTIONS
        corners: tuple[Vector3, ...] = tuple(
            tuple((1 - share) * a + share * b for a, b in zip(here, there, strict=True))  # type: ignore[misc]
            for here, there in zip(start, end, strict=True)
        )
        near = closest(corners, is_edge)
        normal = near.normal
        is_first = number == 0
        least = jnp.where(is_first, _LEAST * jnp.minimum(near.distance, GAP), course.least)
        is_parted = is_first
        # Edges that slide past each other are seen from two sides: what parts them all the way lies between, or
        # across both of them.
        between: Vector3 = tuple(0.5 * (a + b) for a, b in zip(course.normal, normal, strict=True))  # type: ignore[assignment]
        for along in (course.normal, normal, between, _across(corners, near.offset, is_edge)):
            gaps = [gap_along(along, places, side) for places in (course.corners, corners)]
            is_parted = is_parted | (jnp.minimum(*gaps) >= least)
        is_parted = is_parted & ((number < _SECTIONS) | (near.distance >= FLOOR))
        before = _where(is_first, normal, course.normal)
        meets = course.is_parted & ~is_parted
        last = _where(is_first, normal, _where(meets, before, course.last))
        return _Course(corners, normal, least, course.is_parted & is_parted, last)

    nothing = jnp.zeros_like(start[0][0])
    nowhere = (nothing, nothing, nothing)
    first = _Course(start, nowhere, nothing, jnp.ones(nothing.shape, bool), nowhere)
    return jax.lax.fori_loop(0, _SECTIONS + 1, section, first)


def _across(p: tuple[Vector3, ...], offset: Vector3, is_edge: bool) -> Vector3:
    """Return the direction across both edges, or across the face, towards the first; zero where there is none."""
    first, second = (sub3(p[1], p[0]), sub3(p[3], p[2])) if is_edge else (sub3(p[2], p[1]), sub3(p[3], p[1]))
    across = cross3(first, second)
    length = jnp.sqrt(dot3(across, across))
    scale = jnp.sign(dot3(across, offset)) / jnp.where(length > 0, length, 1.0)
    return tuple(scale * part for part in across)  # type: ignore[return-value]


def _heights(normal: Vector3, p: tuple[Vector3, ...]) -> list[Array]:
    """Return the heights of corners over the first one [m]."""
    return [dot3(normal, sub3(corner, p[0])) for corner in p]  # type: ignore[arg-type]


def gap_along(normal: Vector3, p: tuple[Vector3, ...], side: Sequence[int]) -> Float[Array, " rows"]:
    """Return by how much the first primitives are higher than the second along a normal [m]."""
    lowest, highest = _between(_heights(normal, p), side)
    return lowest - highest


def _between(heights: Sequence[Array], side: Sequence[int]) -> tuple[Array, Array]:
    """Return the lowest height of the first primitive, and the highest of the second."""
    first, second = ([h for h, s in zip(heights, side, strict=True) if s == one] for one in (1, -1))
    return functools.reduce(jnp.minimum, first), functools.reduce(jnp.maximum, second)


def _where(condition: Array, one: Vector3, other: Vector3) -> Vector3:
    return tuple(jnp.where(condition, a, b) for a, b in zip(one, other, strict=True))  # type: ignore[return-value]


class Pushed(NamedTuple):
    """Ends of straight ways, pushed so that no pair meets."""

    end: Vector3  # [m]
    lack: Float[Array, ""]  # gap that is left to be made [m]


def pushed_apart(
    start: Vector3, end: Vector3, pairs: Pairs, freedom: Int[Array, " vertices"], sweeps: int
) -> Pushed:
    """Return ends of straight ways, pushed so that no pair meets.

    A pair that may meet, or ends nearer than `FLOOR`, is pushed apart to half a millimetre, along the direction
    that separated it last. Vertices take the mean of their pushes.

    Args:
        start: Vertices before, by components [m]; no pair crosses.
        end: Vertices after.
        pairs: All that may meet.
        freedom: Of every pair those vertices are pushed that have the most; none is that has zero.
        sweeps: Bound of the number of sweeps.
    """
    count, dtype = len(freedom), start[0].dtype

    def sweep(carry):
        end, lacks, is_moved, number = carry
        moves, now = jnp.zeros((count, 4), dtype), []
        for (rows, is_edge), lack in zip(pairs.kinds, lacks, strict=True):
            pushes_of = functools.partial(_pushes, start, end, freedom, is_edge=is_edge)
            moves, lack = _looked_through(rows, is_moved, pushes_of, (moves, lack))
            now.append(lack)
        times = jnp.maximum(moves[:, 3], 1.0)
        pushed = tuple(part + moves[:, axis] / times for axis, part in enumerate(end))
        return pushed, tuple(now), moves[:, 3] > 0, number + 1

    def worst(lacks) -> Float[Array, ""]:
        return jnp.maximum(*(jnp.max(lack) for lack in lacks))

    # What every chunk of rows lacks, before the last push: one more sweep sees whether nothing is left.
    lacks = tuple(
        jnp.where(jnp.arange(0, kind.ids.shape[1], CHUNK) < kind.count, jnp.asarray(jnp.inf, dtype), 0.0)
        for kind, _ in pairs.kinds
    )
    first = (end, lacks, jnp.ones(count, bool), jnp.int32(0))
    end, lacks, _, _ = jax.lax.while_loop(
        lambda carry: (worst(carry[1]) > 0) & (carry[3] < sweeps), sweep, first
    )
    return Pushed(end, worst(lacks))


_Found = tuple[Float[Array, "vertices 4"], Float[Array, " chunks"]]
"""Moves with their counts, and what every chunk of rows lacks [m]."""


def _looked_through(
    rows: Rows, is_moved: Bool[Array, " vertices"], pushes_of: Callable, found: _Found
) -> _Found:
    """Return what was found with the pushes of pairs added, `CHUNK` at a time.

    Chunks that lacked nothing are left out where nothing has moved: they lack nothing.
    """

    def look(chunk: Array, ids: Array, found: _Found) -> _Found:
        moves, lacks = found
        is_used = chunk * CHUNK + jnp.arange(CHUNK, dtype=jnp.int32) < rows.count
        lack, pushes = pushes_of(ids, is_used)
        # Joined, though XLA computes what it joins in a loop that it can't vectorise: there are few rows.
        return moves.at[ids.ravel()].add(pushes), lacks.at[chunk].set(lack)

    def step(carry):
        chunk, found = carry
        ids = jax.lax.dynamic_slice_in_dim(rows.ids, chunk * CHUNK, CHUNK, axis=1)
        is_open = (found[1][chunk] > 0) | jnp.any(is_moved[ids])
        return chunk + 1, jax.lax.cond(is_open, look, lambda _, __, same: same, chunk, ids, found)

    chunks = (rows.count + CHUNK - 1) // CHUNK
    return jax.lax.while_loop(lambda carry: carry[0] < chunks, step, (jnp.int32(0), found))[1]


def _pushes(
    start: Vector3,
    end: Vector3,
    freedom: Int[Array, " vertices"],
    ids: Int[Array, "corners rows"],
    is_used: Bool[Array, " rows"],
    is_edge: bool,
) -> tuple[Float[Array, ""], Float[Array, "entries 4"]]:
    """Return by how much pairs lack their gap at the end [m], and moves that mend it, with a count."""
    p, side = corners_of(end, ids), signs(is_edge)
    course = _followed(corners_of(start, ids), p, is_edge)
    free = freedom[ids]
    is_movable = (free > 0) & (free == jnp.max(free, axis=0, keepdims=True))
    can_second, can_first = (
        functools.reduce(jnp.logical_or, [m for m, s in zip(is_movable, side, strict=True) if s == one])
        for one in (-1, 1)
    )
    along = _heights(course.last, p)
    lowest, highest = _between(along, side)
    is_lacking = is_used & ~course.is_parted & (can_first | can_second)
    middle = 0.5 * (lowest + highest)
    upper = jnp.where(can_first & can_second, middle + 0.5 * _PUSHED, highest + _PUSHED)
    lower = jnp.where(can_first & can_second, middle - 0.5 * _PUSHED, lowest - _PUSHED)
    entries = []
    for k in range(4):
        up = jnp.maximum(upper - along[k], 0.0) if side[k] > 0 else jnp.minimum(lower - along[k], 0.0)
        up = jnp.where(is_lacking & is_movable[k], _OVERSHOOT * up, 0.0)
        is_pushed = (up != 0).astype(up.dtype)
        entries.append(jnp.stack([*(part * up for part in course.last), is_pushed], axis=1))
    # A pair that is apart at the end, but not for certain on the way, lacks something too.
    lack = jnp.where(is_lacking, jnp.maximum(GAP - (lowest - highest), _SHORT), 0.0)
    return jnp.max(lack), jnp.concatenate(entries)
