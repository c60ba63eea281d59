"""The perceptron that every part of a network is made of: products, biases and norms that suit a CPU.

On a CPU, XLA sums the columns of a tall matrix one strided element at a time. As a product with a row of ones the
same sum runs at the speed of a matrix product.
"""

from __future__ import annotations

from typing import Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax.experimental.layout import Layout, with_layout_constraint
from jaxtyping import Array, Float

Precision = Literal["float32", "bfloat16"]
NORM_EPSILON = 1e-5  # PyTorch's LayerNorm, as in HOOD
INITIAL_GAIN = 1.5  # variance of a weight times its fan-in
TALL = 512  # rows from which a weight gradient pays for a transposed copy


def kernel_spread(gain: float | int):
    """Return an initialiser that fills a kernel with the standard deviation of its weights.

    `gain` is the variance of a weight times the number of the kernel's inputs. `architecture.draw_weights`
    multiplies the kernels by normal numbers from NumPy. These are the same on every machine, and no random
    generator is compiled per kernel, which would take seconds.
    """

    def fill(key, shape, dtype=jnp.float32):
        del key
        return jnp.full(shape, (gain / shape[0]) ** 0.5, dtype)

    return fill


def matmul(
    x: Float[Array, "rows inputs"], w: Float[Array, "inputs outputs"], precision: Precision = "float32"
) -> Float[Array, "rows outputs"]:
    """Return x @ w; for "bfloat16" with operands rounded to that type and sums in float32."""
    return _matmul_bfloat16(x, w) if precision == "bfloat16" else x @ w


def sum_columns(x: Float[Array, "rows columns"]) -> Float[Array, " columns"]:
    """Sum over the rows, as a product."""
    return (jnp.ones((1, x.shape[0]), x.dtype) @ x)[0]


@jax.custom_vjp
def add_bias(x: Float[Array, "rows columns"], bias: Float[Array, " columns"]) -> Float[Array, "rows columns"]:
    """Return x + bias."""
    return x + bias[None]


add_bias.defvjp(
    lambda x, bias: (x + bias[None], None), lambda _, cotangent: (cotangent, sum_columns(cotangent))
)


@jax.custom_vjp
def layer_norm(
    x: Float[Array, "rows columns"], scale: Float[Array, " columns"], bias: Float[Array, " columns"]
) -> Float[Array, "rows columns"]:
    """Normalise every row to zero mean and unit variance, then scale and shift its columns."""
    return _layer_norm_forward(x, scale, bias)[0]


def _layer_norm_forward(x, scale, bias):
    centred = x - jnp.mean(x, axis=1, keepdims=True)
    inverse = jax.lax.rsqrt(jnp.mean(centred * centred, axis=1, keepdims=True) + NORM_EPSILON)
    unit = centred * inverse
    return unit * scale[None] + bias[None], (unit, inverse, scale)


def _layer_norm_backward(residuals, cotangent):
    unit, inverse, scale = residuals
    scaled = cotangent * scale[None]
    mean = jnp.mean(scaled, axis=1, keepdims=True)
    slope = jnp.mean(scaled * unit, axis=1, keepdims=True)
    return inverse * (scaled - mean - unit * slope), sum_columns(cotangent * unit), sum_columns(cotangent)


layer_norm.defvjp(_layer_norm_forward, _layer_norm_backward)


def _dot_bfloat16(a, b, contract_a: int, contract_b: int):
    """Contract bfloat16 matrices into float32; a bfloat16 result would be slower than float32 operands."""
    dimensions = (((contract_a,), (contract_b,)), ((), ()))
    return jax.lax.dot_general(a, b, dimensions, preferred_element_type=jnp.float32)


@jax.custom_vjp
def _matmul_bfloat16(x, w):
    return _dot_bfloat16(x.astype(jnp.bfloat16), w.astype(jnp.bfloat16), 1, 0)


def _matmul_bfloat16_forward(x, w):
    x, w = x.astype(jnp.bfloat16), w.astype(jnp.bfloat16)
    return _dot_bfloat16(x, w, 1, 0), (x, w)


def _matmul_bfloat16_backward(residuals, cotangent):
    x, w = residuals
    cotangent = cotangent.astype(jnp.bfloat16)
    if x.shape[0] > TALL:
        # A contraction over rows leaves the CPU's bfloat16 kernels unless the operand is stored transposed.
        transposed = with_layout_constraint(x.T, Layout((0, 1)))
        w_gradient = _dot_bfloat16(transposed, cotangent, 1, 0)
    else:
        w_gradient = _dot_bfloat16(x, cotangent, 0, 0)
    return _dot_bfloat16(cotangent, w, 1, 1), w_gradient


_matmul_bfloat16.defvjp(_matmul_bfloat16_forward, _matmul_bfloat16_backward)


class MLP(nn.Module):
    """A linear layer and ReLU per hidden layer, a linear layer, a LayerNorm.

    The first layer can be applied to the pieces of a concatenated input one by one (`start`): its product with
    the whole is the sum of its products with the pieces. So vertex latents are multiplied before the edges gather
    them.
    """

    input_size: int  # columns of the concatenated input
    hidden_size: int
    output_size: int
    hidden_layers: int = 2  # 0 is a single linear layer
    norm: bool = True  # end with a LayerNorm
    output_gain: float = 1.0  # factor on the initial weights of the last layer
    precision: Precision = "float32"  # of the operands of matrix products

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
        """Return what a piece of the input, from column `offset` on, adds to the first layer, before the ReLU.

        `bias` adds the first layer's bias; it is True for exactly one piece.
        """
        kernel = self.kernels[0][offset : offset + x.shape[1]]
        hidden = matmul(x, kernel.astype(x.dtype), self.precision)
        return add_bias(hidden, self.biases[0].astype(x.dtype)) if bias else hidden

    def finish(self, hidden: Float[Array, "rows hidden"]) -> Float[Array, "rows outputs"]:
        """Apply the layers behind the first product to the sum of `start` over all pieces."""
        for kernel, bias in zip(self.kernels[1:], self.biases[1:], strict=True):
            product = matmul(jnp.maximum(hidden, 0), kernel.astype(hidden.dtype), self.precision)
            hidden = add_bias(product, bias.astype(hidden.dtype))
        if not self.norm:
            return hidden
        dtype = hidden.dtype
        return layer_norm(hidden, self.norm_scale.astype(dtype), self.norm_bias.astype(dtype))
