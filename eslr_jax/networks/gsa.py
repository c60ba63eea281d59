"""Self-attention over all garment vertices, which know their place by the geodesic embedding.

Symbols of the paper: V (`x`), E_G (`embedding`).

Source: paper, section on geodesic self-attention; widths fitted to its parameter counts.
"""

from __future__ import annotations

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from eslr_jax.networks import attention
from eslr_jax.networks.architecture import TwoBranches
from eslr_jax.networks.dense import MLP, add_bias, kernel_spread, layer_norm, matmul

EMBEDDING_UNIT = 0.5  # [m]; a garment then spans a few units, like the latents beside it
QUERY_GAIN = 0.3  # initial size of queries and keys: random features are accurate where they are small


class GsaBlock(nn.Module):
    """x + W_o attention(W_q [x, E_G], W_k [x, E_G], W_v x), one head, linear in the vertices.

    `is_attention_normed` puts a LayerNorm in front, which keeps q and k small for features of the softmax, and a
    perceptron behind. The paper's parameter count has no room for them.
    """

    config: TwoBranches

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
            features = attention.softmax_features(queries, keys, directions, mask)
        else:
            features = attention.relu_features(queries, keys, directions)
        mixed = project("output", attention.linear_attention(*features, values, mask), 0.5, width)
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
