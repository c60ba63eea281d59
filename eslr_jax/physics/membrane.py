"""Stretch: a Saint Venant-Kirchhoff membrane."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from eslr_jax.numerics import Vector3, dot3, gather_corners, in_memory, sub3
from eslr_jax.types import Garment, Material


def deformation_gradient(
    position: Float[Array, "vertices 3"] | Vector3, garment: Garment
) -> tuple[Vector3, Vector3]:
    """Return the two columns of F = D_s D_m^-1 per face, by components.

    D_s = [x0 - x2 | x1 - x2] and D_m the same edges in the rest triangle's own plane.
    """
    x0, x1, x2 = gather_corners(position, garment.faces, garment.face_incidence)
    a, b = sub3(x0, x2), sub3(x1, x2)
    inverse = garment.inverse_rest_frames
    i00, i01, i10, i11 = in_memory(inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 0], inverse[:, 1, 1])
    first = (a[0] * i00 + b[0] * i10, a[1] * i00 + b[1] * i10, a[2] * i00 + b[2] * i10)
    second = (a[0] * i01 + b[0] * i11, a[1] * i01 + b[1] * i11, a[2] * i01 + b[2] * i11)
    return first, second


def stretch_energy(
    position: Float[Array, "vertices 3"] | Vector3, garment: Garment, material: Material
) -> Float[Array, ""]:
    """Return the membrane energy [J].

    E = sum_f A_f h (mu tr(G^T G) + lambda/2 tr(G)^2), with the Green strain G = (F^T F - I) / 2.

    Args:
        position: Vertex positions [m], shape [vertices, 3].
        garment: Rest areas A_f and frames.
        material: Thickness h [m] and Lame parameters mu, lambda [Pa].

    Source: HOOD (arXiv 2212.07242), supplementary; Santesteban et al. 2022, eq. 5.
    """
    first, second = deformation_gradient(position, garment)
    g00 = 0.5 * (dot3(first, first) - 1.0)
    g11 = 0.5 * (dot3(second, second) - 1.0)
    g01 = 0.5 * dot3(first, second)
    trace = g00 + g11
    volumes = garment.rest_areas * material.thickness
    mu, half_lambda = in_memory(volumes * material.lame_mu, 0.5 * volumes * material.lame_lambda)
    return jnp.sum(mu * (g00 * g00 + g11 * g11 + 2.0 * g01 * g01) + half_lambda * trace * trace)


def principal_stretches(
    position: Float[Array, "vertices 3"], garment: Garment
) -> tuple[Float[Array, " faces"], Float[Array, " faces"]]:
    """Return the larger and smaller singular value of F per face; padded faces give zero."""
    first, second = deformation_gradient(position, garment)
    c00, c11, c01 = dot3(first, first), dot3(second, second), dot3(first, second)
    mean = 0.5 * (c00 + c11)
    radius = jnp.sqrt(jnp.maximum((0.5 * (c00 - c11)) ** 2 + c01 * c01, 0.0))
    return jnp.sqrt(mean + radius), jnp.sqrt(jnp.maximum(mean - radius, 0.0))
