"""The unit of a body's file (host)."""

from __future__ import annotations

import math
import warnings

from eslr_jax.errors import AssetError
from eslr_jax.geometry.validate import UNITS

_HUMAN = 1.7  # [m]
_IN_METRES = (0.3, 3.0)  # [m] extents of bodies that are taken to be in metres
_IN_UNITS = (0.5, 2.6)  # [m] extents that make another unit believable
_EXTENTS = (1e-4, 1e6)  # of a body in any unit; beyond, the file is damaged


class UnitsWarning(UserWarning):
    """The unit of a file was guessed."""


def metres_per_unit(name: str, extent: float, units: str | None = None) -> float:
    """Return the metres per unit of a body's file; warn with one line if that is a guess.

    A body of a person's size in metres is in metres. Otherwise the unit that comes closest to an adult's height
    is taken, and a body that fits no unit is scaled to that height.

    Args:
        name: What messages call the body.
        extent: Largest side of its bounding box, in its unit.
        units: One of `UNITS`, or a number of metres per unit; None guesses.

    Raises:
        AssetError: The unit is unknown, or the body's extent is none.
    """
    if units is not None:
        return _known_unit(name, units)
    if _IN_METRES[0] <= extent <= _IN_METRES[1]:
        return 1.0
    if not _EXTENTS[0] <= extent <= _EXTENTS[1]:
        raise AssetError(f"{name} is {extent:.4g} units large; export it again in metres")
    heights = {unit: extent * metres for unit, metres in UNITS.items() if unit != "m"}
    fitting = {unit: height for unit, height in heights.items() if _IN_UNITS[0] <= height <= _IN_UNITS[1]}
    if fitting:
        unit = min(fitting, key=lambda unit: abs(math.log(fitting[unit] / _HUMAN)))
        text = f"taken to be in {unit}, which makes it {fitting[unit]:.2f} m"
        scale = UNITS[unit]
    else:
        scale = _HUMAN / extent
        text = f"scaled to {_HUMAN} m, since no unit makes it a person"
    warnings.warn(
        f"{name} is {extent:.4g} units large: {text}; name its unit if not", UnitsWarning, stacklevel=3
    )
    return scale


def _known_unit(name: str, units: str) -> float:
    """Return the metres per unit of a unit's name or number."""
    if units in UNITS:
        return UNITS[units]
    try:
        scale = float(units)
    except ValueError:
        scale = math.nan
    if not (math.isfinite(scale) and scale > 0):
        raise AssetError(f"{name}: unknown unit {units!r}; give {', '.join(UNITS)}, or metres per unit")
    return scale
