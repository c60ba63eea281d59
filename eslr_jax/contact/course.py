"""The course of a frame that nothing crosses: the body carries the cloth, and steps end before they touch.

1. The body moves on, and takes the cloth near it along. What would cross is pushed, or the part of the motion is
   halved.
2. Every step of the solver is cut, vertex by vertex, so that no pair crosses.
3. Pairs are looked for again where a vertex has used up its allowance: the ball around it within which all pairs
   are known. Wide tables are found by a search; finer ones, over which energies are summed, are taken from these.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from eslr_jax.contact.lists import Found, Meshes, Motion, find_pairs, nearer_pairs
from eslr_jax.contact.pairs import Pairs, least_gaps, mended, no_pairs, shares
from eslr_jax.numerics import Vector3, safe_norm

CAUTION = 0.9  # share of its room that a vertex may take in one step
_PUSH = 4e-3  # [m] by which cloth that the body carries may be pushed in one part of its motion
_SWEEPS = 40  # of pushes
_LEAST_PART = 1.0 / 256.0  # of a frame's motion, at which cloth is pushed farther, or else let through
_WIDE = (6e-3, 2e-2)  # [m] least and greatest allowance of a search, besides half of the way to the goal
_AGAIN = 2.0  # times its way since the last search, that a search allows a vertex
_STALE = 0.5  # share of its allowance from which a vertex is looked for, where a search is due
_FARTHEST = 0.02  # [m] of the way to the goal that a search allows for
_FINE = (1e-3, 8e-3)  # [m] least and greatest allowance of the finer tables
_MOVES = 2.0  # of the last step, that the next finer tables allow for
_SPENT = 0.8  # share of its allowance after which pairs are looked for again
_LEAST_SCALE = 1.0 / 64.0  # of the allowances of a search whose tables are too small


@struct.dataclass
class Course:
    """Where a frame's solution has got to, besides the positions of the cloth."""

    share: Float[Array, ""]  # of the body's motion that is done
    part: Float[Array, ""]  # that is tried next
    pairs: Pairs  # over which energies are summed
    center: Float[Array, "3 vertices"]  # of the allowances [m]
    radius: Float[Array, " vertices"]  # allowances [m]
    gaps: Float[Array, " vertices"]  # between the vertices of `pairs` at the centre, the least of each [m]
    wide: Pairs
    wide_center: Float[Array, "3 vertices"]
    wide_radius: Float[Array, " vertices"]
    most: Int[Array, ""]  # rows that the fullest table would have needed
    searches: Int[Array, ""]
    lists: Int[Array, ""]
    is_passed: Bool[Array, ""]  # cloth was let through
    is_full: Bool[Array, ""]  # a table was too small at the least allowance


def start_course(position: Float[Array, "vertices 3"], rows: tuple[int, int]) -> Course:
    """Return the course before a frame: nothing is known of pairs.

    Args:
        position: Vertices at t [m], shape [vertices, 3].
        rows: Sizes of the wide and of the fine tables.
    """
    dtype, zero = position.dtype, jnp.int32(0)
    nowhere = jnp.zeros_like(position.T)
    nothing = jnp.zeros(position.shape[0], dtype)
    wide, fine = (Pairs(no_pairs(size, dtype), no_pairs(size, dtype)) for size in rows)
    no, one = jnp.zeros((), bool), jnp.ones((), dtype)
    return Course(
        0 * one, one, fine, nowhere, nothing, nothing, wide, nowhere, nothing, zero, zero, zero, no, no
    )


@struct.dataclass
class Around:
    """What a frame's course depends on."""

    meshes: Meshes
    body: Float[Array, "3 surface_vertices"]  # at t [m]
    way: Float[Array, "3 surface_vertices"]  # that the body moves in the frame [m]
    # By which the body takes the cloth along [m]; pins go where they must.
    carried: Float[Array, "3 vertices"]
    goal: Float[Array, "3 vertices"]  # where the solver would like to begin [m]
    is_free: Bool[Array, " vertices"]
    reach: Float[Array, ""]  # of contact [m]
    pieces: Int[Array, " vertices"] | None  # only cloth of different pieces may touch; None: all

    def joined(self, x: Float[Array, "3 vertices"], share: Array | float) -> Vector3:
        """Return the vertices of cloth and of the body, which has done a share of its way."""
        return _rows(jnp.concatenate([x, self.body + share * self.way], axis=1))

    def of_cloth(self, values: Float[Array, " vertices"]) -> Float[Array, " all"]:
        """Return values of the cloth's vertices, and zeros for the body's."""
        return jnp.pad(values, (0, self.body.shape[1]))


