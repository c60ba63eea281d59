"""Linear attention by random features.

Attention weights w_ij in proportion to phi(q_i) . phi(k_j) need no matrix of all pairs:
sum_j w_ij v_j = phi(q_i) (sum_j phi(k_j) v_j) / (phi(q_i) . sum_j phi(k_j)).

Source: Choromanski et al., "Rethinking Attention with Performers" (2021).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

SOFTMAX_EPSILON = 1e-6  # keeps the denominator positive; a larger one pulls the result to the mean of v
RELU_EPSILON = 1e-3  # PyTorch Geometric's generalised kernel


def orthogonal_projection(num_features: int, size: int, seed: int) -> np.ndarray:
    """Return random directions, orthogonal within blocks of `size`, with the lengths of Gaussian vectors.

    NumPy's generator gives the same ones on every machine, shape [num_features, size].

    Source: Choromanski et al. (2021), section 2.4.
    """
    generator = np.random.default_rng(seed)
    blocks = []
    for _ in range(-(-num_features // size)):
        basis, _ = np.linalg.qr(generator.standard_normal((size, size)))
        lengths = np.linalg.norm(generator.standard_normal((size, size)), axis=1)
        blocks.append(basis.T * lengths[:, None])
    return np.concatenate(blocks)[:num_features]


def softmax_features(
    queries: Float[Array, "rows size"],
    keys: Float[Array, "rows size"],
    projection: Float[Array, "features size"],
    mask: Bool[Array, " rows"] | None = None,
) -> tuple[Float[Array, "rows features"], Float[Array, "rows features"]]:
    """Return positive features whose products estimate exp(q . k / sqrt(size)), up to a factor per query.

    phi(x) = exp(w . x - |x|^2 / 2). A factor per query, or one common to all keys, cancels between numerator and
    denominator. So -|q|^2 / 2 is dropped, and exponents are shifted by the largest of each query's row and by the
    largest of all keys that may be attended to. A shift per key would change the weights.

    Source: Choromanski et al. (2021), lemma 1, with the stabiliser corrected.
    """
    scale = queries.shape[1] ** -0.25
    queries, keys = queries * scale, keys * scale
    query_exponents = queries @ projection.T
    key_exponents = keys @ projection.T - jnp.sum(keys * keys, axis=1, keepdims=True) / 2
    if mask is not None:  # as `linear_attention`'s; before the largest is taken
        key_exponents = jnp.where(mask[:, None], key_exponents, -jnp.inf)
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
    """Return for every query the average of `values`, weighted by its attention; in time linear in the rows.

    Features are positive. `mask` says which rows may be attended to.
    """
    if mask is not None:
        key_features = jnp.where(mask[:, None], key_features, 0)
    summary = key_features.T @ values
    total = jnp.sum(key_features, axis=0)
    return (query_features @ summary) / (query_features @ total)[:, None]
