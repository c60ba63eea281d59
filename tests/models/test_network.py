"""The fast network against the plain one, and what must hold for any network on a graph."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_models import layer_weights, make_scene, plain_layer, plain_network, quick_jit, to_float64

from eslr_jax.config import ModelConfig
from eslr_jax.errors import ConfigError
from eslr_jax.graph.build import build_frame_graph, build_graph, build_refinement_graph
from eslr_jax.graph.operators import mesh_tables, sum_receivers, world_tables
from eslr_jax.models import registry
from eslr_jax.models.lsdmp import Latents, LsdmpLayer
from eslr_jax.models.registry import MODELS, apply_model, init_model
from eslr_jax.types import tree_cast

TINY = ModelConfig(
    message_passing_steps=2,
    attention_blocks=2,
    latent_size=16,
    update_body=True,
    attention_size=8,
    attention_features=24,
)
GRADIENT = dataclasses.replace(
    MODELS["eslr-small"], message_passing_steps=2, latent_size=16, attention_size=8, attention_features=24
)
SMOOTHING = dataclasses.replace(
    MODELS["smooth-small"],
    message_passing_steps=2,
    attention_blocks=1,
    latent_size=16,
    attention_size=8,
    attention_features=24,
)
VARIANTS = {
    "paper": TINY,
    "gradient": GRADIENT,
    "fixed-body": dataclasses.replace(TINY, update_body=False),
    "fixed-body-edges-once": dataclasses.replace(TINY, update_body=False, readd_edges=False),
    "edges-once": dataclasses.replace(TINY, readd_edges=False, hidden_layers=1),
    "mesh-smoothing": dataclasses.replace(TINY, smooth_world_edges=False, remat="none"),
    "no-residual": dataclasses.replace(TINY, residual=False),
    "meshgraphnet": dataclasses.replace(TINY, smoothing_steps=0, attention_blocks=0),
    "capacity": dataclasses.replace(TINY, world_edge_capacity=46),
    "gradient-body-capacity": dataclasses.replace(GRADIENT, update_body=True, world_edge_capacity=46),
    "smoothing": SMOOTHING,
    "smoothing-capacity": dataclasses.replace(SMOOTHING, world_edge_capacity=46),
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


def run(config, params, garment, material, inputs, jit=quick_jit):
    """Return weights with statistics of this graph, the graph and the raw output, compiled as one."""

    @jit
    def build_and_apply(params, garment, material, inputs):
        graph = build_graph(garment, material, inputs, config)
        measured = registry.measure_statistics(config, params, graph, garment, inputs.velocity)
        params = registry.merge_statistics(params, measured)
        return params, graph, apply_model(config, params, graph, garment)

    return build_and_apply(params, garment, material, inputs)


def oracle(config, params, graph, garment):
    return plain_network(config, *(to_float64(tree) for tree in (params, graph, garment)))


def quick(names, *chosen):
    """Parametrize by name; all but the chosen ones are slow: each compiles a network of its own."""
    return [name if name in chosen else pytest.param(name, marks=pytest.mark.slow) for name in names]


@pytest.mark.parametrize("name", quick(VARIANTS, "paper", "gradient", "smoothing"))
def test_network_matches_numpy(name):
    config = VARIANTS[name]
    scene = make_scene(8, 6)
    params, graph, actual = run(config, scramble(init_model(config)), *scene)
    expected = oracle(config, params, graph, scene[0])
    np.testing.assert_allclose(actual, expected, atol=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize("name", ["paper", "gradient", "smoothing"])
def test_optimised_network_without_a_body_matches_numpy(name):
    """With all of the compiler's passes, as a canary; and there is no world code to compile."""
    config = VARIANTS[name]
    scene = make_scene(8, 6, body=False)
    params, graph, actual = run(config, scramble(init_model(config)), *scene, jit=jax.jit)
    assert (set(graph.nodes), set(graph.edges)) == ({"garment"}, {"mesh"})
    expected = oracle(config, params, graph, scene[0])
    np.testing.assert_allclose(actual, expected, atol=1e-5 * np.abs(expected).max())


