"""The best combination of a few directions: an exact step in the space that they span."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from eslr_jax.numerics import product, sum_products
from eslr_jax.solver.potential import Point

_MIN_CURVATURE = 1e-3  # of a combination, as a share of the directions' own: below it float32 holds noise


def combine_directions(
    function: Callable[[Float[Array, "vertices 3"]], Float[Array, ""]],
    point: Point,
    directions: Float[Array, "directions vertices 3"],
    *,
    fixed_weights: bool = False,
) -> Float[Array, "vertices 3"]:
    """Return the displacement along `directions` that lowers `function` most [m], shape [vertices, 3].

    The energy [J], a function of positions [m], is taken as quadratic in the span; its curvature comes from one
    more gradient at the end of each direction. The result, the first direction alone, and staying are then
    compared by their energy, so that a step never climbs. A direction that is zero everywhere is left out.

    With `fixed_weights` the derivative is as if the weights were constants. That is right for the energy of the
    result, which does not depend on them to first order, and for nothing else; it is what training on that energy
    takes, since it saves the second derivatives.

    Source: sequential subspace optimisation, Narkiss and Zibulevsky 2005.
    """
    spanning = jax.lax.stop_gradient(directions) if fixed_weights else directions
    changes = jax.vmap(lambda step: jax.grad(function)(point.position + step) - point.gradient)(spanning)
    slopes = sum_products("kij,ij->k", spanning, point.gradient)
    curvatures = sum_products("kij,lij->kl", spanning, changes)
    weights = _minimize_quadratic(slopes, 0.5 * (curvatures + curvatures.T))
    if fixed_weights:
        weights = jax.lax.stop_gradient(weights)
    combined = sum_products("k,kij->ij", weights, directions)
    moves = jnp.stack([combined, directions[0], jnp.zeros_like(combined)])
    ends = jnp.stack(
        [function(point.position + combined), function(point.position + directions[0]), point.value]
    )
    return moves[jnp.argmin(jnp.where(jnp.isfinite(ends), ends, jnp.inf))]


def _minimize_quadratic(
    slopes: Float[Array, " directions"], curvatures: Float[Array, "directions directions"]
) -> Float[Array, " directions"]:
    """Return the weights that minimise slopes . w + w . curvatures w / 2, saddles turned into valleys.

    Directions are scaled to unit curvature first: they may differ by orders of magnitude.
    """
    diagonal = jnp.abs(jnp.diag(curvatures))
    is_real = diagonal > 0
    scale = jnp.where(is_real, 1.0 / jnp.sqrt(jnp.where(is_real, diagonal, 1.0)), 0.0)
    return -scale * product(_inverse_absolute(curvatures * scale[:, None] * scale[None, :]), scale * slopes)


@jax.custom_jvp
def _inverse_absolute(matrix: Float[Array, "rows rows"]) -> Float[Array, "rows rows"]:
    """Return f(matrix) with f(x) = 1 / max(|x|, least) on the eigenvalues of a symmetric matrix."""
    values, vectors = jnp.linalg.eigh(matrix)
    return product(vectors / jnp.maximum(jnp.abs(values), _MIN_CURVATURE)[None, :], vectors.T)


@_inverse_absolute.defjvp
def _inverse_absolute_jvp(primals, tangents):
    """Differentiate by divided differences: equal eigenvalues, whose vectors are open, do no harm.

    Source: Higham 2008, Functions of Matrices, theorem 3.11 (Daleckii and Krein).
    """
    values, vectors = jnp.linalg.eigh(primals[0])
    inverse = 1.0 / jnp.maximum(jnp.abs(values), _MIN_CURVATURE)
    slope = jnp.where(jnp.abs(values) > _MIN_CURVATURE, -jnp.sign(values) * inverse * inverse, 0.0)
    apart = values[:, None] - values[None, :]
    is_apart = jnp.abs(apart) > 1e-4 * _MIN_CURVATURE
    divided = jnp.where(
        is_apart,
        (inverse[:, None] - inverse[None, :]) / jnp.where(is_apart, apart, 1.0),
        0.5 * (slope[:, None] + slope[None, :]),
    )
    turned = divided * product(product(vectors.T, tangents[0]), vectors)
    change = product(product(vectors, turned), vectors.T)
    return product(vectors * inverse[None, :], vectors.T), change
