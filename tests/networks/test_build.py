"""Graphs and features against float64 NumPy, written down from the facts and not from the code."""

from functools import partial

import jax
import jax.numpy as jnp
import jraph
import numpy as np
import pytest
from draped_ball import drifting_ball, square
from reference_models import make_scene, quick_jit, to_float64

from eslr_jax import prepare_scene
from eslr_jax.networks.apply import graph_inputs
from eslr_jax.networks.build import GraphKind, build_graph, edge_set, feature_sizes, incoming_edges
from eslr_jax.networks.features import mean_edge_length
from eslr_jax.simulation.frame import first_problem
from eslr_jax.terms import FAST

HOOD = GraphKind(reads_gradient=False, has_reverse_edges=True)
GRADIENT = GraphKind(reads_gradient=True)
STATE = GraphKind(reads_gradient=False, reads_state=True, has_reverse_edges=True)


BOTH = [pytest.param(HOOD, id="hood", marks=pytest.mark.slow), pytest.param(GRADIENT, id="gradient")]
compiled = quick_jit(build_graph, static_argnums=3)


def build(config, scene):
    return compiled(*scene, config)


@pytest.fixture(scope="module")
def scene():
    return make_scene(8, 6)


@pytest.fixture(scope="module")
def hood_graph(scene):
    return build(HOOD, scene)


@pytest.fixture(scope="module")
def state_graph(scene):
    return build(STATE, scene)


@pytest.fixture(scope="module")
def gradient_graph(scene):
    return build(GRADIENT, scene)


def numpy_normals(faces, x):
    normals = np.zeros_like(x)
    for a, b, c in faces:
        for corner in (a, b, c):
            normals[corner] += np.cross(x[b] - x[a], x[c] - x[a])
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def with_norm(x):
    return np.concatenate([x, np.linalg.norm(x, axis=1, keepdims=True)], axis=1)


MATERIAL = np.array([0.6475, 0.2845, 0.4551])  # bending, mu, lambda inputs of HOOD's evaluation fabric


def test_hood_garment_features(scene, hood_graph):
    garment, _, inputs = (to_float64(tree) for tree in scene)
    count = len(garment.vertex_areas)
    expected = np.concatenate(
        [
            inputs.velocity,
            numpy_normals(garment.faces, inputs.position),
            np.full((count, 1), 1 / 30),
            np.log(0.20022 * garment.vertex_areas)[:, None],
            np.tile(MATERIAL, (count, 1)),
        ],
        axis=1,
    )
    np.testing.assert_allclose(hood_graph.nodes["garment"], expected, atol=1e-4)
    assert set(np.unique(hood_graph.globals["garment_type"])) == {0, 3}


def test_hood_mesh_features(scene, hood_graph):
    garment, _, inputs = (to_float64(tree) for tree in scene)
    edges = [(a, b) for a, b in zip(garment.senders, garment.receivers, strict=True)]
    rows = []
    for sender, receiver in edges:
        now = inputs.position[sender] - inputs.position[receiver]
        rest = garment.rest_positions[sender] - garment.rest_positions[receiver]
        rows.append([*now, np.linalg.norm(now), *rest, np.linalg.norm(rest), 1 / 30, *MATERIAL])
    np.testing.assert_allclose(hood_graph.edges["mesh"], rows, atol=1e-4)


def test_hood_world_features_and_the_rows_beyond_the_radius(scene, hood_graph):
    _, _, inputs = (to_float64(tree) for tree in scene)
    contacts = inputs.contacts
    is_close = np.abs(contacts.distances) <= 0.03
    assert 0 < is_close.sum() < len(is_close)
    now, later = contacts.points - inputs.position, contacts.next_points - inputs.position
    step = np.full((len(now), 1), 1 / 30)
    expected = np.concatenate([with_norm(now), with_norm(later), step], axis=1)
    expected[~is_close] = 0
    np.testing.assert_allclose(hood_graph.edges["world"], expected, atol=1e-6)
    np.testing.assert_array_equal(hood_graph.globals["world_mask"], is_close)
    reverse = np.concatenate([with_norm(-now), with_norm(-later), step], axis=1)
    reverse[~is_close] = 0
    np.testing.assert_allclose(hood_graph.edges["world_reverse"], reverse, atol=1e-6)
    velocity = contacts.next_points - contacts.points
    body = np.concatenate([velocity, contacts.normals, step, -np.ones((len(now), 4))], axis=1)
    body[~is_close] = 0
    np.testing.assert_allclose(hood_graph.nodes["body"], body, atol=1e-6)


