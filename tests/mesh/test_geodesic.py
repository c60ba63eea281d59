"""Distances against closed forms and against an exact solver."""

import numpy as np
import pytest

from eslr_jax.mesh.geodesic import (
    farthest_point_landmarks,
    geodesic_distances,
    geodesic_graph,
    unfolded_shortcuts,
)
from eslr_jax.mesh.topology import unique_edges


def relative_errors(positions, faces, num_sources=5):
    exact_solver = pytest.importorskip("pygeodesic.geodesic", reason="extra dev")
    sources = np.random.default_rng(0).integers(0, len(positions), num_sources)
    solver = exact_solver.PyGeodesicAlgorithmExact(positions, faces.astype(np.int32))
    exact = np.array([solver.geodesicDistances(np.array([source]), None)[0] for source in sources])
    distances = geodesic_distances(geodesic_graph(positions, faces), sources)
    away = exact > 0
    return (distances[away] - exact[away]) / exact[away]


def test_graph_is_symmetric_and_holds_every_edge(mesh):
    positions, faces = mesh
    graph = geodesic_graph(positions, faces)
    assert abs(graph - graph.T).max() == 0
    edges = unique_edges(faces)
    lengths = np.linalg.norm(positions[edges[:, 0]] - positions[edges[:, 1]], axis=1)
    assert (graph.toarray()[edges[:, 0], edges[:, 1]] <= lengths + 1e-12).all()


def test_shortcuts_of_a_flat_sheet_are_straight_lines(builders):
    positions, faces = builders.sheet(7, 7, jitter=0.02)
    positions[:, 2] = 0
    pairs, lengths = unfolded_shortcuts(positions, faces)
    straight = np.linalg.norm(positions[pairs[:, 0]] - positions[pairs[:, 1]], axis=1)
    np.testing.assert_allclose(lengths, straight, rtol=1e-12)
    assert {tuple(pair) for pair in pairs.tolist()} == {tuple(pair) for pair in pairs[:, ::-1].tolist()}


def test_distances_do_not_change_along_a_fold(builders):
    positions, faces = builders.sheet(5, 6)
    behind = np.maximum(positions[:, 0] - 0.2, 0)  # folded by a right angle along the third column
    folded = np.stack([np.minimum(positions[:, 0], 0.2), positions[:, 1], behind], axis=1)
    flat, bent = (geodesic_distances(geodesic_graph(p, faces), np.arange(30)) for p in (positions, folded))
    np.testing.assert_allclose(bent, flat, atol=1e-12)


@pytest.mark.parametrize("shape", [(20, 20), (32, 12)])
def test_distances_on_a_tube_are_exact_within_tolerance(builders, shape):
    errors = relative_errors(*builders.tube(*shape))
    assert errors.min() > -1e-9  # a path on the surface is never shorter than the shortest
    assert np.abs(errors).mean() < 0.025


def test_distances_on_a_garment_are_exact_within_tolerance(garment_folder):
    with np.load(garment_folder / "tshirt_1k.npz") as arrays:
        errors = relative_errors(arrays["rest_positions"].astype(float), arrays["faces"])
    assert errors.min() > -1e-9
    assert errors.mean() < 0.006  # measured 0.0036


def test_landmarks_are_spread_and_their_rows_are_distances(builders):
    positions, faces = builders.tube(16, 12)
    graph = geodesic_graph(positions, faces)
    landmarks, distances = farthest_point_landmarks(graph, 12)
    assert len(set(landmarks)) == 12
    np.testing.assert_array_equal(distances, geodesic_distances(graph, landmarks))
    spread = distances[:, landmarks] + 10 * np.eye(12)
    assert spread.min() > distances.min(axis=0).max() * 0.99  # farthest point: cover radius <= packing radius


def test_more_landmarks_than_vertices_takes_all(builders):
    graph = geodesic_graph(*builders.octahedron())
    landmarks, _ = farthest_point_landmarks(graph, 100)
    assert sorted(landmarks) == list(range(6))


def test_components_are_bridged_at_their_nearest_vertices(builders):
    positions, faces = builders.sheet(3, 3)
    gap = np.array([0.35, 0.0, 0.0])  # the sheet is 0.2 wide: 0.15 between neighbours
    three = np.concatenate([positions, positions + 2 * gap, positions + gap])
    graph = geodesic_graph(three, np.concatenate([faces, faces + 9, faces + 18]))
    distances = geodesic_distances(graph, np.arange(27))
    assert np.isfinite(distances).all()
    np.testing.assert_allclose(distances[0, 9 + 2], 0.9)  # straight through the corners of all three
