"""Remove a ray tracer's grain without blurring edges."""

from __future__ import annotations

import numpy as np

_RADIUS = 2  # [steps]
_SPREAD = 1.5  # of the Gaussian over distance [steps]
_GUIDE_SCALE = 0.12  # difference of features, such as unit normals, that parts two surfaces
# Step [pixels], and the difference of radiance that is a shadow's edge rather than grain (1 is white): what is
# left after the first pass is weaker and wider.
_PASSES = ((1, 0.30), (3, 0.10))


def smooth_grain(color: np.ndarray, guide: np.ndarray) -> np.ndarray:
    """Average every pixel with the neighbours that show the same surface under the same light.

    A neighbour weighs a Gaussian of its distance, its difference in guide and its difference in colour. A
    second pass with wider steps takes what the first left.

    Args:
        color: Noisy linear radiance, shape [height, width, channels].
        guide: Noise-free features such as normals, shape [height, width, features].

    Returns:
        Smoothed radiance, float32, shape [height, width, channels].

    Source: edge-avoiding a-trous filter, Dammertz et al. 2010, doi:10.2312/EGGH.HPG10.067-075.
    """
    for step, color_scale in _PASSES:
        color = _smooth(color, guide / _GUIDE_SCALE, step, color_scale)
    return color


def _smooth(color: np.ndarray, guide: np.ndarray, step: int, color_scale: float) -> np.ndarray:
    """Return one pass; `step` is the distance of the neighbours [pixels], `guide` is scaled already."""
    height, width = color.shape[:2]
    features = np.concatenate([color / color_scale, guide], axis=-1, dtype=np.float32)
    border = _RADIUS * step
    margin = ((border, border), (border, border), (0, 0))
    padded_color, padded = np.pad(color, margin, mode="edge"), np.pad(features, margin, mode="edge")
    total, weights = np.zeros(color.shape, np.float32), np.zeros((height, width, 1), np.float32)
    for row in range(-_RADIUS, _RADIUS + 1):
        for column in range(-_RADIUS, _RADIUS + 1):
            top, left = border + step * row, border + step * column
            window = (slice(top, top + height), slice(left, left + width))
            distance = (row**2 + column**2) / _SPREAD**2
            difference = padded[window] - features
            squares = np.einsum("hwf,hwf->hw", difference, difference)
            weight = np.exp(-0.5 * (squares + np.float32(distance)))[..., None]
            total += weight * padded_color[window]
            weights += weight
    return total / weights