def test_the_state_stands_beside_hoods_features(scene, hood_graph, state_graph):
    garment, _, inputs = (to_float64(tree) for tree in scene)
    contacts = inputs.contacts
    np.testing.assert_array_equal(state_graph.nodes["garment"], hood_graph.nodes["garment"])
    np.testing.assert_array_equal(state_graph.edges["mesh"][:, 5:], hood_graph.edges["mesh"])
    rows = []
    for sender, receiver in zip(garment.senders, garment.receivers, strict=True):
        length = np.linalg.norm(garment.rest_positions[sender] - garment.rest_positions[receiver])
        now = inputs.position[sender] - inputs.position[receiver]
        moving = inputs.velocity[sender] - inputs.velocity[receiver]
        strains = [np.clip((np.linalg.norm(x) / length - 1) / 0.1, -5, 5) for x in (now, now + moving)]
        rows.append([*moving, *strains])
    np.testing.assert_allclose(state_graph.edges["mesh"][:, :5], rows, atol=1e-4)
    ahead = np.sum((inputs.position + inputs.velocity - contacts.next_points) * contacts.next_normals, axis=1)
    expected = np.clip(np.stack([contacts.distances, ahead], axis=1) / 0.01, -5, 5)
    expected[contacts.distances > 0.03] = 0
    for name in ("world", "world_reverse"):
        np.testing.assert_array_equal(state_graph.edges[name][:, :-2], hood_graph.edges[name])
        np.testing.assert_allclose(state_graph.edges[name][:, -2:], expected, atol=1e-4)


def test_with_the_state_a_vertex_deep_in_the_body_keeps_its_first_world_edge(scene):
    garment, material, inputs = scene
    deep = inputs.contacts.replace(distances=jnp.full_like(inputs.contacts.distances, -0.2))
    twice = jax.tree.map(lambda rows: jnp.concatenate([rows, rows]), deep)
    graph = build(STATE._replace(world_edges=2), (garment, material, inputs.replace(contacts=twice)))
    first, second = np.asarray(graph.globals["world_mask"]).reshape(2, -1)
    assert first.all()
    assert not second.any()
    np.testing.assert_array_equal(graph.receivers["world"][len(first) :], np.arange(len(first)))


def test_the_other_world_edges_lead_to_the_nearest_body_vertices():
    scene = prepare_scene(square(), drifting_ball(2), terms=FAST)
    problem, state = jax.jit(first_problem)(scene), scene.initial_state
    count = len(problem.position)
    one, three = (
        quick_jit(graph_inputs, static_argnums=2)(problem, state, STATE._replace(world_edges=number)).contacts
        for number in (1, 3)
    )
    jax.tree.map(lambda few, many: np.testing.assert_array_equal(few, many[:count]), one, three)
    position, body, found = (np.asarray(x) for x in (problem.position, problem.body.start, three.points))
    away = np.sort(np.linalg.norm(position[:, None] - body[None], axis=2), axis=1)
    found = np.linalg.norm(found.reshape(3, -1, 3) - position, axis=2)
    np.testing.assert_allclose(found[1:].T, away[:, :2], atol=1e-6)


def test_gradient_node_features(scene, gradient_graph):
    garment, _, inputs = (to_float64(tree) for tree in scene)
    rest = garment.rest_positions
    spacing = np.mean(np.linalg.norm(rest[garment.senders] - rest[garment.receivers], axis=1))
    np.testing.assert_allclose(mean_edge_length(scene[0], scene[0]), spacing, rtol=1e-6)
    cut = lambda x: np.clip(x, -5, 5)  # noqa: E731
    rows = []
    for v, normal in enumerate(numpy_normals(garment.faces, inputs.position)):
        area = garment.vertex_areas[v]
        step = inputs.step[v] / (0.1 * spacing)
        row = [*cut(inputs.velocity[v] / 0.02), *normal, 0.0, np.log(0.20022 / 0.2)]
        row += [cut(np.log(area / spacing**2)), np.log(spacing / 0.02), garment.is_pinned[v], *MATERIAL]
        row += [*cut((inputs.guess[v] - inputs.inertial_guess[v]) / 0.01)]
        for force in (-inputs.gradient[v], -inputs.previous_gradient[v]):
            size = np.arcsinh(np.linalg.norm(force) / inputs.weight[v]) / 2
            row += [*(force / np.linalg.norm(force) * size), size]
            if force is not inputs.previous_gradient[v] and len(row) == 21:
                row += [*np.tanh(step), np.log1p(np.linalg.norm(step)) / 2]
                row += [*cut(inputs.correction[v] / 0.01)]
        rows.append(row)
    np.testing.assert_allclose(gradient_graph.nodes["garment"], rows, atol=2e-4)


