"""A frame's motion that nothing crosses: ends of straight ways are pushed until, for certain, no pair meets."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from eslr_jax.contact.lists import Meshes, Motion, find_pairs
from eslr_jax.contact.pairs import pushed_apart
from eslr_jax.numerics import Vector3, safe_norm

_MARGIN = 2e-3  # [m] that vertices may be pushed before pairs are looked for again
_SWEEPS = 60  # of pushes
_TRIES = 4  # searches for one part of the motion, before it is halved
_LEAST_PART = 1.0 / 64.0  # of the motion, at which cloth is let through
# Searches for the whole motion, after which it is, too. One or two do in hard cases and on a kick, three on a
# backflip. A shirt that the body left no room took 150 to 460, and was let through all the same.
_MOST_SEARCHES = 16


class Moved(NamedTuple):
    """Where cloth has got to."""

    position: Float[Array, "3 vertices"]  # [m]
    is_passed: Bool[Array, ""]  # something may have passed through the cloth, as pushes did not end
    most: Int[Array, ""]  # rows that the fullest search would have needed


class _Part(NamedTuple):
    """A part of the motion that is being tried."""

    x: Float[Array, "3 vertices"]  # where it begins [m]
    end: Float[Array, "3 vertices"]  # that is tried [m]
    share: Float[Array, ""]  # of the motion that is done
    length: Float[Array, ""]  # share of the part
    tries: Int[Array, ""]
    searches: Int[Array, ""]  # for the whole motion
    is_passed: Bool[Array, ""]
    most: Int[Array, ""]


def move_clear(
    x: Float[Array, "3 vertices"],
    way: Float[Array, "3 vertices"],
    body: Float[Array, "3 surface_vertices"],
    body_way: Float[Array, "3 surface_vertices"],
    meshes: Meshes,
    freedom: Int[Array, " vertices"],
    rows: int,
) -> Moved:
    """Move cloth along its way, off which it is pushed where it would cross the body or itself.

    All vertices go straight and at one pace. Where pushes do not end, a part of the motion is made first.

    Args:
        x: Cloth that nothing crosses [m].
        way: That it would go [m].
        body: Vertices of the body [m].
        body_way: That the body goes [m].
        meshes: Of both.
        freedom: Of the cloth's vertices, as `pairs.pushed_apart` takes it; the body has none.
        rows: Size of the tables of pairs; static.
    """
    count = x.shape[1]
    ways = jnp.concatenate([way, body_way], axis=1)
    drift = jnp.mean(ways, axis=1, keepdims=True)  # that all share: boxes are smaller without it
    freedom = jnp.pad(freedom, (0, body.shape[1]))
    radius = jnp.where(freedom > 0, jnp.asarray(_MARGIN, x.dtype), 0.0)

    def attempt(part: _Part) -> _Part:
        share = part.share + part.length
        start = jnp.concatenate([part.x, body + part.share * body_way], axis=1)
        end = jnp.concatenate([part.end, body + share * body_way], axis=1)
        half = 0.5 * (end - start)
        motion = Motion(_rows(start + half), _rows(half - 0.5 * part.length * drift), radius)
        found = find_pairs(motion, meshes, rows)
        pushed = pushed_apart(_rows(start), _rows(end), found.pairs, freedom, _SWEEPS)
        reached = jnp.stack(pushed.end)[:, :count]
        farthest = jnp.max(safe_norm(reached - part.end, axis=0))
        is_full = found.most > rows
        is_clear = (pushed.lack == 0) & (farthest <= _MARGIN) & ~is_full
        is_tried = part.tries + 1 >= _TRIES
        is_late = part.searches + 1 >= _MOST_SEARCHES
        # With too small a table the frame is done anew.
        is_done = is_clear | is_full | is_late | (is_tried & (part.length <= _LEAST_PART))
        is_halved = is_tried & ~is_done
        share = jnp.where(is_done, share, part.share)
        rest = 1.0 - share
        longer = jnp.where(is_late, rest, jnp.minimum(2.0 * part.length, rest))
        length = jnp.where(is_done, longer, jnp.where(is_halved, 0.5 * part.length, part.length))
        here = jnp.where(is_done, reached, part.x)
        is_new = is_done | is_halved
        return _Part(
            x=here,
            end=jnp.where(is_new, here + length * way, reached),
            share=share,
            length=length,
            tries=jnp.where(is_new, 0, part.tries + 1),
            searches=part.searches + 1,
            is_passed=part.is_passed | (is_done & ~is_clear),
            most=jnp.maximum(part.most, found.most),
        )

    one, no = jnp.ones((), x.dtype), jnp.zeros((), bool)
    whole = _Part(x, x + way, 0.0 * one, one, jnp.int32(0), jnp.int32(0), no, jnp.int32(0))
    final = jax.lax.while_loop(lambda part: part.share < 1.0, attempt, whole)
    return Moved(final.x, final.is_passed, final.most)


def _rows(values: Float[Array, "3 vertices"]) -> Vector3:
    return (values[0], values[1], values[2])
