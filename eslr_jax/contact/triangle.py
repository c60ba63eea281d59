"""The nearest point on a triangle."""

from __future__ import annotations

import jax.numpy as jnp

from eslr_jax.numerics import Vector3, dot3, sub3


def point_triangle(point: Vector3, a: Vector3, b: Vector3, c: Vector3):
    """Return the squared distance to a triangle and the weights of b and c at the closest point.

    The closest of: the plane's foot point if inside, and the three edges. Degenerate triangles fall back to
    their edges.
    """
    ab, ac, ap = sub3(b, a), sub3(c, a), sub3(point, a)
    d00, d01, d11 = dot3(ab, ab), dot3(ab, ac), dot3(ac, ac)
    d20, d21, d22 = dot3(ap, ab), dot3(ap, ac), dot3(ap, ap)
    determinant = d00 * d11 - d01 * d01
    inverse = 1.0 / jnp.where(determinant > 0, determinant, 1.0)
    u = (d11 * d20 - d01 * d21) * inverse
    v = (d00 * d21 - d01 * d20) * inverse
    is_inside = (determinant > 0) & (u >= 0) & (v >= 0) & (u + v <= 1)

    def squared(u, v):
        return d22 + u * (u * d00 - 2 * d20 + 2 * v * d01) + v * (v * d11 - 2 * d21)

    def ratio(numerator, denominator):
        return jnp.clip(numerator / jnp.where(denominator > 0, denominator, 1.0), 0.0, 1.0)

    along_ab = ratio(d20, d00)
    along_ac = ratio(d21, d11)
    along_bc = ratio((d21 - d20) - (d01 - d00), d00 - 2 * d01 + d11)
    best_u, best_v, best = along_ab, jnp.zeros_like(along_ab), squared(along_ab, 0.0)
    for edge_u, edge_v in ((jnp.zeros_like(along_ac), along_ac), (1.0 - along_bc, along_bc)):
        value = squared(edge_u, edge_v)
        is_better = value < best
        best_u = jnp.where(is_better, edge_u, best_u)
        best_v = jnp.where(is_better, edge_v, best_v)
        best = jnp.where(is_better, value, best)
    u = jnp.where(is_inside, u, best_u)
    v = jnp.where(is_inside, v, best_v)
    return jnp.maximum(jnp.where(is_inside, squared(u, v), best), 0.0), u, v