@pytest.mark.numerics
@pytest.mark.parametrize("name", quick(["paper", "gradient", "capacity", "smoothing"], "paper"))
def test_network_and_its_gradient_match_plain_code_in_float64(name):
    config = VARIANTS[name]
    scene = make_scene(8, 6)
    params = scramble(init_model(config))
    with jax.enable_x64(True):
        *scene, params = (tree_cast(tree, jnp.float64) for tree in (*scene, params))
        params, graph, actual = run(config, params, *scene)
        assert actual.dtype == jnp.float64
        expected = oracle(config, params, graph, scene[0])
        np.testing.assert_allclose(actual, expected, atol=1e-10 * np.abs(expected).max())

        weight = jnp.asarray(np.random.default_rng(0).standard_normal(actual.shape))

        def slopes(network):
            def total(trained, graph):
                return jnp.sum(weight * network(config, {**params, "params": trained}, graph, scene[0]))

            return quick_jit(jax.grad(total, allow_int=True))(params["params"], graph)

        with jax.numpy_rank_promotion("allow"):
            plain = slopes(lambda *args: plain_network(*args, jnp))
        fast = slopes(apply_model)
        # The largest exponents of softmax features are not differentiated: an error of their epsilon, 1e-6.
        tolerance = 1e-10 if config.attention_kernel == "relu" else 1e-6
        tolerance *= max(np.abs(leaf).max() for leaf in jax.tree.leaves(plain))
        for first, second in zip(jax.tree.leaves(fast), jax.tree.leaves(plain), strict=True):
            np.testing.assert_allclose(first, second, atol=tolerance)


