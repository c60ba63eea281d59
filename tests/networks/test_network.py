"""The fast network against the plain one, and what must hold for any network on a graph."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cloth import make_garment
from reference_models import make_scene, plain_network, quick_jit, to_float64, trained

from eslr_jax import ConfigError
from eslr_jax.networks.apply import (
    apply_model,
    apply_refinement,
    encode_frame,
    measure_statistics,
    merge_statistics,
)
from eslr_jax.networks.build import build_frame_graph, build_graph, build_refinement_graph
from eslr_jax.networks.dense import TALL, matmul
from eslr_jax.networks.eslr import Eslr
from eslr_jax.networks.registry import MODELS
from eslr_jax.types import tree_cast

SIZES = {"message_passing_steps": 2, "latent_size": 16, "attention_size": 8, "attention_features": 24}
PAPER = Eslr(attention_blocks=2, update_body=True, **SIZES)
GRADIENT = dataclasses.replace(MODELS["eslr-small"], **SIZES)
SMOOTHING = dataclasses.replace(MODELS["smooth-small"], layers=2, latent_size=16)
VARIANTS = {
    "paper": PAPER,
    "gradient": GRADIENT,
    "smoothing": SMOOTHING,
    "state": dataclasses.replace(PAPER, features="state", world_edges=2),
    "fixed-body": dataclasses.replace(PAPER, update_body=False),
    "one-hidden-layer": dataclasses.replace(PAPER, hidden_layers=1, remat="none"),
    "meshgraphnet": dataclasses.replace(PAPER, smoothing_steps=0, attention_blocks=0, remat="layers"),
    "gradient-body": dataclasses.replace(PAPER, correction_scale=0.005),
}


def quick(names, *chosen):
    """Parametrize by name; all but the chosen ones are slow: each compiles a network of its own."""
    return [name if name in chosen else pytest.param(name, marks=pytest.mark.slow) for name in names]


def build_and_apply(network, garment, material, inputs):
    """Return the network with statistics of this graph, the graph and the raw output."""
    graph = build_graph(garment, material, inputs, network.config.graph)
    network = merge_statistics(network, measure_statistics(network, graph, garment, inputs.velocity))
    return network, graph, apply_model(network, graph, garment)


run = quick_jit(build_and_apply)
apply = quick_jit(apply_model)


@pytest.fixture(scope="module")
def scene():
    return make_scene(8, 6)


def assert_close(actual, expected, tolerance=1e-5):
    np.testing.assert_allclose(actual, expected, atol=tolerance * np.abs(expected).max())


def oracle(network, graph, garment):
    return plain_network(*(to_float64(tree) for tree in (network, graph, garment)))


def with_world_edges(scene, count):
    """Return a scene whose vertices have so many world edges, each with its own body point."""
    garment, material, inputs = scene
    others = [make_scene(8, 6, seed=seed)[2] for seed in range(1, count)]
    contacts = jax.tree.map(lambda *rows: jnp.concatenate(rows), *(one.contacts for one in (inputs, *others)))
    return garment, material, inputs.replace(contacts=contacts)


@pytest.mark.parametrize("name", quick(VARIANTS, "paper", "state", "smoothing"))
def test_network_matches_numpy(name, scene):
    config = VARIANTS[name]
    scene = with_world_edges(scene, config.graph.world_edges)
    network, graph, actual = run(trained(config), *scene)
    assert_close(actual, oracle(network, graph, scene[0]))


@pytest.mark.parametrize("name", quick(["paper", "gradient", "smoothing"], "gradient"))
def test_optimised_network_without_a_body_matches_numpy(name):
    """With all of the compiler's passes, as a canary; and there is no world code to compile."""
    scene = make_scene(8, 6, body=False)
    network, graph, actual = jax.jit(build_and_apply)(trained(VARIANTS[name]), *scene)
    assert (set(graph.nodes), set(graph.edges)) == ({"garment"}, {"mesh"})
    assert_close(actual, oracle(network, graph, scene[0]))