def follow(
    x: Float[Array, "3 vertices"], course: Course, around: Around
) -> tuple[Float[Array, "3 vertices"], Course]:
    """Let the body move on, if it has not come to the frame's end, and list the pairs around the cloth."""
    x, course = move_on(x, course, around)
    return x, _listed(x, course, around)


def move_on(
    x: Float[Array, "3 vertices"], course: Course, around: Around
) -> tuple[Float[Array, "3 vertices"], Course]:
    """Let the body move on, if it has not come to the frame's end, and search anew where that is due."""
    course = _searched(x, course, around)
    is_moving = course.part > 0
    return jax.lax.cond(is_moving, _carried, lambda x, course, around: (x, course), x, course, around)


def _searched(x: Array, course: Course, around: Around) -> Course:
    """Return the course with wide tables around x and its way, if those at hand don't serve."""
    remaining = 1.0 - course.share
    moved = safe_norm(x - course.wide_center, axis=0)
    is_due = (remaining > 0) | jnp.any((moved > _SPENT * course.wide_radius) & around.is_free)
    rows = course.wide.faces.areas.shape[0]

    def look(tried: Course, scale: Array) -> Course:
        part = jnp.minimum(scale * tried.part, remaining)
        # The goal counts once the body has arrived.
        ahead = jnp.where((part > 0) & (part >= remaining), around.goal - x - remaining * around.carried, 0.0)
        length = safe_norm(ahead, axis=0)
        ahead = ahead * jnp.minimum(1.0, scale * _FARTHEST / jnp.where(length > 0, length, 1.0))[None]
        way = part * around.carried + 0.5 * ahead
        # Once the body has arrived, only who has moved far can have new pairs. He may move as far again.
        is_whole = (remaining > 0) | (scale < 1)
        is_new = is_whole | (moved > _STALE * course.wide_radius)
        more = jnp.where(remaining > 0, _WIDE[0], jnp.clip(_AGAIN * moved, *_WIDE))
        radius = jnp.where(is_new, 0.5 * safe_norm(ahead, axis=0) + scale * more, course.wide_radius)
        origin = jnp.where(is_new, x, course.wide_center)
        whole = jnp.concatenate([way, part * around.way], axis=1)
        half = 0.5 * whole
        relative = half - 0.5 * part * jnp.mean(around.way, axis=1, keepdims=True)
        start = jnp.concatenate([origin, around.body + tried.share * around.way], axis=1)
        motion = Motion(_rows(start + half), _rows(relative), around.of_cloth(radius))
        of_new = jnp.concatenate([is_new, jnp.full(around.body.shape[1], is_whole)])
        known = nearer_pairs(motion.middle, motion.radius, course.wide, rows, of_new)
        found = find_pairs(motion, around.meshes, around.reach, known, of_new, around.pieces)
        return tried.replace(
            part=part,
            wide=found.pairs,
            wide_center=origin + way,
            wide_radius=radius,
            most=found.most,
            searches=tried.searches + 1,
        )

    def is_wanting(carry):
        tried, scale = carry
        return (tried.most > rows) & (scale > _LEAST_SCALE)

    def again(carry):
        tried, scale = carry
        return look(course.replace(searches=tried.searches), scale), 0.5 * scale

    def search() -> Course:
        full = course.replace(most=jnp.int32(rows + 1))
        tried, _ = jax.lax.while_loop(is_wanting, again, (full, jnp.ones((), x.dtype)))
        is_full = tried.most > rows
        return tried.replace(most=jnp.maximum(course.most, tried.most), is_full=course.is_full | is_full)

    return jax.lax.cond(is_due, search, lambda: course.replace(part=jnp.zeros_like(course.part)))


