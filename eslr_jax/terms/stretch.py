"""Stretch: a Saint Venant-Kirchhoff membrane, isotropic or with warp and weft."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from eslr_jax.numerics import (
    Vector3,
    dot3,
    gather_corners,
    in_memory,
    safe_norm,
    safe_sqrt,
    scatter_corners,
    sub3,
)
from eslr_jax.terms.term import FrameProblem, Term
from eslr_jax.types import Garment, Material, Threads

_STIFFEST = 85.2  # [N/m], of the fabrics that networks are trained on (HOOD's ranges)

STIFFENING = 0.01  # strain beyond a thread's limit at which it is twice as stiff


@struct.dataclass
class Stretch(Term):
    """The membrane's energy."""

    name = "stretch"
    on = "faces"
    is_elastic = True

    def corner_energies(
        self, corners: tuple[Vector3, ...], problem: FrameProblem, data: Any
    ) -> Float[Array, " faces"]:
        """Return the energy of every face [J]; see `face_energies`."""
        return face_energies(corners, problem.garment, problem.material)

    def diagonal(self, x: Vector3, problem: FrameProblem, data: Any) -> Float[Array, " vertices"]:
        """Return the curvature at rest [N/m]; see `stretch_diagonal`."""
        return stretch_diagonal(problem.garment, problem.material)


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
    A_f is the area at rest, h the thickness [m], mu and lambda the Lame parameters [Pa].

    Source: HOOD (arXiv 2212.07242), supplementary; Santesteban et al. 2022, eq. 5.
    """
    strains = green_strains(corners, garment)
    energies = strain_energies(strains, garment, material)
    if material.threads is None or material.threads.limits is None:
        return energies
    return energies + _limit_energies(strains, garment, material.threads, material.threads.limits)


def green_strains(corners: tuple[Vector3, ...], garment: Garment) -> Vector3:
    """Return the components 00, 11 and 01 of the Green strain of every face, by its corners [m]."""
    first, second = deformation_gradient(corners, garment)
    diagonal = 0.5 * (dot3(first, first) - 1.0), 0.5 * (dot3(second, second) - 1.0)
    return (*diagonal, 0.5 * dot3(first, second))


def strain_energies(strains: Vector3, garment: Garment, material: Material) -> Float[Array, " faces"]:
    """Return the quadratic energy of every face [J] by its strain, of `green_strains`.

    With threads A (C_w G_ww^2 / 2 + C_f G_ff^2 / 2 + C_wf G_ww G_ff + 2 C_s G_wf^2), w along warp and f along
    weft.
    """
    if material.threads is not None:
        warp, weft, mixed = thread_strains(strains, material.threads)
        along, across, coupling, shear = in_memory(*material.threads.stiffness)
        quadratic = 0.5 * (along * warp * warp + across * weft * weft) + coupling * warp * weft
        return garment.rest_areas * (quadratic + 2.0 * shear * mixed * mixed)
    g00, g11, g01 = strains
    trace = g00 + g11
    volumes = garment.rest_areas * material.thickness
    mu, half_lambda = in_memory(volumes * material.lame_mu, 0.5 * volumes * material.lame_lambda)
    return mu * (g00 * g00 + g11 * g11 + 2.0 * g01 * g01) + half_lambda * trace * trace


def thread_strains(strains: Vector3, threads: Threads) -> Vector3:
    """Return the Green strain of every face along warp, along weft and mixed, of `green_strains`."""
    g00, g11, g01 = strains
    c, s = in_memory(threads.warp[:, 0], threads.warp[:, 1])
    turned = 2.0 * c * s * g01
    return (
        c * c * g00 + s * s * g11 + turned,
        s * s * g00 + c * c * g11 - turned,
        c * s * (g11 - g00) + (c * c - s * s) * g01,
    )


def _limit_energies(
    strains: Vector3, garment: Garment, threads: Threads, limits: Float[Array, "2 faces"]
) -> Float[Array, " faces"]:
    """Return what threads add to the energy of every face [J] beyond their limits.

    A C max(G - G_limit, 0)^3 / (6 s): the stiffness C of a thread grows in proportion to the strain beyond
    its limit, to 2 C at s.
    """
    warp, weft, _ = thread_strains(strains, threads)
    energy = jnp.zeros_like(warp)
    for strain, limit, stiffness in zip((warp, weft), limits, threads.stiffness, strict=False):
        limit, stiffness = in_memory(limit, stiffness)
        energy = energy + stiffness * jnp.maximum(strain - limit, 0.0) ** 3
    return garment.rest_areas * energy / (6.0 * STIFFENING)


def stretch_diagonal(garment: Garment, material: Material) -> Float[Array, " vertices"]:
    """Return the membrane's stiffness per vertex at rest [N/m], averaged over the triangle's plane.

    Moving one corner along its height changes the strain by 1/height, so the curvature is A h (lambda + 2 mu)
    / height^2 = h (lambda + 2 mu) |opposite edge|^2 / (4 A); with threads their mean stiffness.
    """
    corners = garment.sewn_positions[garment.faces]
    opposite = corners[:, [2, 0, 1]] - corners[:, [1, 2, 0]]
    squared = jnp.sum(opposite * opposite, axis=-1)
    if material.threads is None:
        modulus = material.thickness * (material.lame_lambda + 2.0 * material.lame_mu)
    else:  # averaged over the plane as well
        modulus = 0.5 * (material.threads.stiffness[0] + material.threads.stiffness[1])
    is_real = garment.rest_areas > 0
    scale = jnp.where(is_real, modulus / (4.0 * jnp.where(is_real, garment.rest_areas, 1.0)), 0.0)
    return scatter_corners(scale[:, None] * squared, garment.face_incidence)


def principal_stretches(
    position: Float[Array, "vertices 3"], garment: Garment
) -> tuple[Float[Array, " faces"], Float[Array, " faces"]]:
    """Return the larger and smaller singular value of F per face; padded faces give zero."""
    corners = gather_corners(position, garment.faces, garment.face_incidence)
    first, second = deformation_gradient(corners, garment)
    c00, c11, c01 = dot3(first, first), dot3(second, second), dot3(first, second)
    mean = 0.5 * (c00 + c11)
    # Equal stretches, as at rest, and a collapsed face are roots of zero, where a plain root has no slope.
    radius = safe_norm(jnp.stack([0.5 * (c00 - c11), c01], axis=-1))
    return safe_sqrt(mean + radius), safe_sqrt(mean - radius)


def stretch_stiffness(material: Material) -> Float[Array, " *faces"]:
    """Return the tension per width and strain of a fabric that is pulled along one axis [N/m].

    It is E h = 4 mu h (mu + lambda) / (2 mu + lambda), of plane stress; of threads the stiffer one's.
    """
    if material.threads is not None:
        return jnp.max(jnp.asarray(material.threads.stiffness)[:2], axis=0)
    mu, lame_lambda = jnp.asarray(material.lame_mu), jnp.asarray(material.lame_lambda)
    return 4.0 * jnp.asarray(material.thickness) * mu * (mu + lame_lambda) / (2.0 * mu + lame_lambda)


def contact_excess(material: Material) -> Float[Array, ""]:
    """Return how many times as stiff as HOOD's stiffest fabric a fabric is, at least once.

    A sheet under tension presses on what it is bent over. The depth to which it sinks in shall depend on its
    strain alone. So if the stiffest face of a fabric is stiffer than HOOD's ranges, contacts are stiffer by
    that factor.
    """
    return jnp.maximum(jnp.max(stretch_stiffness(material)) / _STIFFEST, 1.0)
