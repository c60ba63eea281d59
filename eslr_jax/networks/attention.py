"""Geodesic self-attention: linear attention by random features, among vertices that know their place.

Attention weights w_ij in proportion to phi(q_i) . phi(k_j) need no matrix of all pairs:
sum_j w_ij v_j = phi(q_i) (sum_j phi(k_j) v_j) / (phi(q_i) . sum_j phi(k_j)).

Symbols of the paper: V (`x`), E_G (`embedding`).

Source: paper, section on geodesic self-attention; widths fitted to its parameter counts. Choromanski et al.,
"Rethinking Attention with Performers" (2021).
"""

from __future__ import annotations

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from eslr_jax.networks.dense import MLP, add_bias, kernel_spread, layer_norm, matmul

SOFTMAX_EPSILON = 1e-6  # keeps the denominator positive; a larger one pulls the result to the mean of v
RELU_EPSILON = 1e-3  # PyTorch Geometric's generalised kernel
EMBEDDING_UNIT = 0.5  # [m]; a garment then spans a few units, like the latents beside it
QUERY_GAIN = 0.3  # initial size of queries and keys: random features are accurate where they are small


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


class GsaBlock(nn.Module):
    """x + W_o attention(W_q [x, E_G], W_k [x, E_G], W_v x), one head, linear in the vertices.

    `is_attention_normed` puts a LayerNorm in front, which keeps q and k small for features of the softmax, and a
    perceptron behind. The paper's parameter count has no room for them.
    """

    config: Any  # a `TwoBranches`

    @nn.compact
    def __call__(
        self,
        x: Float[Array, "vertices latent"],
        inputs: tuple[
            Float[Array, "vertices embedding"], Bool[Array, " vertices"], Float[Array, "features size"]
        ],
    ):
        """Return the next latents, in the form that `nn.scan` asks for.

        `inputs` are the geodesic embedding [m], the vertex mask and random directions.
        """
        config, (embedding, mask, projection) = self.config, inputs
        size, width, precision = config.attention_size, config.latent_size, config.precision
        here = self._norm("attention_norm", x) if config.is_attention_normed else x
        located = jnp.concatenate([here, (embedding / EMBEDDING_UNIT).astype(x.dtype)], axis=1)

        def project(name: str, rows, gain: float, outputs: int):
            kernel = self.param(name, kernel_spread(gain**2), (rows.shape[1], outputs))
            return matmul(rows, kernel.astype(rows.dtype), precision)

        queries = project("query", located, QUERY_GAIN, size)
        keys = project("key", located, QUERY_GAIN, size)
        values = project("value", here, 1.0, size)
        directions = projection.astype(x.dtype)
        if config.is_attention_normed:
            features = softmax_features(queries, keys, directions, mask)
        else:
            features = relu_features(queries, keys, directions)
        mixed = project("output", linear_attention(*features, values, mask), 0.5, width)
        bias = self.param("output_bias", nn.initializers.zeros, (width,))
        x = x + add_bias(mixed, bias.astype(x.dtype))
        if config.is_attention_normed:
            perceptron = MLP(width, width, width, 1, norm=False, precision=precision, name="feedforward")
            x = x + perceptron(self._norm("feedforward_norm", x))
        return x, None

    def _norm(self, name: str, x: Float[Array, "vertices latent"]) -> Float[Array, "vertices latent"]:
        scale = self.param(f"{name}_scale", nn.initializers.ones, (x.shape[1],))
        bias = self.param(f"{name}_bias", nn.initializers.zeros, (x.shape[1],))
        return layer_norm(x, scale.astype(x.dtype), bias.astype(x.dtype))
