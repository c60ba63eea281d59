"""Cumulative feature statistics.

HOOD accumulates the count, the sum and the sum of squares of every row that it ever saw. In float32 the sums
lose the small addends after about 1e7 rows and their difference cancels, so the same statistics are kept here
as mean and sum of squared deviations and merged by Chan's rule, which only ever adds numbers of like size.

Source: HOOD's `utils/normalization.py` for what is accumulated; Chan, Golub and LeVeque (1979) for the merge.
"""

from __future__ import annotations

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

MIN_DEVIATION = 1e-8  # floor of the standard deviation (HOOD)
MAX_UPDATES = 1_000_000  # batches after which statistics freeze (HOOD)


@struct.dataclass
class Normalizer:
    """Mean and spread of a set of features over every row seen so far."""

    count: Float[Array, ""]  # rows seen
    mean: Float[Array, " features"]
    squared_deviations: Float[Array, " features"]  # sum over rows of (x - mean)^2
    num_updates: Int[Array, ""]


def init_normalizer(size: int, dtype=jnp.float32) -> Normalizer:
    """Return a normaliser that has seen nothing and changes nothing."""
    return Normalizer(
        count=jnp.zeros((), dtype),
        mean=jnp.zeros(size, dtype),
        squared_deviations=jnp.zeros(size, dtype),
        num_updates=jnp.zeros((), jnp.int32),
    )


def measure(rows: Float[Array, "rows features"], mask: Bool[Array, " rows"] | None = None) -> Normalizer:
    """Return the statistics of one batch of rows.

    Args:
        rows: Shape [rows, features].
        mask: Rows that count; the others may be anything, also NaN.
    """
    mask = jnp.ones(rows.shape[0], bool) if mask is None else mask
    count = jnp.sum(mask).astype(rows.dtype)
    reference = rows[jnp.argmax(mask)]  # makes the mean of a constant feature exact
    offsets = jnp.where(mask[:, None], rows - reference[None], 0)
    mean = jnp.where(count > 0, reference + jnp.sum(offsets, axis=0) / jnp.maximum(count, 1), 0)
    deviations = jnp.sum(jnp.where(mask[:, None], rows - mean[None], 0) ** 2, axis=0)
    return Normalizer(count, mean, deviations, (count > 0).astype(jnp.int32))


def merge(seen: Normalizer, new: Normalizer) -> Normalizer:
    """Join the statistics of two sets of rows, until `MAX_UPDATES` sets were seen.

    With n rows of mean m and squared deviations s, and N, M, S seen before, delta = m - M:
    M' = M + delta n / (N + n) and S' = S + s + delta^2 N n / (N + n).

    Source: Chan, Golub and LeVeque (1979), eq. 2.1.
    """
    total = seen.count + new.count
    fraction = new.count / jnp.maximum(total, 1)
    delta = new.mean - seen.mean
    spread = seen.squared_deviations + new.squared_deviations + delta**2 * seen.count * fraction
    is_open = (seen.num_updates < MAX_UPDATES) & (new.count > 0)
    return Normalizer(
        count=jnp.where(is_open, total, seen.count),
        mean=jnp.where(is_open, jnp.where(seen.count > 0, seen.mean + delta * fraction, new.mean), seen.mean),
        squared_deviations=jnp.where(is_open, spread, seen.squared_deviations),
        num_updates=seen.num_updates + jnp.where(is_open, new.num_updates, 0),
    )


def standard_deviation(normalizer: Normalizer) -> Float[Array, " features"]:
    """Return the population standard deviation, floored at `MIN_DEVIATION`; one where nothing was seen."""
    variance = normalizer.squared_deviations / jnp.maximum(normalizer.count, 1)
    return jnp.where(normalizer.count > 0, jnp.maximum(jnp.sqrt(variance), MIN_DEVIATION), 1)


def normalize(normalizer: Normalizer, rows: Float[Array, "rows features"]) -> Float[Array, "rows features"]:
    """Return (rows - mean) / deviation."""
    return (rows - normalizer.mean[None]) / standard_deviation(normalizer)[None]


def inverse(normalizer: Normalizer, rows: Float[Array, "rows features"]) -> Float[Array, "rows features"]:
    """Return rows * deviation + mean, which undoes `normalize`."""
    return rows * standard_deviation(normalizer)[None] + normalizer.mean[None]