def test_gradient_edge_features(scene, gradient_graph):
    garment, _, inputs = (to_float64(tree) for tree in scene)
    spacing = float(mean_edge_length(scene[0], scene[0]))
    rows = []
    for sender, receiver in zip(garment.senders, garment.receivers, strict=True):
        rest = garment.rest_positions[sender] - garment.rest_positions[receiver]
        length = np.linalg.norm(rest)
        now = inputs.position[sender] - inputs.position[receiver]
        guess = inputs.guess[sender] - inputs.guess[receiver]
        strain, guess_strain = ((np.linalg.norm(x) / length - 1) / 0.1 for x in (now, guess))
        rows.append([*now / spacing, *rest / spacing, length / spacing - 1, strain, *guess / spacing])
        rows[-1].append(guess_strain)
    np.testing.assert_allclose(gradient_graph.edges["mesh"], np.clip(rows, -5, 5), atol=2e-4)


def test_gradient_world_features(scene, gradient_graph):
    _, _, inputs = (to_float64(tree) for tree in scene)
    contacts = inputs.contacts
    now, later = inputs.position - contacts.points, inputs.position - contacts.next_points
    inertia, guess = (
        np.sum((x - contacts.next_points) * contacts.next_normals, axis=1, keepdims=True)
        for x in (inputs.inertial_guess, inputs.guess)
    )
    expected = [with_norm(now / 0.02), with_norm(later / 0.02), contacts.distances[:, None] / 0.01]
    expected += [inertia / 0.01, guess / 0.01, guess / 0.002]
    expected = np.clip(np.concatenate(expected, axis=1), -5, 5)
    expected[np.abs(contacts.distances) > 0.03] = 0
    np.testing.assert_allclose(gradient_graph.edges["world"], expected, atol=2e-4)


@pytest.mark.parametrize("config", [HOOD, STATE, GRADIENT], ids=["hood", "state", "gradient"])
def test_feature_sizes_are_those_of_the_graph(config, scene):
    graph = jax.eval_shape(lambda *scene: build_graph(*scene, config), *scene)
    sizes = {name: rows.shape[1] for name, rows in {**graph.nodes, **graph.edges}.items()}
    sizes.pop("world_reverse", None)
    assert sizes == feature_sizes(config)


@pytest.mark.parametrize("name", ["mesh", "world", "world_reverse"])
def test_jraph_batches_and_unbatches_a_set_of_edges(name, hood_graph):
    parts = [edge_set(graph, name) for graph in (hood_graph, build(HOOD, make_scene(6, 5)))]
    sizes = [len(part.nodes["garment"]) for part in parts]
    batch = jraph.batch(parts)
    np.testing.assert_array_equal(batch.n_node, sizes)
    np.testing.assert_array_equal(batch.n_edge, [len(part.edges) for part in parts])
    assert [len(rows) for rows in batch.nodes.values()] == [sum(sizes)] * 2
    np.testing.assert_array_equal(batch.senders[len(parts[0].senders) :], parts[1].senders + sizes[0])
    for part, again in zip(parts, jraph.unbatch(batch), strict=True):
        assert jax.tree.structure(part) == jax.tree.structure(again)
        jax.tree.map(np.testing.assert_array_equal, part, again)


def test_forces_keep_their_unit_where_there_is_no_weight(scene):
    garment, material, inputs = scene
    graph = build(GRADIENT, (garment, material, inputs.replace(weight=jnp.zeros_like(inputs.weight))))
    assert np.abs(graph.nodes["garment"]).max() < 10


@pytest.mark.parametrize("pad", [False, True])
def test_incoming_edges_end_at_their_vertex(pad):
    garment = make_scene(8, 6, pad=pad)[0]
    num_edges = len(garment.receivers)
    table = np.asarray(incoming_edges(garment.neighbor_mask, num_edges))
    for vertex, edges in enumerate(table):
        into = (np.asarray(garment.receivers) == vertex) & np.asarray(garment.edge_mask)
        np.testing.assert_array_equal(edges[edges < num_edges], np.flatnonzero(into))