@pytest.mark.numerics
@pytest.mark.parametrize("name", quick(["paper", "paper-free", "gradient", "smoothing"], "paper-free"))
def test_gradient_matches_that_of_plain_code_in_float64(name):
    """The backward passes are written by hand; those of the plain network are JAX's."""
    few = {"message_passing_steps": 1, "smoothing_steps": 2, "attention_blocks": 1}
    few = {"layers": 1, "smoothing_steps": 2} if name == "smoothing" else few
    config = dataclasses.replace(VARIANTS[name.removesuffix("-free")], **few)
    scene = make_scene(6, 4, body=not name.endswith("-free"))
    single = (*scene, trained(config))
    with jax.enable_x64(True):
        *scene, network = (tree_cast(tree, jnp.float64) for tree in single)
        graph = quick_jit(build_graph, static_argnums=3)(*scene, config.graph)
        direction = np.random.default_rng(0).standard_normal(scene[0].rest_positions.shape)

        def slopes(apply):
            def total(params, nodes, edges):
                rows = graph._replace(nodes=nodes, edges=edges)
                answer = apply(network.replace(params=params), rows, scene[0])
                return jnp.sum(direction * answer[:, :3])

            slope = jax.value_and_grad(total, argnums=(0, 1, 2))
            return quick_jit(slope)(network.params, graph.nodes, graph.edges)

        with jax.numpy_rank_promotion("allow"):
            plain = slopes(lambda *args: plain_network(*args, jnp))
        fast = slopes(apply_model)
        assert fast[0].dtype == jnp.float64
        # The largest exponents of softmax features are not differentiated: an error of their epsilon, 1e-6.
        tolerance = 1e-10 if name != "gradient" else 1e-6
        tolerance *= max(np.abs(leaf).max() for leaf in jax.tree.leaves(plain))
        jax.tree.map(partial(np.testing.assert_allclose, atol=tolerance), fast, plain)


@pytest.mark.parametrize("name", quick(["gradient", "smoothing", "gradient-body"], "smoothing"))
def test_refinement_of_an_encoded_frame_equals_the_whole_graph(name, scene):
    network = trained(VARIANTS[name])

    @quick_jit
    def refine(network, garment, material, inputs):
        graph = build_frame_graph(garment, material, inputs, network.config.graph)
        encoded = encode_frame(network, graph)
        changing = build_refinement_graph(garment, material, inputs, graph)
        return apply_refinement(network, encoded, changing, garment)

    assert_close(refine(network, *scene), run(network, *scene)[2])


@pytest.mark.parametrize("sizes", quick([(2, 1), (1, 0), (1, 1), (1, 3)], (2, 1)))
def test_a_change_spreads_layers_times_one_plus_smoothings_hops(sizes, scene):
    layers, smoothings = sizes
    config = dataclasses.replace(
        GRADIENT, message_passing_steps=layers, smoothing_steps=smoothings, attention_blocks=0
    )
    graph = run(trained(SMOOTHING), *scene)[1]  # the features are the same
    nudged = graph.nodes["garment"].at[0].add(10.0)  # far enough for float32 to show the farthest
    moved = graph._replace(nodes={**graph.nodes, "garment": nudged})
    first, second = (apply(trained(config), rows, scene[0]) for rows in (graph, moved))
    reached = np.abs(second - first).max(axis=1) > 0
    hops = np.full(len(reached), -1)
    front, neighbors = {0}, np.asarray(scene[0].neighbors)
    for distance in range(len(reached)):
        for vertex in front:
            hops[vertex] = distance
        front = {n for v in front for n in neighbors[v] if hops[n] < 0}
    assert hops.max() > layers * (1 + smoothings)
    np.testing.assert_array_equal(reached, hops <= layers * (1 + smoothings))


@pytest.mark.parametrize("name", quick(["paper", "gradient", "smoothing"], "smoothing"))
def test_messages_follow_the_graphs_senders(name, scene):
    network, graph, _ = run(trained(VARIANTS[name]), *scene)
    expected = apply(network, graph, scene[0])
    generator = np.random.default_rng(0)
    senders, receivers = (np.asarray(ends["mesh"]) for ends in (graph.senders, graph.receivers))

    shuffled = {**graph.senders, "mesh": jnp.asarray(generator.permutation(senders))}
    other = apply(network, graph._replace(senders=shuffled), scene[0])
    assert np.abs(other - expected).max() > 0.01 * np.abs(expected).max()

    order = np.lexsort((generator.random(len(senders)), receivers))  # edges stay sorted by receiver
    place = np.argsort(order)
    permuted = graph._replace(
        edges={**graph.edges, "mesh": graph.edges["mesh"][order]},
        senders={**graph.senders, "mesh": graph.senders["mesh"][order]},
        globals={
            **graph.globals,
            "reverse_edges": jnp.asarray(place[np.asarray(graph.globals["reverse_edges"])[order]]),
        },
    )
    assert_close(apply(network, permuted, scene[0]), expected)


def permute_garment(garment, order):
    """Return the same garment with vertex `order[i]` at row i."""
    positions, faces = np.asarray(garment.rest_positions)[order], np.argsort(order)[garment.faces]
    permuted = make_garment(positions, faces, is_pinned=np.asarray(garment.is_pinned)[order])
    return permuted.replace(geodesic_embedding=garment.geodesic_embedding[order])


