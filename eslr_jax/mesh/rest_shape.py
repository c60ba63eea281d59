"""What depends on a garment's rest shape, as differentiable functions of it."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from eslr_jax.numerics import safe_norm, scatter_corners
from eslr_jax.types import Garment


def with_rest_positions(garment: Garment, rest_positions: Float[Array, "vertices 3"]) -> Garment:
    """Return a garment whose lengths, areas and angles are measured on other rest positions.

    These are `garment.sewn_positions`, changed [m], shape [vertices, 3]; the place from which the garment is
    skinned moves as much. `prepare_garment` computes the same on the host, in float64. This one is for gradients
    with respect to the shape that a garment is cut to; topology, skinning and embedding stay. Warp and weft stay
    where they are in every face. Bending in N m does not follow: a `Plate` holds the shape that it was prepared
    for, and energies of the new garment refuse it with a ConfigError. Describe bending by `bending_stiffness`.
    """
    is_real = garment.rest_areas > 0
    areas = jnp.where(is_real, _areas(rest_positions, garment.faces), 0.0)
    left, right = garment.hinges[:, [0, 1, 2]], garment.hinges[:, [1, 0, 3]]
    hinge_areas = _areas(rest_positions, left) + _areas(rest_positions, right)
    hinge_edges = rest_positions[garment.hinges[:, 1]] - rest_positions[garment.hinges[:, 0]]
    thirds = jnp.broadcast_to((areas / 3.0)[:, None], garment.faces.shape)
    return garment.replace(
        rest_positions=garment.rest_positions + (rest_positions - garment.sewn_positions),
        sewn_positions=rest_positions,
        rest_areas=areas,
        inverse_rest_frames=jnp.where(
            is_real[:, None, None], _inverse_rest_frames(rest_positions, garment), garment.inverse_rest_frames
        ),
        hinge_rest_areas=jnp.where(garment.hinge_rest_areas > 0, hinge_areas, 0.0),
        hinge_rest_lengths=jnp.where(garment.hinge_rest_areas > 0, safe_norm(hinge_edges), 0.0),
        vertex_areas=scatter_corners(thirds, garment.face_incidence),
        is_recut=True,
    )


def _areas(
    positions: Float[Array, "vertices 3"], corners: Int[Array, "triangles 3"]
) -> Float[Array, " triangles"]:
    """Return the areas of triangles [m^2]."""
    a, b, c = (positions[corners[:, k]] for k in range(3))
    return 0.5 * safe_norm(jnp.cross(b - a, c - a))


def _inverse_rest_frames(
    positions: Float[Array, "vertices 3"], garment: Garment
) -> Float[Array, "faces 2 2"]:
    """Return the inverse of every face's edges in its own plane [1/m], see `topology.inverse_rest_frames`."""
    a, b, c = (positions[garment.faces[:, k]] for k in range(3))
    first, second = a - c, b - c
    is_real = garment.rest_areas > 0
    length = jnp.where(is_real, safe_norm(first), 1.0)
    along = jnp.sum(first * second, axis=-1) / length
    height = jnp.where(is_real, safe_norm(jnp.cross(first, second)) / length, 1.0)
    zero = jnp.zeros_like(length)
    rows = [
        jnp.stack([1.0 / length, -along / (length * height)], axis=-1),
        jnp.stack([zero, 1.0 / height], axis=-1),
    ]
    return jnp.stack(rows, axis=-2)
