"""The fast network against the plain one, and what must hold for any network on a graph."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_models import make_scene, plain_network, to_float64

from eslr_jax.config import ModelConfig
from eslr_jax.graph.build import build_frame_graph, build_graph, build_pass_graph
from eslr_jax.models import registry
from eslr_jax.models.registry import MODELS, apply_model, init_model
from eslr_jax.types import tree_cast

TINY = ModelConfig(
    message_passing_steps=2, attention_blocks=2, latent_size=16, attention_size=8, attention_features=24
)
GRADIENT = dataclasses.replace(
    MODELS["eslr-small"], message_passing_steps=2, latent_size=16, attention_size=8, attention_features=24
)
VARIANTS = {
    "paper": TINY,
    "gradient": GRADIENT,
    "fixed-body": dataclasses.replace(TINY, update_body=False),
    "fixed-body-edges-once": dataclasses.replace(TINY, update_body=False, readd_edges=False),
    "edges-once": dataclasses.replace(TINY, readd_edges=False),
    "mesh-smoothing": dataclasses.replace(TINY, smooth_world_edges=False),
    "no-residual": dataclasses.replace(TINY, residual=False),
    "meshgraphnet": dataclasses.replace(TINY, smoothing_steps=0, attention_blocks=0),
    "gradient-body": dataclasses.replace(GRADIENT, update_body=True),
    "capacity": dataclasses.replace(TINY, world_edge_capacity=46),
    "gradient-capacity": dataclasses.replace(GRADIENT, world_edge_capacity=46),
    "shallow": dataclasses.replace(TINY, hidden_layers=1, remat=False),
}


def scramble(params, seed=1):
    """Give biases and scales values that a mistake would show."""
    generator = np.random.default_rng(seed)
    return {
        **params,
        "params": jax.tree.map(
            lambda leaf: leaf + 0.1 * generator.standard_normal(leaf.shape, np.float32), params["params"]
        ),
    }


def run(config, params, garment, material, inputs, has_statistics=True):
    """Return weights with statistics, graph and raw output, compiled as one."""

    @jax.jit
    def build_and_apply(params, garment, material, inputs):
        graph = build_graph(garment, material, inputs, config)
        if has_statistics:
            velocity = graph.nodes["garment"][:, :3]
            params = registry.update_statistics(config, params, graph, garment, velocity)
        return params, graph, apply_model(config, params, graph, garment)

    return build_and_apply(params, garment, material, inputs)


@pytest.mark.parametrize("name", VARIANTS)
def test_network_matches_numpy(name):
    config = VARIANTS[name]
    garment, material, inputs = make_scene(8, 6)
    params, graph, actual = run(config, scramble(init_model(config)), garment, material, inputs)
    expected = plain_network(config, *(to_float64(x) for x in (params, graph, garment)))
    np.testing.assert_allclose(actual, expected, atol=2e-5 * np.abs(expected).max())


@pytest.mark.parametrize("name", ["paper", "gradient"])
def test_network_without_a_body_matches_numpy_and_has_no_world_code(name):
    config = VARIANTS[name]
    garment, material, inputs = make_scene(8, 6, body=False)
    params, graph, actual = run(config, scramble(init_model(config)), garment, material, inputs)
    assert set(graph.edges) == {"mesh"}
    assert set(graph.nodes) == {"garment"}
    expected = plain_network(config, *(to_float64(x) for x in (params, graph, garment)))
    np.testing.assert_allclose(actual, expected, atol=2e-5 * np.abs(expected).max())


@pytest.mark.numerics
@pytest.mark.parametrize("name", ["paper", "gradient", "capacity"])
def test_network_matches_numpy_in_float64(name):
    config = VARIANTS[name]
    scene = make_scene(8, 6)
    params = scramble(init_model(config))
    with jax.enable_x64(True):
        garment, material, inputs, params = (tree_cast(x, jnp.float64) for x in (*scene, params))
        params, graph, actual = run(config, params, garment, material, inputs)
        assert actual.dtype == jnp.float64
    expected = plain_network(config, *(to_float64(x) for x in (params, graph, garment)))
    np.testing.assert_allclose(actual, expected, atol=1e-10 * np.abs(expected).max())
