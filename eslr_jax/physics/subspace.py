"""The best combination of a few directions: an exact step in the space that they span."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from eslr_jax.physics.potential import Point

_MIN_CURVATURE = 1e-3  # of a combination, as a share of the directions' own: below it float32 holds noise


def combine_directions(
    function: Callable[[Float[Array, "vertices 3"]], Float[Array, ""]],
    point: Point,
    directions: Float[Array, "directions vertices 3"],
) -> Float[Array, "vertices 3"]:
    """Return the displacement along `directions` that lowers `function` most [m], shape [vertices, 3]; zero if none does.

    The energy is taken as quadratic in the span; its curvature comes from one more gradient at the end of each
    direction. The result, the first direction alone, and staying are then compared by their energy, so that a
    step never climbs. The weights of the combination count as constants when differentiated: at their optimum
    the energy does not depend on them to first order.

    Args:
        function: Energy [J] of positions; differentiable.
        point: Where the directions begin.
        directions: Displacements [m], shape [directions, vertices, 3]; one that is zero everywhere is left out.

    Source: sequential subspace optimisation, Narkiss and Zibulevsky 2005.
    """
    fixed = jax.lax.stop_gradient(directions)
    changes = jax.vmap(lambda direction: jax.grad(function)(point.position + direction) - point.gradient)(
        fixed
    )
    slopes = jnp.einsum("kij,ij->k", fixed, point.gradient)
    curvatures = jnp.einsum("kij,lij->kl", fixed, changes)
    weights = jax.lax.stop_gradient(_minimize_quadratic(slopes, 0.5 * (curvatures + curvatures.T)))
    combined = jnp.einsum("k,kij->ij", weights, directions)
    moves = jnp.stack([combined, directions[0], jnp.zeros_like(combined)])
    values = jnp.stack(
        [function(point.position + combined), function(point.position + directions[0]), point.value]
    )
    return moves[jnp.argmin(jnp.where(jnp.isfinite(values), values, jnp.inf))]


def _minimize_quadratic(
    slopes: Float[Array, " directions"], curvatures: Float[Array, "directions directions"]
) -> Float[Array, " directions"]:
    """Return the weights that minimise slopes . w + w . curvatures w / 2, saddles turned into valleys.

    Directions are scaled to unit curvature first: they may differ by orders of magnitude.
    """
    diagonal = jnp.abs(jnp.diag(curvatures))
    is_real = diagonal > 0
    scale = jnp.where(is_real, 1.0 / jnp.sqrt(jnp.where(is_real, diagonal, 1.0)), 0.0)
    values, vectors = jnp.linalg.eigh(curvatures * scale[:, None] * scale[None, :])
    values = jnp.maximum(jnp.abs(values), _MIN_CURVATURE)
    return -scale * (vectors @ ((vectors.T @ (scale * slopes)) / values))
