"""Named fabrics."""

from __future__ import annotations

from typing import Any

import numpy as np

from eslr_jax.types import Material

_COTTON: dict[str, Any] = {
    "density": np.float32(0.20022),  # [kg/m^2] = 426 kg/m^3 x 0.47 mm
    "lame_mu": np.float32(23600.0),  # [Pa]
    "lame_lambda": np.float32(44400.0),  # [Pa]
    "bending_stiffness": np.float32(3.9625778e-5),  # [J] = 50 (lambda + 2 mu) h^3 / 12
    "thickness": np.float32(4.7e-4),  # [m]
}
COTTON = Material(**_COTTON)
"""The fabric of SNUG (Santesteban et al. 2022) with which HOOD and the paper evaluate."""
