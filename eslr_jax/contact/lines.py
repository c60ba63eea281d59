"""Where two edges cross, of cloth or of a body."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from eslr_jax.numerics import Vector3, dot3, sub3

_LEAST_SINE = 0.1  # of the angle between two edges, below which they are parallel and cross nowhere


def cross_lines(
    one: tuple[Vector3, Vector3], other: tuple[Vector3, Vector3]
) -> tuple[Float[Array, ...], Float[Array, ...], Bool[Array, ...]]:
    """Return where the lines through two edges are nearest, as shares of the edges, and whether within both.

    Edges that are nearly parallel cross nowhere.

    Args:
        one: Both ends of edges, by components.
        other: Of edges of their own; shapes broadcast.
    """
    along, across, offset = sub3(one[1], one[0]), sub3(other[1], other[0]), sub3(one[0], other[0])
    a, b, c = dot3(along, along), dot3(along, across), dot3(across, across)
    d, e = dot3(along, offset), dot3(across, offset)
    determinant = a * c - b * b
    is_crossing = determinant > _LEAST_SINE**2 * a * c
    inverse = 1.0 / jnp.where(is_crossing, determinant, 1.0)
    at_one, at_other = (b * e - c * d) * inverse, (a * e - b * d) * inverse
    for share in (at_one, at_other):
        is_crossing = is_crossing & (share > 0.0) & (share < 1.0)
    return at_one, at_other, is_crossing
