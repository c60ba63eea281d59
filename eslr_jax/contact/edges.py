"""Edges of the cloth over edges of the body, where both may cross between vertices that keep off each other."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from eslr_jax.numerics import dot3, safe_normalize
from eslr_jax.types import BodySurface

_BESIDE = 0.005  # [m] of the line between both edges that may be across the body's normal
_UNDER = 0.02  # [m] that an edge may already be in the body; deeper ones belong to another limb
_LEAST_SINE = 0.1  # of the angle between two edges, below which they are parallel and cross nowhere


class Cloth(NamedTuple):
    """Cloth at both ends of a frame."""

    now: Float[Array, "vertices 3"]  # at t [m]
    next: Float[Array, "vertices 3"]  # a guess for t + 1, such as the inertial one [m]


class Skin(NamedTuple):
    """The body's vertices at both ends of a frame, and how high the cloth is over them."""

    now: Float[Array, "surface_vertices 3"]  # at t [m]
    next: Float[Array, "surface_vertices 3"]  # at t + 1 [m]
    normals: Float[Array, "surface_vertices 3"]
    next_normals: Float[Array, "surface_vertices 3"]
    clearance: Float[
        Array, "surface_vertices 1"
    ]  # the cloth's lower height, at t or t + 1 [m]; infinite: far


class Crossings(NamedTuple):
    """Places where an edge of the cloth lies over an edge of the body."""

    ends: Int[Array, "rows 2"]  # of the cloth's edge
    weights: Float[Array, "rows 2"]  # of both
    next_points: Float[Array, "rows 3"]  # on the body's edge at t + 1 [m]
    next_normals: Float[Array, "rows 3"]  # of the body there
    clearance: Float[Array, " rows"]  # the cloth's lower height, at t or t + 1 [m]; infinite: no crossing


def find_crossings(
    cloth: Cloth,
    skin: Skin,
    vertices: Int[Array, " starts"],
    corners: Int[Array, "starts 3"],
    surface: BodySurface,
    count: int,
) -> Crossings:
    """Return where edges of the body leave the cloth faces over their ends, and the cloth is lower than there.

    The nearest face over one end of an edge says which edges of the cloth it may cross: three. Every edge is
    looked at from both ends. Edges of the cloth that cross more than one edge of the body are found from each.

    Args:
        cloth: Vertices of the garment.
        skin: Vertices of the body.
        vertices: Those of the body where edges start.
        corners: Of the cloth face that is nearest to each.
        surface: Edges of the body.
        count: Rows to return, those with the least clearance.
    """
    slots = surface.face_incidence[vertices]  # [starts, degree]
    num_faces, flat = surface.faces.shape[0], surface.faces.T.ravel()
    # The corner that follows a vertex in each of its faces: around an inner vertex, every neighbour once.
    other = flat[(slots + num_faces) % flat.size]
    sides = jnp.stack([corners, jnp.roll(corners, -1, axis=1)], axis=2)  # [starts, 3, 2]
    shape = (vertices.size, slots.shape[1], 3)

    def cross(start: Array, slot: Array, side: Array) -> tuple[_Crossing, Int[Array, "rows 2"]]:
        ends = sides[start, side]
        first, second = _gathered(cloth, ends[:, 0]), _gathered(cloth, ends[:, 1])
        here, there = _gathered(skin, vertices[start]), _gathered(skin, other[start, slot])
        return _cross((first, second), (here, there)), ends

    everything = jnp.unravel_index(jnp.arange(np.prod(shape)), shape)
    clearance = cross(*everything)[0].clearance.reshape(shape)
    clearance = jnp.where((slots < flat.size)[:, :, None], clearance, jnp.inf)
    _, lowest = jax.lax.top_k(-clearance.ravel(), count)
    found, ends = cross(*jnp.unravel_index(lowest, shape))
    return Crossings(
        ends=ends,
        weights=jnp.stack([1.0 - found.share, found.share], axis=1),
        next_points=found.next_point.T,
        next_normals=found.next_normal.T,
        clearance=clearance.ravel()[lowest],
    )


def _gathered(
    parts: tuple[Float[Array, "vertices _"], ...], rows: Int[Array, " rows"]
) -> Float[Array, "columns rows"]:
    """Return rows of several arrays, columns first: one read for all of them."""
    return jnp.concatenate(parts, axis=1)[rows].T


class _Crossing(NamedTuple):
    """How an edge of the cloth lies over one of the body."""

    clearance: Float[Array, " rows"]  # [m], infinite where they do not cross
    share: Float[Array, " rows"]  # of the second end of the cloth's edge
    next_point: Float[Array, "3 rows"]  # on the body's at t + 1 [m]
    next_normal: Float[Array, "3 rows"]


def _cross(
    cloth: tuple[Float[Array, "6 rows"], Float[Array, "6 rows"]],
    body: tuple[Float[Array, "13 rows"], Float[Array, "13 rows"]],
) -> _Crossing:
    """Return how edges of the cloth lie over edges of the body, both by their ends."""
    first, second = (rows.reshape(2, 3, -1) for rows in cloth)
    start, end = (rows[:12].reshape(4, 3, -1) for rows in body)
    side, along, offset = (tuple(x) for x in (end[0] - start[0], second[0] - first[0], start[0] - first[0]))
    a, b, c = dot3(side, side), dot3(side, along), dot3(along, along)  # type: ignore[arg-type]
    d, e = dot3(side, offset), dot3(along, offset)  # type: ignore[arg-type]
    determinant = a * c - b * b
    is_crossing = determinant > _LEAST_SINE**2 * a * c
    inverse = 1.0 / jnp.where(is_crossing, determinant, 1.0)
    at_body, at_cloth = (b * e - c * d) * inverse, (a * e - b * d) * inverse
    for share in (at_body, at_cloth):
        is_crossing = is_crossing & (share > 0.0) & (share < 1.0)
    here, ahead, normal, next_normal = start + at_body[None, None] * (end - start)
    normal, next_normal = safe_normalize(normal, axis=0), safe_normalize(next_normal, axis=0)
    gap, next_gap = first + at_cloth[None, None] * (second - first) - jnp.stack([here, ahead])
    over, next_over = jnp.sum(gap * normal, axis=0), jnp.sum(next_gap * next_normal, axis=0)
    is_over = (jnp.sum(gap * gap, axis=0) - over * over < _BESIDE**2) & (over > -_UNDER)
    lower = jnp.minimum(over, next_over)
    # Where the cloth is higher than over an end of the body's edge, that end keeps it off.
    is_lowest = lower < jnp.minimum(body[0][12], body[1][12])
    clearance = jnp.where(is_crossing & is_over & is_lowest, lower, jnp.inf)
    return _Crossing(clearance, at_cloth, ahead, next_normal)
