"""Named models: their sizes, their weights, their scales, their files."""

import dataclasses
import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_models import make_scene, quick_jit

from eslr_jax import CheckpointError, ConfigError
from eslr_jax.networks import registry
from eslr_jax.networks.apply import apply_model, measure_statistics, merge_statistics, scale_output
from eslr_jax.networks.build import build_graph
from eslr_jax.networks.network import check_network, describe_system
from eslr_jax.networks.registry import MODELS, read_network, read_system, write_network

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
    return config.new_network()


@pytest.mark.parametrize("name", COUNTS)
def test_parameter_counts_are_the_papers(name):
    assert jax.eval_shape(lambda: MODELS[name].new_network()).num_parameters == COUNTS[name]


def test_weights_follow_their_seed_and_directions_the_configs():
    first, again, other = new(SMALL), SMALL.new_network(0), SMALL.new_network(1)
    jax.tree.map(np.testing.assert_array_equal, first, again)
    kernels = [network.params["decoder"]["kernel_0"] for network in (first, other)]
    assert not np.allclose(*kernels)
    np.testing.assert_array_equal(first.constants["projection"], other.constants["projection"])
    reseeded = dataclasses.replace(SMALL, seed=5).new_network()
    assert not np.allclose(first.constants["projection"], reseeded.constants["projection"])


def test_initial_weights_have_the_spread_of_their_fan_in():
    config = dataclasses.replace(MODELS["mgn-15"], message_passing_steps=2)
    kernel = config.new_network().params["layers"]["mesh_mlp"]["kernel_0"]
    assert kernel.shape == (2, 384, 128)
    np.testing.assert_allclose(np.std(kernel), np.sqrt(1.5 / 384), rtol=0.01)
    assert not np.allclose(kernel[0], kernel[1])


def test_corrections_start_small():
    last = new(SMALL).params["decoder"]["kernel_2"]
    assert np.abs(last).max() < 0.1


def test_outputs_have_physical_scales():
    ones = jnp.ones((2, 3))
    np.testing.assert_allclose(scale_output(new(SMALL), ones), SMALL.correction_scale)
    np.testing.assert_array_equal(scale_output(new(FAITHFUL), ones), ones)


@pytest.mark.parametrize("name", MODELS)
def test_configs_survive_a_round_trip(name):
    assert read_system(json.loads(json.dumps(describe_system(MODELS[name])))) == MODELS[name]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"base": "eslr", "message_passing_steps": 0}, "message_passing_steps must be at least 1"),
        ({"base": "eslr", "smoothing_steps": -1}, "smoothing_steps must not be negative"),
        ({"base": "eslr", "correction_scale": 0.0}, "correction_scale must be positive"),
        ({"base": "refinement", "refinement_steps": 0}, "refinement_steps must be at least 1"),
        ({"base": "hood", "steps_per_stage": 0}, "steps_per_stage must be at least 1"),
        ({"base": "eslr", "latent_size": "wide"}, "wrong type"),
        ({"base": "eslr", "latent_size": True}, "wrong type"),
        ({"base": "smooth-small", "output": "magic"}, "not one of"),
        ({"base": "eslr", "latent_sise": 64}, r"did you mean model\.latent_size"),
        ({"base": "eslr-5", "refinement_steps": 3}, r"unknown option model\.refinement_steps"),
        ({"base": "smooth-small", "update_body": True}, r"unknown option model\.update_body"),
        ({"base": "eslr-tiny"}, "unknown model 'eslr-tiny'"),
        ({"latent_size": 64}, "the model has no base"),
    ],
)
def test_impossible_configs_name_the_field(values, message):
    with pytest.raises(ConfigError, match=message):
        read_system(values)


def test_statistics_are_those_of_what_is_normalised():
    assert set(new(FAITHFUL).statistics) == {"garment", "mesh", "world", "output"}
    assert new(SMALL).statistics == {}


def test_weights_of_another_architecture_are_refused():
    check_network(new(SMALL))
    wider = dataclasses.replace(SMALL, latent_size=16)
    with pytest.raises(CheckpointError, match="another architecture"):
        check_network(new(SMALL).replace(config=wider))
    with pytest.raises(CheckpointError, match="missing"):
        check_network(new(FAITHFUL).replace(statistics={}))


def test_shapes_of_traced_weights_are_checked():
    def apply(network):
        check_network(network)
        return sum(jnp.sum(leaf) for leaf in jax.tree.leaves(network.params))

    stacked = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), new(SMALL))
    assert jax.jit(jax.vmap(apply))(stacked).shape == (2,)
    with pytest.raises(CheckpointError):
        jax.jit(apply)(stacked)


# --- files --------------------------------------------------------------------------------------------------


def assert_round_trip(folder, network):
    write_network(folder / "model.npz", network, {})
    loaded, _ = read_network(folder / "model.npz")
    assert loaded.config == network.config
    jax.tree.map(np.testing.assert_array_equal, loaded, network)
    return loaded


def test_a_network_is_not_there_before_its_description(tmp_path, monkeypatch):
    """Killed in between, an archive alone would be taken for a trained network."""

    def killed(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(registry, "write_arrays", killed)
    with pytest.raises(KeyboardInterrupt):
        write_network(tmp_path / "model.npz", new(SMALL), {})
    assert [path.name for path in tmp_path.iterdir()] == ["model.json"]


def shrink(config):
    few = {"steps_per_stage": 1, "layers": 1} | SIZES
    return dataclasses.replace(config, **{name: few[name] for name in few if hasattr(config, name)})


@pytest.mark.parametrize("name", ["eslr-15", "eslr-small", "smooth-small", "hood-5"])
def test_weights_survive_a_round_trip(tmp_path, name):
    assert_round_trip(tmp_path, new(shrink(MODELS[name])))


def test_a_network_with_statistics_answers_as_before_its_export(tmp_path):
    garment, material, inputs = make_scene(6, 4)

    @quick_jit
    def run(network, inputs):
        graph = build_graph(garment, material, inputs, network.config.graph)
        measured = measure_statistics(network, graph, garment, inputs.velocity)
        answer = scale_output(network, apply_model(network, graph, garment))
        return merge_statistics(network, measured), answer

    network, before = run(new(FAITHFUL), inputs)
    _, expected = run(network, inputs)
    assert not np.allclose(before, expected)  # statistics count
    loaded = assert_round_trip(tmp_path, network)
    np.testing.assert_array_equal(run(loaded, inputs)[1], expected)


@pytest.mark.parametrize("names", [("params/a", "params/a/b"), ("statistics/mesh/mean",)])
def test_archives_that_are_no_tree_of_weights_are_refused(tmp_path, names):
    write_network(tmp_path / "model.npz", new(SMALL), {})
    np.savez(tmp_path / "model.npz", **dict.fromkeys(names, np.zeros(2)))
    with pytest.raises(CheckpointError, match="no tree of weights"):
        read_network(tmp_path / "model.npz")
