"""A small tube around a body, and what its graph is built from."""

from __future__ import annotations

import pytest
from reference_models import make_scene


@pytest.fixture(scope="session")
def scene():
    return make_scene(8, 6)
