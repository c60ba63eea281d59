"""The multilayer perceptron that every part of the network is made of."""

from __future__ import annotations

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from eslr_jax.networks.dense import Precision, add_bias, kernel_spread, layer_norm, matmul

INITIAL_GAIN = 1.5  # variance of a weight times its fan-in


class MLP(nn.Module):
    """A linear layer and ReLU per hidden layer, a linear layer, a LayerNorm.

    The first layer can be applied to the pieces of a concatenated input one by one (`start`): its product
    with the whole is the sum of its products with the pieces. So vertex latents are multiplied before the
    edges gather them.

    Attributes:
        input_size: Number of columns of the concatenated input.
        hidden_size: Number of columns of the hidden layers.
        output_size: Number of columns of the output.
        hidden_layers: Number of hidden layers; 0 is a single linear layer.
        norm: End with a LayerNorm.
        output_gain: Factor on the initial weights of the last layer.
        precision: Type of the operands of matrix products.
    """

    input_size: int
    hidden_size: int
    output_size: int
    hidden_layers: int = 2
    norm: bool = True
    output_gain: float = 1.0
    precision: Precision = "float32"

    def setup(self) -> None:
        """Declare the weights."""
        sizes = [self.input_size, *[self.hidden_size] * self.hidden_layers, self.output_size]
        last = len(sizes) - 2
        self.kernels = [
            self.param(
                f"kernel_{k}",
                kernel_spread(INITIAL_GAIN * (self.output_gain**2 if k == last else 1)),
                (sizes[k], sizes[k + 1]),
            )
            for k in range(last + 1)
        ]
        self.biases = [
            self.param(f"bias_{k}", nn.initializers.zeros, (sizes[k + 1],)) for k in range(last + 1)
        ]
        if self.norm:
            self.norm_scale = self.param("norm_scale", nn.initializers.ones, (self.output_size,))
            self.norm_bias = self.param("norm_bias", nn.initializers.zeros, (self.output_size,))

    def __call__(self, x: Float[Array, "rows inputs"]) -> Float[Array, "rows outputs"]:
        """Apply all layers to the whole input."""
        return self.finish(self.start(x, 0, bias=True))

    def start(
        self, x: Float[Array, "rows piece"], offset: int, *, bias: bool = False
    ) -> Float[Array, "rows hidden"]:
        """Return what a piece of the input adds to the first layer, before the ReLU.

        Args:
            x: Piece of the input, shape [rows, piece].
            offset: Column of the whole input at which the piece begins.
            bias: Add the first layer's bias; True for exactly one piece.
        """
        kernel = self.kernels[0][offset : offset + x.shape[1]]
        hidden = matmul(x, kernel.astype(x.dtype), self.precision)
        return add_bias(hidden, self.biases[0].astype(x.dtype)) if bias else hidden

    def finish(self, hidden: Float[Array, "rows hidden"]) -> Float[Array, "rows outputs"]:
        """Apply the layers behind the first product.

        Args:
            hidden: Sum of `start` over all pieces, shape [rows, hidden].
        """
        for kernel, bias in zip(self.kernels[1:], self.biases[1:], strict=True):
            product = matmul(jnp.maximum(hidden, 0), kernel.astype(hidden.dtype), self.precision)
            hidden = add_bias(product, bias.astype(hidden.dtype))
        if not self.norm:
            return hidden
        dtype = hidden.dtype
        return layer_norm(hidden, self.norm_scale.astype(dtype), self.norm_bias.astype(dtype))
