"""Edges of the cloth over edges of the body, where both may cross between vertices that keep off each other."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from eslr_jax.contact.search import following_vertices
from eslr_jax.numerics import dot3, safe_normalize, sub3
from eslr_jax.types import BodySurface

_BESIDE = 0.01  # [m] beside a place of the body, up to which cloth is over it; time_and_skin.py chose it
_UNDER = 0.02  # [m] that skin may already be through; beyond it the cloth belongs to another limb
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
    clearance: Float[Array, "surface_vertices 1"]  # of the cloth over them, see `clearance_over`


class Crossings(NamedTuple):
    """Places where an edge of the cloth lies over an edge of the body."""

    ends: Int[Array, "rows 2"]  # of the cloth's edge
    weights: Float[Array, "rows 2"]  # of both
    next_points: Float[Array, "rows 3"]  # on the body's edge at t + 1 [m]
    next_normals: Float[Array, "rows 3"]  # of the body there
    clearance: Float[Array, " rows"]  # of the cloth over the body's, see `clearance_over`
    areas: Float[Array, " rows"]  # of the body, mean of the ends of its edge [m^2]


def clearance_over(
    squared: Float[Array, "*shape"], over: Float[Array, "*shape"], next_over: Float[Array, "*shape"]
) -> Float[Array, "*shape"]:
    """Return how high cloth is over places of the body at t or t + 1, the lower one [m]; infinite beside them.

    Args:
        squared: Distance from the place at t, squared [m^2].
        over: Height along the body's normal at t [m].
        next_over: At t + 1.
    """
    is_over = (squared - over * over < _BESIDE**2) & (over > -_UNDER)
    return jnp.where(is_over, jnp.minimum(over, next_over), jnp.inf)


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
    other = following_vertices(slots, surface.faces)
    sides = jnp.stack([corners, jnp.roll(corners, -1, axis=1)], axis=2)  # [starts, 3, 2]

    def cross(first: Array, second: Array, here: Array, there: Array) -> _Crossing:
        return _cross(
            [_gathered(cloth, end) for end in (first, second)],
            [_gathered(skin, end) for end in (here, there)],
        )

    # Every end is read once, and meets the others by broadcasting: [starts, degree, 3].
    clearance = cross(
        sides[:, None, :, 0], sides[:, None, :, 1], vertices[:, None, None], other[:, :, None]
    ).clearance
    clearance = jnp.where((slots < surface.faces.size)[:, :, None], clearance, jnp.inf)
    _, lowest = jax.lax.top_k(-clearance.ravel(), count)
    start, slot, side = jnp.unravel_index(lowest, clearance.shape)
    ends = sides[start, side]
    here, there = vertices[start], other[start, slot]
    found = cross(ends[:, 0], ends[:, 1], here, there)
    return Crossings(
        ends=ends,
        weights=jnp.stack([1.0 - found.share, found.share], axis=1),
        next_points=found.next_point.T,
        next_normals=found.next_normal.T,
        clearance=clearance.ravel()[lowest],
        areas=0.5 * (surface.vertex_areas[here] + surface.vertex_areas[there]),
    )


def _gathered(
    parts: tuple[Float[Array, "vertices _"], ...], vertices: Int[Array, ...]
) -> Float[Array, "columns ..."]:
    """Return rows of several arrays, columns first: one read for all of them."""
    return jnp.moveaxis(jnp.concatenate(parts, axis=1)[vertices], -1, 0)


class _Crossing(NamedTuple):
    """How an edge of the cloth lies over one of the body."""

    clearance: Float[Array, ...]  # [m], infinite where they do not cross
    share: Float[Array, ...]  # of the second end of the cloth's edge
    next_point: Float[Array, "3 ..."]  # on the body's at t + 1 [m]
    next_normal: Float[Array, "3 ..."]


def _cross(cloth: Sequence[Float[Array, "6 ..."]], body: Sequence[Float[Array, "13 ..."]]) -> _Crossing:
    """Return how edges of the cloth lie over edges of the body, both by their two ends, which may broadcast."""
    first, second = (end.reshape(2, 3, *end.shape[1:]) for end in cloth)
    start, end = (end[:12].reshape(4, 3, *end.shape[1:]) for end in body)
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
    place, next_place = first + at_cloth[None, None] * (second - first)
    gap, next_gap = (sub3(tuple(x), tuple(y)) for x, y in ((place, here), (next_place, ahead)))  # type: ignore[arg-type]
    over, next_over = dot3(gap, tuple(normal)), dot3(next_gap, tuple(next_normal))  # type: ignore[arg-type]
    clearance = clearance_over(dot3(gap, gap), over, next_over)
    # Where the cloth is higher than over an end of the body's edge, that end keeps it off.
    is_lowest = clearance < jnp.minimum(body[0][12], body[1][12])
    return _Crossing(jnp.where(is_crossing & is_lowest, clearance, jnp.inf), at_cloth, ahead, next_normal)
