"""Convert colours between sRGB, as people write them, and linear values, as light adds up."""

from __future__ import annotations

import numpy as np


def srgb_to_linear(color: np.ndarray | tuple[float, ...]) -> np.ndarray:
    """Decode sRGB values to linear ones.

    Args:
        color: sRGB values in [0, 1], any shape.

    Returns:
        Linear values in [0, 1], float32, same shape.

    Source: IEC 61966-2-1.
    """
    value = np.clip(np.asarray(color, np.float32), 0.0, 1.0)
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4).astype(np.float32)


def linear_to_srgb(color: np.ndarray) -> np.ndarray:
    """Encode linear values as sRGB; the inverse of `srgb_to_linear`.

    Args:
        color: Linear values, any shape; clipped to [0, 1].

    Returns:
        sRGB values in [0, 1], float32, same shape.

    Source: IEC 61966-2-1.
    """
    value = np.clip(np.asarray(color, np.float32), 0.0, 1.0)
    return np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1 / 2.4) - 0.055).astype(np.float32)
