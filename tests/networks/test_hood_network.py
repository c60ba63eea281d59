"""The hierarchical network against NumPy."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_models import make_scene, plain_hood, quick_jit, to_float64, trained

from eslr_jax import ConfigError
from eslr_jax.mesh.coarse import add_coarse_edges
from eslr_jax.networks.apply import (
    apply_model,
    apply_refinement,
    encode_frame,
    measure_statistics,
    merge_statistics,
)
from eslr_jax.networks.build import build_frame_graph, build_graph, build_refinement_graph
from eslr_jax.networks.registry import MODELS
from eslr_jax.types import tree_cast

SMALL = dataclasses.replace(MODELS["hood"], steps_per_stage=1, latent_size=8, remat="none")
CORRECTING = dataclasses.replace(SMALL, correction_scale=1.0)


@quick_jit
def run(network, garment, material, inputs):
    graph = build_graph(garment, material, inputs, network.config.graph)
    network = merge_statistics(network, measure_statistics(network, graph, garment, inputs.velocity))
    return network, graph, apply_model(network, graph, garment)


def coarse_scene(**options):
    garment, material, inputs = make_scene(8, 6, **options)
    return add_coarse_edges(garment), material, inputs


def test_parameter_count_is_that_of_the_published_network():
    assert jax.eval_shape(lambda: MODELS["hood"].new_network()).num_parameters == 5_146_852


@pytest.mark.parametrize("body", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_network_matches_numpy(body):
    network, graph, actual = run(trained(SMALL), *coarse_scene(body=body))
    expected = plain_hood(*(to_float64(tree) for tree in (network, graph)))
    np.testing.assert_allclose(actual, expected, atol=1e-5 * np.abs(expected).max())


@pytest.mark.slow
def test_network_with_gradient_features_matches_numpy():
    network, scene = trained(CORRECTING), coarse_scene()

    @quick_jit
    def both(network, garment, material, inputs):
        graph = build_graph(garment, material, inputs, network.config.graph)
        frame = build_frame_graph(garment, material, inputs, network.config.graph)
        changing = build_refinement_graph(garment, material, inputs, frame)
        encoded = encode_frame(network, frame)
        return (
            graph,
            apply_model(network, graph, garment),
            apply_refinement(network, encoded, changing, garment),
        )

    graph, actual, stepwise = both(network, *scene)
    expected = plain_hood(*(to_float64(tree) for tree in (network, graph)))
    np.testing.assert_allclose(actual, expected, atol=1e-5 * np.abs(expected).max())
    np.testing.assert_array_equal(stepwise, actual)


def test_gradient_features_of_a_coarse_level_match_numpy():
    garment, material, inputs = coarse_scene()
    graph = quick_jit(build_graph, static_argnums=3)(garment, material, inputs, CORRECTING.graph)
    for name, level in zip(("coarse0", "coarse1"), garment.coarse[:2], strict=True):
        is_real = np.asarray(level.edge_mask)
        senders, receivers = np.asarray(level.senders)[is_real], np.asarray(level.receivers)[is_real]
        rest, now, guess = (
            x[senders] - x[receivers]
            for x in to_float64((garment.rest_positions, inputs.position, inputs.guess))
        )
        length = np.linalg.norm(rest, axis=1, keepdims=True)
        unit = length.mean()
        strains = [(np.linalg.norm(x, axis=1, keepdims=True) / length - 1) / 0.1 for x in (now, guess)]
        columns = [now / unit, rest / unit, length / unit - 1, strains[0], guess / unit, strains[1]]
        expected = np.clip(np.concatenate(columns, axis=1), -5, 5)
        np.testing.assert_allclose(graph.edges[name][is_real], expected, atol=5e-4)


@pytest.mark.slow
def test_padding_does_not_change_the_answer():
    expected = run(trained(SMALL), *coarse_scene())[2]
    actual = run(trained(SMALL), *coarse_scene(pad=True))[2]
    np.testing.assert_allclose(actual[: len(expected)], expected, atol=2e-6 * np.abs(expected).max())


@pytest.mark.numerics
@pytest.mark.slow
def test_gradient_matches_finite_differences():
    single = (trained(SMALL), *coarse_scene())
    with jax.enable_x64(True):
        network, *scene = (tree_cast(tree, jnp.float64) for tree in single)
        network, graph, answer = run(network, *scene)
        generator = np.random.default_rng(0)
        direction = generator.standard_normal(answer.shape)
        rows = graph.nodes["garment"]
        move = generator.standard_normal((len(rows), 3)) * 0.01

        def total(velocity):
            nodes = {**graph.nodes, "garment": rows.at[:, :3].set(velocity)}
            answer = apply_model(network, graph._replace(nodes=nodes), scene[0])
            return jnp.sum(direction * answer)

        velocity, step, value = rows[:, :3], 1e-6, quick_jit(total)
        slope = jnp.sum(quick_jit(jax.grad(total))(velocity) * move)
        expected = (value(velocity + step * move) - value(velocity - step * move)) / (2 * step)
        np.testing.assert_allclose(slope, expected, rtol=1e-5)


def test_a_garment_without_coarse_levels_is_refused():
    with pytest.raises(ConfigError, match="add_coarse_edges"):
        jax.eval_shape(run, trained(SMALL), *make_scene(8, 6))
