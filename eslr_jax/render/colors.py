"""Numbers as colours."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

# Eight evenly spaced colours of viridis (matplotlib, CC0): even in lightness, and legible to the colour-blind.
_VIRIDIS = np.array(
    [
        (0.267, 0.005, 0.329),
        (0.275, 0.195, 0.496),
        (0.213, 0.359, 0.552),
        (0.153, 0.497, 0.558),
        (0.122, 0.632, 0.531),
        (0.290, 0.759, 0.428),
        (0.622, 0.854, 0.226),
        (0.993, 0.906, 0.144),
    ]
)


def color_scale(
    values: Float[np.ndarray, "*shape"], low: float, high: float
) -> Float[np.ndarray, "*shape 3"]:
    """Return sRGB colours in [0, 1], dark blue at `low` and below, yellow at `high` and above.

    Args:
        values: Any numbers; NaN counts as `low`.
        low: Start of the scale.
        high: End of the scale.
    """
    share = np.nan_to_num((np.asarray(values, np.float64) - low) / max(high - low, 1e-30))
    position = np.clip(share, 0.0, 1.0) * (len(_VIRIDIS) - 1)
    below = np.minimum(position.astype(int), len(_VIRIDIS) - 2)
    blend = (position - below)[..., None]
    return ((1.0 - blend) * _VIRIDIS[below] + blend * _VIRIDIS[below + 1]).astype(np.float32)
