"""Named models: their sizes, their weights, their scales."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eslr_jax.config import ModelConfig, from_dict, to_dict
from eslr_jax.errors import ConfigError
from eslr_jax.models.registry import (
    MODELS,
    count_parameters,
    init_model,
    scale_output,
)

COUNTS = {
    "eslr-15": 4_753_108,
    "eslr-10": 3_231_828,
    "lsdmp-15": 4_601_044,
    "mgn-15": 3_854_164,
    "mgn-48": 12_027_604,
}
SMALL = dataclasses.replace(MODELS["eslr-small"], latent_size=8, attention_size=4, attention_features=8)


@pytest.mark.parametrize("name", COUNTS)
def test_parameter_counts_are_the_papers(name):
    assert count_parameters(init_model(MODELS[name])) == COUNTS[name]


@pytest.mark.parametrize("family", ["eslr", "lsdmp", "gsa", "mgn"])
def test_small_models_are_small(family):
    assert count_parameters(init_model(MODELS[f"{family}-small"])) < 45_000


def test_weights_follow_their_seed_and_directions_the_configs():
    first, again, other = init_model(SMALL, 0), init_model(SMALL, 0), init_model(SMALL, 1)
    same = jax.tree.map(lambda a, b: bool((a == b).all()), first, again)
    assert all(jax.tree.leaves(same))
    kernel = ("params", "decoder", "kernel_0")
    assert not np.allclose(first[kernel[0]][kernel[1]][kernel[2]], other[kernel[0]][kernel[1]][kernel[2]])
    np.testing.assert_array_equal(first["constants"]["projection"], other["constants"]["projection"])
    reseeded = init_model(dataclasses.replace(SMALL, seed=5))
    assert not np.allclose(first["constants"]["projection"], reseeded["constants"]["projection"])


def test_initial_weights_have_the_spread_of_their_fan_in():
    kernel = init_model(MODELS["mgn-15"])["params"]["layers"]["mesh_mlp"]["kernel_0"]
    assert kernel.shape == (15, 384, 128)
    np.testing.assert_allclose(np.std(kernel), np.sqrt(1.5 / 384), rtol=0.01)
    # layers differ from each other
    assert not np.allclose(kernel[0], kernel[1])


def test_corrections_start_small():
    last = init_model(SMALL)["params"]["decoder"]["kernel_2"]
    assert np.abs(last).max() < 0.1


def test_outputs_have_physical_scales():
    params = init_model(SMALL)
    ones = jnp.ones((2, 3))
    np.testing.assert_allclose(scale_output(SMALL, params, ones), SMALL.output_scale)
    faithful = dataclasses.replace(SMALL, features="hood", output="acceleration", refinement_steps=1)
    params = init_model(faithful)
    np.testing.assert_array_equal(scale_output(faithful, params, ones), ones)


@pytest.mark.parametrize("name", MODELS)
def test_configs_survive_a_round_trip(name):
    assert from_dict(ModelConfig, to_dict(MODELS[name])) == MODELS[name]


@pytest.mark.parametrize(
    "values",
    [
        {"message_passing_steps": 0},
        {"smoothing_steps": -1},
        {"output_scale": 0.0},
        {"world_edge_capacity": 0},
        {"refinement_steps": 3},
        {"refinement_steps": 3, "features": "gradient"},
    ],
)
def test_impossible_configs_name_the_field(values):
    with pytest.raises(ConfigError, match=next(iter(values))):
        from_dict(ModelConfig, values)


def test_statistics_are_required_where_features_are_normalised():
    faithful = dataclasses.replace(SMALL, features="hood", output="acceleration", refinement_steps=1)
    params = init_model(faithful)
    assert set(params["statistics"]) == {"garment", "mesh", "world", "output"}
    assert set(init_model(SMALL)["statistics"]) == set()
