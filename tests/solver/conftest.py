"""The frame that the physics tests share."""

from __future__ import annotations

import numpy as np
import pytest
from physics_cases import Case, make_case


@pytest.fixture(scope="session")
def case64() -> Case:
    """A frame in float64; use under `jax.enable_x64`."""
    return make_case()


@pytest.fixture(scope="session")
def case32() -> Case:
    """The same frame rounded to float32."""
    return make_case(dtype=np.float32)
