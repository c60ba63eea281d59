"""The colours of garments and bodies, the same in pictures, in the browser and in files."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

Color = tuple[float, float, float]  # sRGB in [0, 1]

# Of the garments of an outfit, in turns.
GARMENT_COLORS: tuple[Color, ...] = (
    (0.30, 0.50, 0.70),
    (0.80, 0.47, 0.32),
    (0.45, 0.62, 0.38),
    (0.62, 0.45, 0.66),
)
# Of a body: its skin, and the top and the shorts of `pipeline.rigs.clothing`.
SKIN_COLOR: Color = (0.88, 0.73, 0.64)
TOP_COLOR: Color = (0.80, 0.80, 0.78)
SHORTS_COLOR: Color = (0.42, 0.43, 0.46)
BODY_COLORS: tuple[Color, ...] = (SKIN_COLOR, TOP_COLOR, SHORTS_COLOR)


def garment_color(number: int) -> Color:
    """Return the colour of one garment of an outfit, counted from the innermost."""
    return GARMENT_COLORS[number % len(GARMENT_COLORS)]


def outfit_colors(counts: Sequence[int]) -> Float[np.ndarray, "vertices 3"]:
    """Return sRGB per vertex of an outfit, given the numbers of vertices of its garments."""
    return np.array([garment_color(k) for k in range(len(counts))], np.float32).repeat(counts, axis=0)


def byte_color(color: Color) -> tuple[int, int, int]:
    """Return sRGB in [0, 1] as bytes."""
    red, green, blue = (round(255 * value) for value in color)
    return red, green, blue


def srgb_to_linear(color: np.ndarray | tuple[float, ...]) -> np.ndarray:
    """Decode sRGB values in [0, 1] to linear ones, float32 (IEC 61966-2-1)."""
    value = np.clip(np.asarray(color, np.float32), 0.0, 1.0)
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4).astype(np.float32)


def linear_to_srgb(color: np.ndarray) -> np.ndarray:
    """Encode linear values as sRGB, float32; the inverse of `srgb_to_linear`."""
    value = np.clip(np.asarray(color, np.float32), 0.0, 1.0)
    return np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1 / 2.4) - 0.055).astype(np.float32)
