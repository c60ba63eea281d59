"""Numerical primitives with safe gradients; the only caller of `jax.ops`."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


def safe_norm(x: Float[Array, "..."], axis: int = -1, keepdims: bool = False) -> Float[Array, "..."]:
    """Return the Euclidean norm with a zero (not NaN) gradient at zero.

    Args:
        x: Vectors along `axis`.
        axis: Axis of the components.
        keepdims: Keep `axis` with length one.
    """
    squared = jnp.sum(x * x, axis=axis, keepdims=keepdims)
    is_zero = squared == 0
    return jnp.where(is_zero, 0.0, jnp.sqrt(jnp.where(is_zero, 1.0, squared)))


def safe_normalize(x: Float[Array, "..."], axis: int = -1) -> Float[Array, "..."]:
    """Return unit vectors; a zero vector stays zero and has a zero gradient."""
    squared = jnp.sum(x * x, axis=axis, keepdims=True)
    is_zero = squared == 0
    return jnp.where(is_zero, 0.0, x * jax.lax.rsqrt(jnp.where(is_zero, 1.0, squared)))


def masked_sum(x: Float[Array, "rows ..."], mask: Bool[Array, " rows"]) -> Float[Array, "..."]:
    """Sum the rows of `x` where `mask` holds; masked rows may be anything, also NaN."""
    mask = mask.reshape(mask.shape + (1,) * (x.ndim - mask.ndim))
    return jnp.sum(jnp.where(mask, x, 0), axis=0)


def segment_sum(
    data: Float[Array, "rows ..."],
    segment_ids: Int[Array, " rows"],
    num_segments: int,
    *,
    is_sorted: bool = False,
) -> Float[Array, "segments ..."]:
    """Sum rows of `data` that share a segment."""
    return jax.ops.segment_sum(data, segment_ids, num_segments, indices_are_sorted=is_sorted)


@jax.custom_vjp
def gather_rows(
    x: Float[Array, "rows features"],
    indices: Int[Array, "items corners"],
    incidence: Int[Array, "rows degree"],
) -> Float[Array, "items corners features"]:
    """Return `x[indices]`, with a backward pass that gathers instead of scattering.

    XLA's scatter-add on a CPU adds one element at a time; summing each row's incoming cotangents through a
    fixed-degree incidence table is vectorised, and deterministic on a GPU.

    Args:
        x: Rows to gather.
        indices: Row of every corner of every item (a face, a hinge, an edge).
        incidence: For each row the flat positions in `indices` that name it, padded with
            `indices.size` (one past the end).
    """
    return x[indices]


def _gather_rows_forward(x, indices, incidence):
    return x[indices], incidence


def _gather_rows_backward(incidence, cotangent):
    flat = cotangent.reshape((-1, cotangent.shape[-1]))
    flat = jnp.concatenate([flat, jnp.zeros_like(flat[:1])])
    return sum(flat[incidence[:, k]] for k in range(incidence.shape[1])), None, None


gather_rows.defvjp(_gather_rows_forward, _gather_rows_backward)
