"""Linear attention by random features, and the exact attention that it approximates.

Attention weights w_ij proportional to k(q_i, k_j) with k(q, k) = phi(q) . phi(k) need no matrix of all pairs:
sum_j w_ij v_j = phi(q_i) (sum_j phi(k_j) v_j) / (phi(q_i) . sum_j phi(k_j)).

Source: Choromanski et al., "Rethinking Attention with Performers" (2021).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

SOFTMAX_EPSILON = 1e-6  # keeps the denominator positive; larger values pull towards the mean of v
RELU_EPSILON = 1e-3  # PyTorch Geometric's generalised kernel


def orthogonal_projection(num_features: int, size: int, seed: int) -> np.ndarray:
    """Return random directions, orthogonal within blocks of `size`, with the lengths of Gaussian vectors.

    Args:
        num_features: Number of directions.
        size: Their dimension.
        seed: Of the generator; the same seed gives the same directions on every machine.

    Returns:
        Directions, shape [num_features, size].

    Source: Choromanski et al. (2021), section 2.4.
    """
    generator = np.random.default_rng(seed)
    blocks = []
    for _ in range(-(-num_features // size)):
        basis, _ = np.linalg.qr(generator.standard_normal((size, size)))
        lengths = np.linalg.norm(generator.standard_normal((size, size)), axis=1)
        blocks.append(basis.T * lengths[:, None])
    return np.concatenate(blocks)[:num_features]


def exact_attention(
    queries: Float[Array, "rows size"],
    keys: Float[Array, "rows size"],
    values: Float[Array, "rows width"],
    mask: Bool[Array, " rows"] | None = None,
) -> Float[Array, "rows width"]:
    """Return softmax(q k^T / sqrt(size)) v over the rows in `mask`; quadratic, for tests and small meshes."""
    scores = queries @ keys.T / np.sqrt(queries.shape[1])
    if mask is not None:
        scores = jnp.where(mask[None], scores, -jnp.inf)
    return jax.nn.softmax(scores, axis=1) @ values


def softmax_features(
    queries: Float[Array, "rows size"],
    keys: Float[Array, "rows size"],
    projection: Float[Array, "features size"],
) -> tuple[Float[Array, "rows features"], Float[Array, "rows features"]]:
    """Return positive features whose products estimate exp(q . k / sqrt(size)), up to a factor per query.

    phi(x) = exp(w . x - |x|^2 / 2). Numerator and denominator share any factor per query and any factor
    common to all keys, so -|q|^2 / 2 is dropped, the largest exponent of a query is subtracted from its row,
    and that of all keys together from all keys: subtracting it per key as well would change the weights.

    Source: Choromanski et al. (2021), lemma 1, with the stabiliser corrected.
    """
    scale = queries.shape[1] ** -0.25
    queries, keys = queries * scale, keys * scale
    query_exponents = queries @ projection.T
    key_exponents = keys @ projection.T - jnp.sum(keys * keys, axis=1, keepdims=True) / 2
    query_top = jax.lax.stop_gradient(jnp.max(query_exponents, axis=1, keepdims=True))
    key_top = jax.lax.stop_gradient(jnp.max(key_exponents))
    return (
        jnp.exp(query_exponents - query_top) + SOFTMAX_EPSILON,
        jnp.exp(key_exponents - key_top) + SOFTMAX_EPSILON,
    )


def relu_features(
    queries: Float[Array, "rows size"],
    keys: Float[Array, "rows size"],
    projection: Float[Array, "features size"],
) -> tuple[Float[Array, "rows features"], Float[Array, "rows features"]]:
    """Return ReLU(w . x) + 1e-3 of queries and keys, the Performer's generalised attention.

    Source: Choromanski et al. (2021), section 4; epsilon and missing scale of PyTorch Geometric.
    """
    return (
        jnp.maximum(queries @ projection.T, 0) + RELU_EPSILON,
        jnp.maximum(keys @ projection.T, 0) + RELU_EPSILON,
    )


def linear_attention(
    query_features: Float[Array, "rows features"],
    key_features: Float[Array, "rows features"],
    values: Float[Array, "rows width"],
    mask: Bool[Array, " rows"] | None = None,
) -> Float[Array, "rows width"]:
    """Return the average of `values` weighted by products of features, in time linear in the rows.

    Args:
        query_features: Positive features of the queries.
        key_features: Positive features of the keys.
        values: What is averaged.
        mask: Rows that are attended to.
    """
    if mask is not None:
        key_features = jnp.where(mask[:, None], key_features, 0)
    summary = key_features.T @ values
    total = jnp.sum(key_features, axis=0)
    return (query_features @ summary) / (query_features @ total)[:, None]
