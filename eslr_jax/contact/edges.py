"""Contacts of the cloth's edges with the body's edges, which contacts of vertices miss."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from eslr_jax.contact.lines import cross_lines
from eslr_jax.contact.search import following_vertices
from eslr_jax.numerics import dot3, safe_normalize, sub3
from eslr_jax.types import BodySurface, Contacts, Garment

_BESIDE = 0.01  # [m] sideways from a place of the body, within which cloth is over it; by time_and_skin.py
_UNDER = 0.02  # [m] that cloth may already be under the skin; deeper cloth belongs to another limb
_LOOKED_AT = 4  # edges of the cloth that are tested per crossing that is kept


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
    over: tuple[Int[Array, " starts"], Int[Array, "starts 3"]],
    nearest: Contacts,
    garment: Garment,
    surface: BodySurface,
) -> Crossings:
    """Return where edges of cloth and body cross, and the cloth is lower than over the ends of the body's edge.

    An edge is tested against the three edges of the other mesh's face that is nearest to one of its ends. The
    search starts from edges of the body and from edges of the cloth: only the edges of the finer mesh find the
    middle of a long edge of the other. Every edge is tested from both ends.

    Args:
        cloth: Vertices of the garment.
        skin: Vertices of the body.
        over: Vertices of the body where edges start, and the corners of the cloth face that is nearest to each.
        nearest: The nearest body point of every cloth vertex.
        garment: Edges of the cloth.
        surface: Edges of the body.

    Returns:
        The crossings with the least clearance, a third as many as there are body vertices to start from.
    """
    count = -(-over[0].shape[0] // 3)
    found = [_from_body(over, surface), _from_cloth(nearest, garment, surface, _LOOKED_AT * count)]

    def cross(first: Array, second: Array, here: Array, there: Array) -> _Crossing:
        return _cross(
            [_gathered(cloth, end) for end in (first, second)],
            [_gathered(skin, end) for end in (here, there)],
        )

    clearance = jnp.concatenate(
        [jnp.where(edges.is_real, cross(*edges[:4]).clearance, jnp.inf).ravel() for edges in found]
    )
    clearance, lowest = jax.lax.top_k(-clearance, count)
    first, second, here, there = (
        jnp.concatenate([x.ravel() for x in ends])[lowest]
        for ends in zip(*(jnp.broadcast_arrays(*edges[:4]) for edges in found), strict=True)
    )
    kept = cross(first, second, here, there)
    return Crossings(
        ends=jnp.stack([first, second], axis=1),
        weights=jnp.stack([1.0 - kept.share, kept.share], axis=1),
        next_points=kept.next_point.T,
        next_normals=kept.next_normal.T,
        clearance=-clearance,
        areas=0.5 * (surface.vertex_areas[here] + surface.vertex_areas[there]),
    )


class _Edges(NamedTuple):
    """Edges of the cloth beside edges of the body, by their ends, which broadcast: each is read once."""

    first: Int[Array, ...]  # of the cloth
    second: Int[Array, ...]
    here: Int[Array, ...]  # of the body
    there: Int[Array, ...]
    is_real: Bool[Array, ...]


def _from_body(over: tuple[Int[Array, " starts"], Int[Array, "starts 3"]], surface: BodySurface) -> _Edges:
    """Return the edges around vertices of the body, and the three of the cloth face over each."""
    vertices, corners = over
    slots = surface.face_incidence[vertices]  # [starts, degree]
    first, second = corners[:, None, :], jnp.roll(corners, -1, axis=1)[:, None, :]
    is_real = (slots < surface.faces.size)[:, :, None]
    other = following_vertices(slots, surface.faces)[:, :, None]
    return _Edges(first, second, vertices[:, None, None], other, is_real)


def _from_cloth(nearest: Contacts, garment: Garment, surface: BodySurface, count: int) -> _Edges:
    """Return the lowest edges of the cloth, and the three of the body face under either end.

    An edge whose ends are over one face crosses nothing.
    """
    ends = jnp.stack([garment.senders, garment.receivers], axis=1)
    under = nearest.faces[ends]
    is_across = (ends[:, 0] < ends[:, 1]) & garment.edge_mask & (under[:, 0] != under[:, 1])
    height = jnp.where(nearest.is_near, nearest.distances, jnp.inf)[ends].min(axis=1)
    height, lowest = jax.lax.top_k(-jnp.where(is_across, height, jnp.inf), min(count, len(ends)))
    corners = surface.faces[under[lowest]]  # [edges, 2, 3]
    first, second = ends[lowest, 0, None, None], ends[lowest, 1, None, None]
    return _Edges(first, second, corners, jnp.roll(corners, -1, axis=2), jnp.isfinite(height)[:, None, None])


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
    at_body, at_cloth, is_crossing = cross_lines(
        (tuple(start[0]), tuple(end[0])), (tuple(first[0]), tuple(second[0]))
    )
    here, ahead, normal, next_normal = start + at_body[None, None] * (end - start)
    normal, next_normal = safe_normalize(normal, axis=0), safe_normalize(next_normal, axis=0)
    place, next_place = first + at_cloth[None, None] * (second - first)
    gap, next_gap = (sub3(tuple(x), tuple(y)) for x, y in ((place, here), (next_place, ahead)))  # type: ignore[arg-type]
    over, next_over = dot3(gap, tuple(normal)), dot3(next_gap, tuple(next_normal))  # type: ignore[arg-type]
    clearance = clearance_over(dot3(gap, gap), over, next_over)
    # Where the cloth is higher than over an end of the body's edge, that end keeps it off.
    is_lowest = clearance < jnp.minimum(body[0][12], body[1][12])
    return _Crossing(jnp.where(is_crossing & is_lowest, clearance, jnp.inf), at_cloth, ahead, next_normal)
