"""Named fabrics."""

from __future__ import annotations

import numpy as np

from eslr_jax.types import Material

COTTON = Material(
    density=np.float32(0.20022),  # 426 kg/m^3 x 0.47 mm
    lame_mu=np.float32(23600.0),
    lame_lambda=np.float32(44400.0),
    bending_stiffness=np.float32(3.9625778e-5),
    thickness=np.float32(4.7e-4),
)
"""The fabric of SNUG (Santesteban et al. 2022) with which HOOD and the paper evaluate."""