def test_a_scene_without_a_body_has_no_world_entries():
    scene = make_scene(8, 6, body=False)
    graph = jax.eval_shape(lambda *scene: build_graph(*scene, GRADIENT), *scene)
    assert (set(graph.nodes), set(graph.edges), set(graph.senders)) == ({"garment"}, {"mesh"}, {"mesh"})
    assert "world_mask" not in graph.globals


def test_material_per_face_and_hinge_matches_the_scalar(scene, hood_graph):
    garment, material, inputs = scene
    varied = material.replace(
        lame_mu=jnp.full(garment.faces.shape[0], material.lame_mu),
        lame_lambda=jnp.full(garment.faces.shape[0], material.lame_lambda),
        bending_stiffness=jnp.full(garment.hinges.shape[0], material.bending_stiffness),
        density=jnp.full(garment.vertex_areas.shape[0], material.density),
    )
    graph = build(HOOD, (garment, varied, inputs))
    jax.tree.map(partial(np.testing.assert_allclose, atol=1e-5), graph, hood_graph)


@pytest.mark.parametrize("config", BOTH)
def test_padding_changes_no_real_row_and_stays_finite(config, scene):
    padded_scene = make_scene(8, 6, pad=True)
    graph, padded = build(config, scene), build(config, padded_scene)
    assert padded.nodes["garment"].shape[0] > graph.nodes["garment"].shape[0]
    for group, padded_group in ((graph.nodes, padded.nodes), (graph.edges, padded.edges)):
        for name, rows in group.items():
            np.testing.assert_allclose(padded_group[name][: rows.shape[0]], rows, atol=1e-5)
            assert np.isfinite(padded_group[name]).all()


@pytest.mark.parametrize("config", BOTH)
def test_gradients_of_features_are_finite_where_lengths_vanish(config):
    garment, material, inputs = make_scene(8, 6, pad=True)

    def total(position, guess, gradient):
        collapsed = inputs.replace(position=position, guess=guess, gradient=gradient)
        graph = build_graph(garment, material, collapsed, config)
        return sum(jnp.sum(rows**2) for rows in [*graph.nodes.values(), *graph.edges.values()])

    zeros = jnp.zeros_like(inputs.position)
    for slope in quick_jit(jax.grad(total, argnums=(0, 1, 2)))(zeros, zeros, zeros):
        assert np.isfinite(slope).all()


def test_cloth_that_is_not_stretched_as_sewn_has_no_strain_in_its_features(scene):
    """The rest pose of a garment that was posed by `eslr fit` is not the shape that it was sewn in."""
    garment, material, inputs = scene
    rest = np.asarray(garment.rest_positions)
    posed = garment.replace(rest_positions=garment.rest_positions * 1.3)
    graph = build(GRADIENT, (posed, material, inputs.replace(position=garment.sewn_positions)))
    np.testing.assert_allclose(graph.edges["mesh"][:, 7], 0.0, atol=1e-4)
    sewn = rest[garment.senders] - rest[garment.receivers]
    spacing = np.linalg.norm(sewn, axis=1).mean()
    np.testing.assert_allclose(graph.edges["mesh"][:, 3:6], np.clip(sewn / spacing, -5, 5), atol=1e-5)


def test_thicker_sheets_are_stiffer_to_the_network_and_no_input_is_larger_than_promised(scene):
    garment, material, inputs = scene
    thick = material.replace(thickness=material.thickness * 2.0)
    stiff = material.replace(lame_mu=material.lame_mu * 2.0, lame_lambda=material.lame_lambda * 2.0)
    rows = [build(GRADIENT, (garment, fabric, inputs)).nodes["garment"] for fabric in (thick, stiff)]
    np.testing.assert_allclose(*rows, atol=1e-6)
    hard = material.replace(lame_lambda=material.lame_lambda * 100.0)
    assert float(jnp.abs(build(GRADIENT, (garment, hard, inputs)).nodes["garment"]).max()) <= 5.0


def test_hoods_world_edges_join_what_is_near_now(scene):
    """A contact of thrown cloth is measured on its path; its body point may be half a metre ahead."""
    garment, material, inputs = scene
    ahead = inputs.contacts.replace(
        points=inputs.contacts.points + jnp.array([[0.5, 0.0, 0.0]]),
        distances=jnp.full_like(inputs.contacts.distances, 0.001),
    )
    graph = build(HOOD, (garment, material, inputs.replace(contacts=ahead)))
    assert not bool(graph.globals["world_mask"].any())
