"""Cusick's drape coefficient of named fabrics, in the median of starts that differ by rounding, and by mesh."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from eslr_jax.fabric.materials import all_fabrics
from eslr_jax.pipeline.drape import DISC, SPACING, Hung, hang
from eslr_jax.pipeline.fabrics import describe_fabric

JUDGED = (
    "silk-woven", "satin-woven", "cotton", "cotton-woven", "suiting-woven", "wool-woven",
    "denim-woven", "raw-denim-woven", "leather",
)  # fmt: skip
"""Fabrics that have a band to be in."""
_STARTS = 20
_FINE = (0.016, 0.008, 0.005)  # spacings besides the usual [m]
_FINE_STARTS = 3
_SLOWLY = (0.1, 0.4, 0.7, 1.0)  # of gravity; six steps end within a hundredth of these four
_SLOW_STARTS = 6


class Drape(NamedTuple):
    """Discs of a fabric that hang over their table."""

    fabric: str
    spacing: float  # [m]
    is_slow: bool  # its rim is let down slowly, not at once
    starts: int
    median: float  # share of the rim's area that the shadow still covers
    least: float
    most: float
    folds: int  # of the first start
    speed: float  # rms, of the fastest [mm/s]


def drapes(is_smoke: bool) -> Iterator[tuple[Drape, Hung]]:
    if is_smoke:
        yield drape("satin-woven", starts=1, spacing=0.03, frames=6)
        return
    for fabric in (*JUDGED, *(name for name in all_fabrics() if name not in JUDGED)):
        yield drape(fabric, starts=_STARTS if fabric in JUDGED else _FINE_STARTS)
    for fabric in JUDGED:
        yield drape(fabric, starts=_SLOW_STARTS, is_slow=True)
    for spacing in _FINE:
        for fabric in JUDGED:
            yield drape(fabric, starts=_FINE_STARTS, spacing=spacing)


def drape(
    fabric: str, *, starts: int, spacing: float = SPACING, is_slow: bool = False, **more: int
) -> tuple[Drape, Hung]:
    """Measure how a fabric hangs in a number of starts; the other arguments are those of `hang`."""
    options = {"spacing": spacing, "lowering": _SLOWLY if is_slow else (1.0,), **more}
    hung = [hang(describe_fabric(fabric), start=start, **options) for start in range(starts)]
    shares = np.array([one.coefficient for one in hung])
    fastest = 1e3 * max(one.speed for one in hung)
    spread = (float(np.median(shares)), float(shares.min()), float(shares.max()))
    return Drape(fabric, spacing, is_slow, starts, *spread, _folds(hung[0]), fastest), hung[0]


def _folds(hung: Hung) -> int:
    """Return the number of waves along the rim."""
    x, z = hung.flat[:, 0], hung.flat[:, 2]
    rim = np.flatnonzero(np.hypot(x, z) > DISC - 1e-6)
    rim = rim[np.argsort(np.arctan2(z[rim], x[rim]))]
    reach = np.hypot(hung.positions[rim, 0], hung.positions[rim, 2])
    return int(np.argmax(np.abs(np.fft.rfft(reach - reach.mean()))))