def test_layer_matches_numpy_alone():
    """One LSDMP layer on random latents: eqs. 1-4 and nothing else."""
    config = TINY
    garment, material, inputs = make_scene(8, 6)
    graph = quick_jit(lambda *scene: build_graph(*scene, config))(garment, material, inputs)
    generator = np.random.default_rng(0)
    size = config.latent_size
    names = {**graph.nodes, **graph.edges}
    rows = {name: generator.standard_normal((len(x), size)).astype(np.float32) for name, x in names.items()}
    weights = layer_weights(scramble(init_model(config))["params"]["layers"], 1)

    @quick_jit
    def apply(weights, rows, graph, garment):
        mesh, entries = mesh_tables(garment, jnp.float32), graph.globals
        mask = entries["world_mask"]
        world = world_tables(entries["world_slot"], graph.receivers["world"], mask, jnp.float32)
        latents = Latents(mesh_sum=sum_receivers(rows["mesh"], mesh), **rows)
        return LsdmpLayer(config).apply({"params": weights}, latents, (mesh, world))[0]

    actual = apply(weights, rows, graph, garment)
    expected = plain_layer(*(to_float64(tree) for tree in (rows, graph, weights)), config, np)
    for name, values in expected.items():
        np.testing.assert_allclose(getattr(actual, name), values, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("config", [dataclasses.replace(GRADIENT, update_body=True), SMOOTHING])
def test_passes_over_an_encoded_frame_equal_the_whole_graph(config):
    garment, material, inputs = make_scene(8, 6)
    params = scramble(init_model(config))

    @quick_jit
    def both(params, garment, material, inputs):
        frame = build_frame_graph(garment, material, inputs, config)
        encoded = registry.encode_frame(config, params, frame, garment)
        changing = build_refinement_graph(garment, material, inputs, frame)
        whole = build_graph(garment, material, inputs, config)
        return (
            registry.apply_refinement(config, params, encoded, changing, garment),
            apply_model(config, params, whole, garment),
        )

    first, second = both(params, garment, material, inputs)
    np.testing.assert_allclose(first, second, atol=1e-5 * np.abs(second).max())


@pytest.mark.parametrize("body", [True, False], ids=["body", "free"])
@pytest.mark.parametrize(("layers", "smoothings"), [(1, 0), (1, 1), (2, 1), (1, 3)])
def test_a_change_spreads_layers_times_one_plus_smoothings_hops(layers, smoothings, body):
    config = dataclasses.replace(
        TINY,
        message_passing_steps=layers,
        smoothing_steps=smoothings,
        attention_blocks=0,
        features="gradient",
    )
    garment, material, inputs = make_scene(6, 14, body=body)
    params = scramble(init_model(config))
    source = 6 * 7
    apply = quick_jit(lambda graph: apply_model(config, params, graph, garment))
    graph = quick_jit(lambda: build_graph(garment, material, inputs, config))()
    nudged = graph.nodes["garment"].at[source].add(1.0)
    change = apply(graph) - apply(graph._replace(nodes={**graph.nodes, "garment": nudged}))
    hops = np.full(len(change), -1)
    front, neighbors = {source}, np.asarray(garment.neighbors)
    for distance in range(len(change)):
        for vertex in front:
            hops[vertex] = distance
        front = {n for v in front for n in neighbors[v] if hops[n] < 0}
    reached = np.abs(change).max(axis=1) > 0
    np.testing.assert_array_equal(reached, hops <= layers * (1 + smoothings))
    assert not reached.all()


def permute_garment(garment, order):
    """Return the same garment with vertex `order[i]` at row i, its tables sorted as they must be."""
    rank = np.argsort(order)
    senders, receivers = rank[garment.senders], rank[garment.receivers]
    sort = np.lexsort((senders, receivers))
    face_order = np.arange(len(garment.faces))
    return garment.replace(
        rest_positions=garment.rest_positions[order],
        faces=jnp.asarray(rank[garment.faces][face_order]),
        vertex_areas=garment.vertex_areas[order],
        senders=jnp.asarray(senders[sort]),
        receivers=jnp.asarray(receivers[sort]),
        reverse_edges=jnp.asarray(np.argsort(sort)[np.asarray(garment.reverse_edges)[sort]]),
        neighbors=jnp.asarray(rank[garment.neighbors][order]),
        neighbor_mask=garment.neighbor_mask[order],
        face_incidence=garment.face_incidence[order],
        hinge_incidence=garment.hinge_incidence[order],
        geodesic_embedding=garment.geodesic_embedding[order],
        is_pinned=garment.is_pinned[order],
    )


@pytest.mark.parametrize("name", ["paper", "gradient", "smoothing"])
def test_network_is_equivariant_to_vertex_order(name):
    config = VARIANTS[name]
    garment, material, inputs = make_scene(8, 6)
    params = scramble(init_model(config))
    order = np.random.default_rng(0).permutation(garment.vertex_areas.shape[0])
    shuffled = jax.tree.map(lambda leaf: leaf[order] if leaf.ndim else leaf, inputs)
    expected = run(config, params, garment, material, inputs)[2][order]
    actual = run(config, params, permute_garment(garment, order), material, shuffled)[2]
    np.testing.assert_allclose(actual, expected, atol=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize("name", ["paper", "gradient", "smoothing"])
def test_padding_does_not_change_the_answer(name):
    config = VARIANTS[name]
    scene, padded = make_scene(8, 6), make_scene(8, 6, pad=True)
    params = scramble(init_model(config))
    expected = run(config, params, *scene)[2]
    actual = run(config, params, *padded)[2]
    assert np.isfinite(actual).all()
    np.testing.assert_allclose(actual[: len(expected)], expected, atol=2e-6 * np.abs(expected).max())


def test_masked_world_rows_contribute_exactly_nothing():
    config = dataclasses.replace(TINY, message_passing_steps=1, attention_blocks=0)
    garment, material, inputs = make_scene(8, 6)
    params, graph, expected = run(config, init_model(config), garment, material, inputs)
    unused = ~np.asarray(graph.globals["world_mask"])[:, None]
    spoil = lambda rows: jnp.where(unused, 1e3, rows)  # noqa: E731
    spoiled = graph._replace(
        nodes={**graph.nodes, "body": spoil(graph.nodes["body"])},
        edges={k: spoil(rows) if k != "mesh" else rows for k, rows in graph.edges.items()},
    )
    actual = quick_jit(lambda *args: apply_model(config, *args))(params, spoiled, garment)
    again = quick_jit(lambda *args: apply_model(config, *args))(params, graph, garment)
    np.testing.assert_array_equal(actual, again)
    np.testing.assert_allclose(actual, expected, atol=1e-5)


def test_a_garment_with_another_embedding_is_refused():
    garment, material, inputs = make_scene(8, 6)
    garment = garment.replace(geodesic_embedding=garment.geodesic_embedding[:, :3])
    with pytest.raises(ConfigError, match="embedding_size"):
        run(TINY, init_model(TINY), garment, material, inputs)


def test_reduced_precision_stays_close():
    config = dataclasses.replace(TINY, precision="bfloat16")
    scene = make_scene(8, 6)
    params = scramble(init_model(TINY))
    exact, reduced = (run(c, params, *scene)[2] for c in (TINY, config))
    gap = np.linalg.norm(reduced - exact) / np.linalg.norm(exact)
    assert 0 < gap < 0.05
    assert reduced.dtype == jnp.float32


def test_batches_by_vmap_and_by_map_agree_with_a_loop():
    config = VARIANTS["gradient"]
    (garment, material, first), (_, _, second) = make_scene(8, 6), make_scene(8, 6, seed=1)
    params = scramble(init_model(config))
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), first, second)

    def apply(inputs):
        return apply_model(config, params, build_graph(garment, material, inputs, config), garment)

    one = quick_jit(apply)
    expected = jnp.stack([one(first), one(second)])
    tolerance = 1e-5 * np.abs(expected).max()
    np.testing.assert_allclose(quick_jit(jax.vmap(apply))(batch), expected, atol=tolerance)
    mapped = quick_jit(lambda batch: jax.lax.map(apply, batch))(batch)
    np.testing.assert_allclose(mapped, expected, atol=tolerance)
