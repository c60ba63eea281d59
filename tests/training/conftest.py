"""What training runs of the quick tier learn from."""

import dataclasses

import jax
import pytest
from cloth import make_limb, swing_motion

from eslr_jax import TrainConfig
from eslr_jax.networks.registry import MODELS
from eslr_jax.training.data import build_training_data


@pytest.fixture(scope="module", autouse=True)
def optax_promotes():
    """Let integers become floats here: optax does it with its step counts."""
    with jax.numpy_dtype_promotion("standard"):
        yield


@pytest.fixture(scope="session")
def small_data(small_garment):
    """The sleeve, on a limb that swings for twelve frames."""
    body = make_limb()
    return build_training_data([small_garment], body, [swing_motion(body, 12)])


@pytest.fixture(scope="session")
def cheap_model():
    """One layer of eight channels: of all networks, its training step compiles fastest."""
    return dataclasses.replace(MODELS["smooth-small"], layers=1, refinement_steps=1, latent_size=8)


@pytest.fixture(scope="session")
def config(cheap_model):
    """Six steps, one program for all that take them."""
    return TrainConfig(
        model=cheap_model,
        steps=6,
        warmup=1,
        slots_per_garment=1,
        log_every=2,
        checkpoint_every=2,
        horizon_growth=1,
    )
