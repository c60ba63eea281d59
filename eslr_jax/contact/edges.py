"""Edges of the cloth over edges of the body, where both may cross between vertices that keep off each other."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from eslr_jax.numerics import dot3, safe_normalize
from eslr_jax.types import BodySurface, Contacts, Garment

_BESIDE = 0.005  # [m] of the line between both edges that may be across the body's normal
_UNDER = 0.02  # [m] that an edge may already be in the body; deeper ones belong to another limb
_LEAST_SINE = 0.1  # of the angle between two edges, below which they are parallel and cross nowhere


class Cloth(NamedTuple):
    """Cloth at both ends of a frame."""

    now: Float[Array, "vertices 3"]  # at t [m]
    next: Float[Array, "vertices 3"]  # a guess for t + 1, such as the inertial one [m]


class Skin(NamedTuple):
    """The body's vertices at both ends of a frame."""

    now: Float[Array, "surface_vertices 3"]  # at t [m]
    next: Float[Array, "surface_vertices 3"]  # at t + 1 [m]
    normals: Float[Array, "surface_vertices 3"]
    next_normals: Float[Array, "surface_vertices 3"]


class Crossings(NamedTuple):
    """Places where an edge of the cloth lies over an edge of the body."""

    ends: Int[Array, "rows 2"]  # of the cloth's edge
    weights: Float[Array, "rows 2"]  # of both
    next_points: Float[Array, "rows 3"]  # on the body's edge at t + 1 [m]
    next_normals: Float[Array, "rows 3"]  # of the body there
    clearance: Float[
        Array, " rows"
    ]  # the lower height of the cloth, at t or t + 1 [m]; infinite: no crossing


def leave_body_faces(
    cloth: Cloth, skin: Skin, nearest: Contacts, surface: BodySurface, garment: Garment
) -> Crossings:
    """Return where edges of the cloth leave the body faces under their ends.

    Args:
        cloth: Vertices of the garment.
        skin: Vertices of the body.
        nearest: The nearest body point of every cloth vertex.
        surface: Faces of the body.
        garment: Its directed edges: both directions look at both ends' faces.
    """
    sender, receiver = (_gathered(cloth, rows) for rows in (garment.senders, garment.receivers))
    corners = surface.faces[nearest.faces[garment.senders]]
    body = [_gathered(skin, corners[:, k]) for k in range(3)]
    is_used = garment.edge_mask & nearest.is_near[garment.senders]
    found = [_cross((sender, receiver), (body[k], body[(k + 1) % 3]), is_used) for k in range(3)]
    ends = jnp.stack([garment.senders, garment.receivers], axis=1)
    return _lowest([(ends, one) for one in found])


def leave_cloth_faces(
    cloth: Cloth,
    skin: Skin,
    vertices: Int[Array, " starts"],
    corners: Int[Array, "starts 3"],
    surface: BodySurface,
) -> Crossings:
    """Return where edges of the body leave the cloth faces over their ends.

    Args:
        cloth: Vertices of the garment.
        skin: Vertices of the body.
        vertices: Those of the body where edges start.
        corners: Of the cloth face that is nearest to each.
        surface: Edges of the body.
    """
    slots = surface.face_incidence[vertices]  # [starts, degree]
    num_faces, flat = surface.faces.shape[0], surface.faces.T.ravel()
    is_used = (slots < flat.size).ravel()
    # The corner that follows a vertex in each of its faces: around an inner vertex, every neighbour once.
    other = flat[(slots + num_faces) % flat.size].ravel()
    degree = slots.shape[1]
    start, end = jnp.repeat(_gathered(skin, vertices), degree, axis=2), _gathered(skin, other)
    face = [jnp.repeat(_gathered(cloth, corners[:, k]), degree, axis=2) for k in range(3)]
    found = []
    for k in range(3):
        ends = jnp.repeat(jnp.stack([corners[:, k], corners[:, (k + 1) % 3]], axis=1), degree, axis=0)
        found.append((ends, _cross((face[k], face[(k + 1) % 3]), (start, end), is_used)))
    return _lowest(found)


def _gathered(parts: tuple[Float[Array, "vertices 3"], ...], rows: Int[Array, " rows"]) -> Array:
    """Return rows of several arrays, components first: one read for all of them."""
    return jnp.concatenate(parts, axis=1)[rows].T.reshape(len(parts), 3, -1)


def _cross(
    cloth: tuple[Float[Array, "2 3 rows"], Float[Array, "2 3 rows"]],
    body: tuple[Float[Array, "4 3 rows"], Float[Array, "4 3 rows"]],
    is_used: Bool[Array, " rows"],
) -> Float[Array, "8 rows"]:
    """Return clearance, share of the cloth's second end, and the body's place and normal at t + 1."""
    (first, second), (start, end) = cloth, body
    side, along, offset = (tuple(x) for x in (end[0] - start[0], second[0] - first[0], start[0] - first[0]))
    a, b, c = dot3(side, side), dot3(side, along), dot3(along, along)  # type: ignore[arg-type]
    d, e = dot3(side, offset), dot3(along, offset)  # type: ignore[arg-type]
    determinant = a * c - b * b
    is_crossing = is_used & (determinant > _LEAST_SINE**2 * a * c)
    inverse = 1.0 / jnp.where(is_crossing, determinant, 1.0)
    at_body, at_cloth = (b * e - c * d) * inverse, (a * e - b * d) * inverse
    for share in (at_body, at_cloth):
        is_crossing = is_crossing & (share > 0.0) & (share < 1.0)
    here, ahead, normal, next_normal = start + at_body[None, None] * (end - start)
    normal, next_normal = safe_normalize(normal, axis=0), safe_normalize(next_normal, axis=0)
    gap, next_gap = first + at_cloth[None, None] * (second - first) - jnp.stack([here, ahead])
    over, next_over = jnp.sum(gap * normal, axis=0), jnp.sum(next_gap * next_normal, axis=0)
    is_over = (jnp.sum(gap * gap, axis=0) - over * over < _BESIDE**2) & (over > -_UNDER)
    clearance = jnp.where(is_crossing & is_over, jnp.minimum(over, next_over), jnp.inf)
    return jnp.concatenate([clearance[None], at_cloth[None], ahead, next_normal])


def _lowest(found: list[tuple[Int[Array, "rows 2"], Float[Array, "8 rows"]]]) -> Crossings:
    """Return the candidate with the least clearance."""
    ends, best = found[0]
    for other, row in found[1:]:
        is_lower = row[0] < best[0]
        ends = jnp.where(is_lower[:, None], other, ends)
        best = jnp.where(is_lower[None], row, best)
    return Crossings(
        ends=ends,
        weights=jnp.stack([1.0 - best[1], best[1]], axis=1),
        next_points=best[2:5].T,
        next_normals=best[5:8].T,
        clearance=best[0],
    )
