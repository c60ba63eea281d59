"""Strict numerics and checked shapes for every test, a compile cache that outlives the run, and shared scenes."""

import os
from pathlib import Path

import jax
import pytest
from fast_compilation import compile_fast
from shapes import check_kernels

cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "eslr-jax" / "tests"
jax.config.update("jax_compilation_cache_dir", str(cache))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")
check_kernels()


def pytest_configure(config):
    """Compile the quick tier fast; the slow tier runs what users run."""
    if "not slow" in config.getoption("markexpr", ""):
        compile_fast()


@pytest.fixture(scope="session")
def small_garment():
    """A sleeve of sixty vertices."""
    from cloth import make_sleeve

    return make_sleeve()


@pytest.fixture(scope="session")
def small_poses():
    """Six frames of the limb that moves in the sleeve."""
    from cloth import make_limb, swing

    return swing(make_limb(), num_frames=6)


@pytest.fixture(scope="session")
def small_config():
    """The solver alone."""
    from eslr_jax import SimConfig

    return SimConfig(iterations=30)


@pytest.fixture(scope="session")
def small_scene(small_garment, small_poses):
    """The sleeve on the limb."""
    from eslr_jax import prepare_scene, scene_terms
    from eslr_jax.terms import Ground

    return prepare_scene(small_garment, small_poses, terms=scene_terms(without=(Ground,)))


@pytest.fixture(scope="session")
def small_trajectory(small_scene, small_config):
    """The scene, simulated by the solver."""
    from eslr_jax import rollout_scene

    return jax.jit(rollout_scene, static_argnames="config")(None, small_scene, small_config)


@pytest.fixture(scope="session")
def body():
    from eslr_jax import load_body

    return load_body()


@pytest.fixture(scope="session")
def tshirt():
    from eslr_jax import load_garment

    return load_garment("tshirt")


@pytest.fixture(scope="session")
def walk(body):
    from eslr_jax import load_motion, pose_body

    return pose_body(body, load_motion("cmu_016_32"), num_frames=8)