@pytest.mark.parametrize("name", quick(["paper", "gradient", "smoothing"], "paper", "smoothing"))
def test_network_is_equivariant_to_vertex_order(name, scene):
    network = trained(VARIANTS[name])
    garment, material, inputs = scene
    order = np.random.default_rng(0).permutation(garment.vertex_areas.shape[0])
    shuffled = jax.tree.map(lambda leaf: leaf[order] if leaf.ndim else leaf, inputs)
    expected = run(network, *scene)[2][order]
    actual = run(network, permute_garment(garment, order), material, shuffled)[2]
    assert_close(actual, expected)


@pytest.mark.parametrize("name", quick(["paper", "gradient", "smoothing"], "smoothing"))
def test_padding_does_not_change_the_answer(name, scene):
    network = trained(VARIANTS[name])
    expected = run(network, *scene)[2]
    actual = run(network, *make_scene(8, 6, pad=True))[2]
    assert np.isfinite(actual).all()
    assert_close(actual[: len(expected)], expected, 2e-6)


@pytest.mark.parametrize("name", quick(["paper", "gradient", "smoothing"], "smoothing"))
def test_masked_world_rows_contribute_exactly_nothing(name, scene):
    network, graph, _ = run(trained(VARIANTS[name]), *scene)
    unused = ~np.asarray(graph.globals["world_mask"])[:, None]
    spoil = lambda rows: jnp.where(unused, 1e3, rows)  # noqa: E731
    spoiled = graph._replace(
        nodes={**graph.nodes, "body": spoil(graph.nodes["body"])},
        edges={k: spoil(rows) if k != "mesh" else rows for k, rows in graph.edges.items()},
    )
    expected = apply(network, graph, scene[0])
    np.testing.assert_array_equal(apply(network, spoiled, scene[0]), expected)


def test_a_garment_with_another_embedding_is_refused(scene):
    garment, material, inputs = scene
    garment = garment.replace(geodesic_embedding=garment.geodesic_embedding[:, :3])
    with pytest.raises(ConfigError, match="embedding_size"):
        run(trained(PAPER), garment, material, inputs)


@pytest.mark.slow
def test_reduced_precision_stays_close(scene):
    exact = run(trained(PAPER), *scene)[2]
    reduced = run(trained(PAPER).replace(config=dataclasses.replace(PAPER, precision="bfloat16")), *scene)[2]
    gap = np.linalg.norm(reduced - exact) / np.linalg.norm(exact)
    assert 1e-4 < gap < 0.05  # bfloat16 keeps eight bits
    assert reduced.dtype == jnp.float32


@pytest.mark.parametrize("way", quick(["vmap", "map"], "vmap"))
def test_a_batch_agrees_with_a_loop(way, scene):
    garment, material, first = scene
    second = make_scene(8, 6, seed=1)[2]
    network = trained(SMOOTHING)
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), first, second)

    def answer(inputs):
        return build_and_apply(network, garment, material, inputs)[2]

    batched = jax.vmap(answer) if way == "vmap" else lambda batch: jax.lax.map(answer, batch)
    expected = jnp.stack([run(network, garment, material, one)[2] for one in (first, second)])
    assert_close(quick_jit(batched)(batch), expected)


@pytest.mark.parametrize("rows", [TALL // 8, TALL + 88])
def test_products_in_bfloat16_have_the_gradients_of_exact_ones(rows):
    """The backward pass is written by hand, and otherwise for many rows."""
    random, shapes = np.random.default_rng(0), [(rows, 24), (24, 16), (rows, 16)]
    x, w, c = (jnp.asarray(random.standard_normal(shape), jnp.float32) for shape in shapes)

    def gradients(precision):
        return jax.jit(jax.grad(lambda x, w: jnp.sum(matmul(x, w, precision) * c), argnums=(0, 1)))(x, w)

    for near, exact in zip(gradients("bfloat16"), gradients("float32"), strict=True):
        assert float(jnp.abs(near - exact).max() / jnp.abs(exact).max()) < 0.01
    both = jax.vmap(lambda w: jax.grad(lambda w: jnp.sum(matmul(x, w, "bfloat16") * c))(w))(
        jnp.stack([w, 2 * w])
    )
    np.testing.assert_allclose(both[0], both[1], rtol=1e-5, atol=1e-4)


@pytest.mark.slow
def test_what_a_layer_keeps_for_its_backward_pass_changes_no_gradient():
    garment, material, inputs = make_scene(6, 5)
    found = []
    for remat in ("none", "products", "layers"):
        config = dataclasses.replace(MODELS["eslr-5"], latent_size=8, remat=remat)
        graph = build_graph(garment, material, inputs, config.graph)
        network = config.new_network()

        def total(params, graph=graph, network=network):
            return jnp.sum(apply_model(network.replace(params=params), graph, garment) ** 2)

        found.append(jax.jit(jax.grad(total))(network.params))
    for other in found[1:]:
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-4, atol=1e-6), found[0], other)
