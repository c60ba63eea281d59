"""Remove a ray tracer's grain without blurring edges."""

from __future__ import annotations

import numpy as np

_RADIUS = 3  # [pixels]
_SPREAD = 2.0  # of the Gaussian over distance [pixels]
_GUIDE_SCALE = 0.12  # difference of unit normals or reflectances that parts two surfaces
_COLOR_SCALE = 0.10  # difference of radiance that is a shadow's edge rather than grain, 1 is white


def smooth_grain(color: np.ndarray, guide: np.ndarray) -> np.ndarray:
    """Average every pixel with the neighbours that show the same surface under the same light.

    A neighbour weighs a Gaussian of its distance, its difference in guide and its difference in colour.

    Args:
        color: Noisy linear radiance, shape [height, width, channels].
        guide: Noise-free features such as normals and reflectance, shape [height, width, features].

    Returns:
        Smoothed radiance, float32, shape [height, width, channels].

    Source: joint bilateral filter, Petschnig et al. 2004, doi:10.1145/1015706.1015777.
    """
    height, width = color.shape[:2]
    scaled = np.concatenate([color / _COLOR_SCALE, guide / _GUIDE_SCALE], axis=-1, dtype=np.float32)
    border = ((_RADIUS, _RADIUS), (_RADIUS, _RADIUS), (0, 0))
    padded_color, padded = np.pad(color, border, mode="edge"), np.pad(scaled, border, mode="edge")
    total, weights = np.zeros(color.shape, np.float32), np.zeros((height, width, 1), np.float32)
    for row in range(2 * _RADIUS + 1):
        for column in range(2 * _RADIUS + 1):
            window = (slice(row, row + height), slice(column, column + width))
            distance = ((row - _RADIUS) ** 2 + (column - _RADIUS) ** 2) / _SPREAD**2
            difference = padded[window] - scaled
            squares = np.einsum("hwf,hwf->hw", difference, difference)
            weight = np.exp(-0.5 * (squares + np.float32(distance)))[..., None]
            total += weight * padded_color[window]
            weights += weight
    return total / weights
