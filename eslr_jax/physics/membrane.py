"""Stretch: a Saint Venant-Kirchhoff membrane."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from eslr_jax.numerics import Vector3, dot3, gather_corners, in_memory, sub3
from eslr_jax.types import Garment, Material


def deformation_gradient(corners: tuple[Vector3, ...], garment: Garment) -> tuple[Vector3, Vector3]:
    """Return the two columns of F = D_s D_m^-1 per face, by components.

    D_s = [x0 - x2 | x1 - x2] and D_m the same edges in the rest triangle's own plane.
    """
    x0, x1, x2 = corners
    a, b = sub3(x0, x2), sub3(x1, x2)
    inverse = garment.inverse_rest_frames
    i00, i01, i10, i11 = in_memory(inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 0], inverse[:, 1, 1])
    first = (a[0] * i00 + b[0] * i10, a[1] * i00 + b[1] * i10, a[2] * i00 + b[2] * i10)
    second = (a[0] * i01 + b[0] * i11, a[1] * i01 + b[1] * i11, a[2] * i01 + b[2] * i11)
    return first, second


def stretch_energy(
    position: Float[Array, "vertices 3"] | Vector3, garment: Garment, material: Material
) -> Float[Array, ""]:
    """Return the membrane energy [J], the sum of `face_energies` at positions [m], shape [vertices, 3]."""
    corners = gather_corners(position, garment.faces, garment.face_incidence)
    return jnp.sum(face_energies(corners, garment, material))


def face_energies(
    corners: tuple[Vector3, ...], garment: Garment, material: Material
) -> Float[Array, " faces"]:
    """Return the membrane energy of every face [J].

    E_f = A_f h (mu tr(G^T G) + lambda/2 tr(G)^2), with the Green strain G = (F^T F - I) / 2.

    Args:
        corners: Positions of the faces' corners [m], of `gather_corners`.
        garment: Rest areas A_f and frames.
        material: Thickness h [m] and Lame parameters mu, lambda [Pa].

    Source: HOOD (arXiv 2212.07242), supplementary; Santesteban et al. 2022, eq. 5.
    """
    return strain_energies(green_strains(corners, garment), garment, material)


def green_strains(corners: tuple[Vector3, ...], garment: Garment) -> Vector3:
    """Return the components 00, 11 and 01 of the Green strain of every face.

    Args:
        corners: Positions of the faces' corners [m], of `gather_corners`.
        garment: Rest frames.
    """
    first, second = deformation_gradient(corners, garment)
    return (
        0.5 * (dot3(first, first) - 1.0),
        0.5 * (dot3(second, second) - 1.0),
        0.5 * dot3(first, second),
    )


def strain_energies(strains: Vector3, garment: Garment, material: Material) -> Float[Array, " faces"]:
    """Return the energy of every face [J] by its strain, of `green_strains`."""
    g00, g11, g01 = strains
    trace = g00 + g11
    volumes = garment.rest_areas * material.thickness
    mu, half_lambda = in_memory(volumes * material.lame_mu, 0.5 * volumes * material.lame_lambda)
    return mu * (g00 * g00 + g11 * g11 + 2.0 * g01 * g01) + half_lambda * trace * trace


def principal_stretches(
    position: Float[Array, "vertices 3"], garment: Garment
) -> tuple[Float[Array, " faces"], Float[Array, " faces"]]:
    """Return the larger and smaller singular value of F per face; padded faces give zero."""
    corners = gather_corners(position, garment.faces, garment.face_incidence)
    first, second = deformation_gradient(corners, garment)
    c00, c11, c01 = dot3(first, first), dot3(second, second), dot3(first, second)
    mean = 0.5 * (c00 + c11)
    radius = jnp.sqrt(jnp.maximum((0.5 * (c00 - c11)) ** 2 + c01 * c01, 0.0))
    return jnp.sqrt(mean + radius), jnp.sqrt(jnp.maximum(mean - radius, 0.0))
