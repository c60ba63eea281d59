"""Accepted ranges of physical numbers, checked on the host before anything is compiled."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from eslr_jax.errors import ConfigError


class Range(NamedTuple):
    """Smallest and largest value that is accepted, both included."""

    low: float
    high: float
    unit: str = ""


def check_range(label: str, value: Any, accepted: Range) -> np.ndarray:
    """Return a value as an array.

    Raises:
        ConfigError: It is not finite, or out of the range; names the label, the value and what is accepted.
    """
    try:
        values = np.asarray(value, np.float64)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{label} = {value!r} is not a number; give {_describe(accepted)}") from error
    # In float32 a bound itself may lie a rounding error outside.
    is_finite = np.isfinite(values)
    known = np.where(is_finite, values, 0.0)
    slack = np.finfo(np.float32).eps * np.abs(known)
    is_good = is_finite & (known + slack >= accepted.low) & (known - slack <= accepted.high)
    if not is_good.all():
        index = tuple(int(k) for k in np.argwhere(~is_good)[0])
        place = f"[{', '.join(map(str, index))}]" if index else ""
        raise ConfigError(f"{label}{place} = {values[index]:.6g}; give {_describe(accepted)}")
    return values


def check_number(label: str, value: Any, accepted: Range) -> None:
    """Check one number.

    Raises:
        ConfigError: It is not one finite number in the range; names the label, the value and what is accepted.
    """
    if shape := check_range(label, value, accepted).shape:
        raise ConfigError(f"{label} has shape {shape}; give one number for the whole scene")


def _describe(accepted: Range) -> str:
    if not np.isfinite(accepted.high):
        return "a finite number"
    return f"a value from {accepted.low:g} to {accepted.high:g} {accepted.unit}".rstrip()
