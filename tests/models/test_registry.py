"""Named models: their sizes, their weights, their scales, their files."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_models import make_scene, quick_jit

from eslr_jax.config import ModelConfig, from_dict, to_dict
from eslr_jax.errors import CheckpointError, ConfigError
from eslr_jax.graph.build import build_graph
from eslr_jax.io import weights
from eslr_jax.io.weights import read_weights, write_weights
from eslr_jax.models.registry import (
    MODELS,
    apply_model,
    check_params,
    count_parameters,
    init_model,
    measure_statistics,
    merge_statistics,
    scale_output,
)

COUNTS = {
    "eslr-15": 4_753_108,
    "eslr-10": 3_231_828,
    "lsdmp-15": 4_601_044,
    "mgn-15": 3_854_164,
    "mgn-48": 12_027_604,
}
SIZES = {"message_passing_steps": 1, "latent_size": 8, "attention_size": 4, "attention_features": 8}
SMALL = dataclasses.replace(MODELS["eslr-small"], **SIZES)
FAITHFUL = dataclasses.replace(MODELS["eslr-15"], attention_blocks=1, **SIZES)


@functools.cache
def new(config):
    return init_model(config)


@pytest.mark.parametrize("name", COUNTS)
def test_parameter_counts_are_the_papers(name):
    shapes = jax.eval_shape(lambda: init_model(MODELS[name]))
    assert count_parameters(shapes) == COUNTS[name]


def test_weights_follow_their_seed_and_directions_the_configs():
    first, again, other = new(SMALL), init_model(SMALL, 0), init_model(SMALL, 1)
    jax.tree.map(np.testing.assert_array_equal, first, again)
    kernels = [params["params"]["decoder"]["kernel_0"] for params in (first, other)]
    assert not np.allclose(*kernels)
    np.testing.assert_array_equal(first["constants"]["projection"], other["constants"]["projection"])
    reseeded = init_model(dataclasses.replace(SMALL, seed=5))
    assert not np.allclose(first["constants"]["projection"], reseeded["constants"]["projection"])


def test_initial_weights_have_the_spread_of_their_fan_in():
    config = dataclasses.replace(MODELS["mgn-15"], message_passing_steps=2)
    kernel = init_model(config)["params"]["layers"]["mesh_mlp"]["kernel_0"]
    assert kernel.shape == (2, 384, 128)
    np.testing.assert_allclose(np.std(kernel), np.sqrt(1.5 / 384), rtol=0.01)
    assert not np.allclose(kernel[0], kernel[1])


def test_corrections_start_small():
    last = new(SMALL)["params"]["decoder"]["kernel_2"]
    assert np.abs(last).max() < 0.1


def test_outputs_have_physical_scales():
    ones = jnp.ones((2, 3))
    np.testing.assert_allclose(scale_output(SMALL, new(SMALL), ones), SMALL.output_scale)
    np.testing.assert_array_equal(scale_output(FAITHFUL, new(FAITHFUL), ones), ones)


@pytest.mark.parametrize("name", MODELS)
def test_configs_survive_a_round_trip(name):
    assert from_dict(ModelConfig, to_dict(MODELS[name])) == MODELS[name]


@pytest.mark.parametrize(
    "values",
    [
        {"message_passing_steps": 0},
        {"smoothing_steps": -1},
        {"output_scale": 0.0},
        {"refinement_steps": 3},
        {"refinement_steps": 3, "features": "gradient"},
    ],
)
def test_impossible_configs_name_the_field(values):
    with pytest.raises(ConfigError, match=next(iter(values))):
        from_dict(ModelConfig, values)


def test_statistics_are_those_of_what_is_normalised():
    assert set(new(FAITHFUL)["statistics"]) == {"garment", "mesh", "world", "output"}
    assert new(SMALL)["statistics"] == {}


def test_weights_of_another_architecture_are_refused():
    check_params(SMALL, new(SMALL))
    wider = dataclasses.replace(SMALL, latent_size=16)
    with pytest.raises(CheckpointError, match="another architecture"):
        check_params(wider, new(SMALL))
    with pytest.raises(CheckpointError, match="missing"):
        check_params(FAITHFUL, {**new(FAITHFUL), "statistics": {}})


def test_shapes_of_traced_weights_are_checked():
    def apply(params, config):
        check_params(config, params)
        return sum(jnp.sum(leaf) for leaf in jax.tree.leaves(params["params"]))

    stacked = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), new(SMALL))
    assert jax.jit(jax.vmap(lambda params: apply(params, SMALL)))(stacked).shape == (2,)
    with pytest.raises(CheckpointError):
        jax.jit(lambda params: apply(params, SMALL))(stacked)


# --- files --------------------------------------------------------------------------------------------------


def assert_round_trip(folder, config, params):
    write_weights(folder / "model.npz", params, config, {})
    loaded, read_config, _ = read_weights(folder / "model.npz")
    assert read_config == config
    check_params(config, loaded)
    jax.tree.map(np.testing.assert_array_equal, loaded, params)
    return loaded


def test_a_network_is_not_there_before_its_description(tmp_path, monkeypatch):
    """Killed in between, an archive alone would be taken for a trained network."""

    def killed(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(weights, "write_arrays", killed)
    with pytest.raises(KeyboardInterrupt):
        write_weights(tmp_path / "model.npz", new(SMALL), SMALL, {})
    assert [path.name for path in tmp_path.iterdir()] == ["model.json"]


def shrink(config):
    return dataclasses.replace(
        config, **SIZES | ({"message_passing_steps": 5} if config.hierarchical else {})
    )


SHRUNK = {shrink(config): name for name, config in reversed(MODELS.items())}


@pytest.mark.parametrize("config", SHRUNK, ids=SHRUNK.values())
def test_small_weights_survive_a_round_trip(tmp_path, config):
    assert_round_trip(tmp_path, config, new(config))


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
def test_weights_survive_a_round_trip(tmp_path, name):
    assert_round_trip(tmp_path, MODELS[name], init_model(MODELS[name]))


def test_a_network_with_statistics_answers_as_before_its_export(tmp_path):
    garment, material, inputs = make_scene(6, 4)

    @quick_jit
    def run(params, inputs):
        graph = build_graph(garment, material, inputs, FAITHFUL)
        measured = measure_statistics(FAITHFUL, params, graph, garment, inputs.velocity)
        answer = scale_output(FAITHFUL, params, apply_model(FAITHFUL, params, graph, garment))
        return merge_statistics(params, measured), answer

    params, before = run(new(FAITHFUL), inputs)
    _, expected = run(params, inputs)
    assert not np.allclose(before, expected)  # statistics count
    loaded = assert_round_trip(tmp_path, FAITHFUL, params)
    np.testing.assert_array_equal(run(loaded, inputs)[1], expected)


@pytest.mark.parametrize("names", [("params/a", "params/a/b"), ("statistics/mesh/mean",)])
def test_archives_that_are_no_tree_of_weights_are_refused(tmp_path, names):
    write_weights(tmp_path / "model.npz", new(SMALL), SMALL, {})
    np.savez(tmp_path / "model.npz", **dict.fromkeys(names, np.zeros(2)))
    with pytest.raises(CheckpointError, match="no tree of weights"):
        read_weights(tmp_path / "model.npz")
