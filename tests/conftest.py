"""Strict numerics for every test, and a compile cache that outlives the run."""

import os
from pathlib import Path

import jax
import pytest

cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "eslr-jax" / "tests"
jax.config.update("jax_compilation_cache_dir", str(cache))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)
jax.config.update("jax_numpy_rank_promotion", "raise")


@pytest.fixture(scope="session")
def body():
    from eslr_jax.assets import load_body

    return load_body()


@pytest.fixture(scope="session")
def tshirt():
    from eslr_jax.assets import load_garment

    return load_garment("tshirt")


@pytest.fixture(scope="session")
def walk(body):
    from eslr_jax.assets import load_motion
    from eslr_jax.body.motion import pose_body

    return pose_body(body, load_motion("cmu_016_32"), num_frames=8)
