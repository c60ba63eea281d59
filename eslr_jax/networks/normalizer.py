"""Running statistics of features.

HOOD sums the rows and the squared rows that it has seen. In float32 these sums lose small addends after
about 1e7 rows, and their difference cancels. Here the same statistics are kept as mean and squared
deviations, and merged by Chan's rule, which adds only numbers of like size.

Source: HOOD's `utils/normalization.py` for what is collected; Chan, Golub and LeVeque (1979) for the merge.
"""

from __future__ import annotations

from collections.abc import Mapping

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from eslr_jax.types import MIN_DEVIATION, Normalizer

WARMUP_UPDATES = 100  # graphs seen before weights are trained (HOOD)
MAX_UPDATES = 1_000_000  # graphs after which statistics freeze (HOOD)


def init_normalizer(size: int, dtype=jnp.float32) -> Normalizer:
    """Return a normaliser that has seen no rows; it leaves features unchanged."""
    return Normalizer(
        count=jnp.zeros((), dtype),
        mean=jnp.zeros(size, dtype),
        squared_deviations=jnp.zeros(size, dtype),
        num_updates=jnp.zeros((), jnp.int32),
    )


def measure(rows: Float[Array, "rows features"], mask: Bool[Array, " rows"] | None = None) -> Normalizer:
    """Return the statistics of one graph; rows outside of the mask may hold any value, also NaN."""
    mask = jnp.ones(rows.shape[0], bool) if mask is None else mask
    count = jnp.sum(mask).astype(rows.dtype)
    reference = rows[jnp.argmax(mask)]  # makes the mean of a constant feature exact
    offsets = jnp.where(mask[:, None], rows - reference[None], 0)
    mean = jnp.where(count > 0, reference + jnp.sum(offsets, axis=0) / jnp.maximum(count, 1), 0)
    deviations = jnp.sum(jnp.where(mask[:, None], rows - mean[None], 0) ** 2, axis=0)
    return Normalizer(count, mean, deviations, (count > 0).astype(jnp.int32))


def merge(seen: Normalizer, new: Normalizer) -> Normalizer:
    """Return the statistics of all rows in `seen` and `new`; of `seen` alone after `MAX_UPDATES` graphs.

    N rows with mean M and squared deviations S meet n rows with m and s. With delta = m - M,
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


def is_warming_up(statistics: Mapping[str, Normalizer]) -> Bool[Array, ""]:
    """Return whether a network has seen fewer than `WARMUP_UPDATES` graphs; False for one without statistics.

    HOOD only collects statistics until then, and leaves weights and optimiser unchanged. The normaliser that saw
    most graphs counts: a scene without a body never adds to the one of world edges.
    """
    if not statistics:
        return jnp.array(False)
    return jnp.max(jnp.stack([one.num_updates for one in statistics.values()])) < WARMUP_UPDATES


def standard_deviation(normalizer: Normalizer) -> Float[Array, " features"]:
    """Return the population standard deviation, at least `MIN_DEVIATION`; one for a feature that never changed.

    A network that was trained with one timestep has seen a constant there. Divided by HOOD's floor, another
    timestep would come out as a million deviations.
    """
    spread = normalizer.squared_deviations
    deviation = jnp.sqrt(spread / jnp.maximum(normalizer.count, 1))
    return jnp.where(spread > 0, jnp.maximum(deviation, MIN_DEVIATION), 1)


def normalize(normalizer: Normalizer, rows: Float[Array, "rows features"]) -> Float[Array, "rows features"]:
    """Return (rows - mean) / standard deviation."""
    return (rows - normalizer.mean[None]) / standard_deviation(normalizer)[None]


def inverse(normalizer: Normalizer, rows: Float[Array, "rows features"]) -> Float[Array, "rows features"]:
    """Return rows * standard deviation + mean, which undoes `normalize`."""
    return rows * standard_deviation(normalizer)[None] + normalizer.mean[None]