def _carried(x: Array, course: Course, around: Around) -> tuple[Array, Course]:
    """Let the body do a part of its way, with the cloth near it; half of it where cloth would be pushed far."""
    start = around.joined(x, course.share)
    is_free = jnp.pad(around.is_free, (0, around.body.shape[1]))

    def push(carry):
        part = 0.5 * carry[0]
        ways = jnp.concatenate([part * around.carried, part * around.way], axis=1)
        ends = _rows(jnp.stack(start) + ways)
        moved, lack = mended(start, ends, course.wide, is_free, _SWEEPS)
        farthest = jnp.max(safe_norm(jnp.stack(moved) - jnp.stack(ends), axis=0))
        return part, jnp.stack(moved)[:, : x.shape[1]], lack, farthest

    def is_wanting(carry):
        part, _, lack, farthest = carry
        return ~((lack == 0) & (farthest < _PUSH)) & (part > _LEAST_PART)

    untried = (2.0 * course.part, x, jnp.full((), jnp.inf, x.dtype), jnp.zeros((), x.dtype))
    part, moved, lack, _ = jax.lax.while_loop(is_wanting, push, untried)
    share = course.share + part
    # A whole that is added up of parts is one but for rounding.
    share = jnp.where(share > 1.0 - 0.5 * _LEAST_PART, 1.0, share)
    # Where the body has arrived, pairs that its motion alone might have brought together are left out.
    rows = course.wide.faces.areas.shape[0]
    there = around.joined(course.wide_center, share)
    wide = nearer_pairs(there, around.of_cloth(course.wide_radius), course.wide, rows).pairs
    return moved, course.replace(
        share=share, part=2.0 * part, wide=wide, is_passed=course.is_passed | (lack != 0)
    )


def _listed(x: Array, course: Course, around: Around) -> Course:
    """Return the course with fine tables around x, as wide as the last steps were long."""
    z = around.joined(x, course.share)
    is_first = course.lists == 0
    moved = jnp.where(
        is_first, safe_norm(around.goal - x, axis=0), _MOVES * safe_norm(x - course.center, axis=0)
    )
    room = course.wide_radius - safe_norm(x - course.wide_center, axis=0)
    wanted = jnp.clip(jnp.minimum(jnp.clip(moved, *_FINE), room), 0.0, None)
    rows = course.pairs.faces.areas.shape[0]

    def is_wanting(carry):
        found, _, scale = carry
        return (found.most > rows) & (scale > _LEAST_SCALE)

    def again(carry):
        _, _, scale = carry
        radius = scale * wanted
        return nearer_pairs(z, around.of_cloth(radius), course.wide, rows), radius, 0.5 * scale

    start = (Found(course.pairs, jnp.int32(rows + 1)), wanted, jnp.ones((), x.dtype))
    found, radius, _ = jax.lax.while_loop(is_wanting, again, start)
    return course.replace(
        pairs=found.pairs,
        center=x,
        radius=radius,
        gaps=least_gaps(z, found.pairs)[: x.shape[1]],
        lists=course.lists + 1,
        is_full=course.is_full | (found.most > rows),
    )


def limited(
    x: Float[Array, "3 vertices"], step: Float[Array, "3 vertices"], course: Course, around: Around
) -> Float[Array, "3 vertices"]:
    """Return a step [m] that crosses nothing and leaves no allowance, cut vertex by vertex."""
    away = x - course.center
    # Who stays within half of his gap meets nobody who does.
    is_clear = jnp.all(
        safe_norm(away + step, axis=0) < jnp.minimum(0.5 * CAUTION * course.gaps, course.radius)
    )
    return jax.lax.cond(is_clear, lambda: step, lambda: _cut(x, step, away, course, around))


def _cut(x: Array, step: Array, away: Array, course: Course, around: Around) -> Array:
    z = around.joined(x, 1.0)
    moves = _rows(jnp.concatenate([step, jnp.zeros_like(around.way)], axis=1))
    share = shares(z, moves, course.pairs, CAUTION)[: x.shape[1]]
    # The ball around the centre: |away + t step| = radius.
    b, c = jnp.sum(away * step, axis=0), jnp.sum(step * step, axis=0)
    rest = jnp.sum(away * away, axis=0) - jnp.square(course.radius)
    root = jnp.sqrt(jnp.maximum(b * b - c * rest, 0.0))
    ball = jnp.where(c > 0, (root - b) / jnp.where(c > 0, c, 1.0), 1.0)
    return jnp.clip(jnp.minimum(share, ball), 0.0, 1.0)[None] * step


def is_spent(x: Float[Array, "3 vertices"], course: Course, around: Around) -> Bool[Array, ""]:
    """Return whether a vertex has used up so much of its allowance that pairs should be looked for again."""
    return jnp.any((safe_norm(x - course.center, axis=0) > _SPENT * course.radius) & around.is_free)


def _rows(values: Float[Array, "3 vertices"]) -> Vector3:
    return (values[0], values[1], values[2])
