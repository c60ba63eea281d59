"""Distances against closed forms and against an exact solver."""

import numpy as np
import pytest

from eslr_jax import ConfigError
from eslr_jax.mesh.closest import closest_points
from eslr_jax.mesh.geodesic import (
    farthest_point_landmarks,
    geodesic_distances,
    geodesic_embedding,
    geodesic_graph,
    unfolded_shortcuts,
)
from eslr_jax.mesh.topology import unique_edges
from eslr_jax.pipeline.assets import asset_names, load_garment_file


def load(name, vertices):
    garment = load_garment_file(name, vertices=vertices)
    return garment.rest_positions, garment.faces


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
    positions, faces = builders.sheet(7, 7, jitter=0.2)
    positions[:, 1] = 0
    pairs, lengths = unfolded_shortcuts(positions, faces)
    straight = np.linalg.norm(positions[pairs[:, 0]] - positions[pairs[:, 1]], axis=1)
    np.testing.assert_allclose(lengths, straight, rtol=1e-12)
    assert {tuple(pair) for pair in pairs.tolist()} == {tuple(pair) for pair in pairs[:, ::-1].tolist()}


def test_distances_do_not_change_along_a_fold(builders):
    positions, faces = builders.sheet(5, 6)
    behind = np.maximum(positions[:, 0] - 0.2, 0)  # folded by a right angle along the third column
    folded = np.stack([np.minimum(positions[:, 0], 0.2), behind, positions[:, 2]], axis=1)
    flat, bent = (geodesic_distances(geodesic_graph(p, faces), np.arange(30)) for p in (positions, folded))
    np.testing.assert_allclose(bent, flat, atol=1e-12)


@pytest.mark.parametrize("shape", [(20, 20), (32, 12)])
def test_distances_on_a_tube_are_exact_within_tolerance(builders, shape):
    errors = relative_errors(*builders.tube(*shape))
    assert errors.min() > -1e-9  # a path on the surface is never shorter than the shortest
    assert np.abs(errors).mean() < 0.025


def test_distances_on_a_garment_are_exact_within_tolerance():
    positions, faces = load("tshirt", "1k")
    errors = relative_errors(positions.astype(float), faces)
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
    graph = geodesic_graph(*builders.icosahedron())
    landmarks, _ = farthest_point_landmarks(graph, 100)
    assert sorted(landmarks) == list(range(12))


def test_components_are_bridged_at_their_nearest_vertices(builders):
    positions, faces = builders.sheet(3, 3)
    gap = np.array([0.35, 0.0, 0.0])  # the sheet is 0.2 wide: 0.15 between neighbours
    three = np.concatenate([positions, positions + 2 * gap, positions + gap])
    graph = geodesic_graph(three, np.concatenate([faces, faces + 9, faces + 18]))
    distances = geodesic_distances(graph, np.arange(27))
    assert np.isfinite(distances).all()
    np.testing.assert_allclose(distances[0, 9 + 2], 0.9)  # straight through the corners of all three


# --- what an embedding must keep: geodesic distances, and its coordinates under renumbering and remeshing

MODES = ["raw", "canonical", "landmarks"]


def stress(positions, faces, embedding):
    """Kruskal's stress-1 over pairs with 100 random vertices."""
    sources = np.random.default_rng(1).integers(0, len(positions), 100)
    target = geodesic_distances(geodesic_graph(positions, faces), sources)
    found = np.linalg.norm(embedding[sources][:, None] - embedding[None], axis=-1)
    return np.sqrt(np.sum((found - target) ** 2) / np.sum(target**2))


def mismatch(fine, coarse, **options):
    """Distance between the embeddings of two meshes at equal points over the embedding's size, both RMS."""
    embedding = geodesic_embedding(*fine, **options)
    other = geodesic_embedding(*coarse, **options)
    face, barycentric = closest_points(fine[0], *coarse)
    matched = np.einsum("vc,vce->ve", barycentric, other[coarse[1][face]])
    size = np.sqrt(np.sum((embedding - embedding.mean(axis=0)) ** 2, axis=1).mean())
    return np.sqrt(np.sum((embedding - matched) ** 2, axis=1).mean()) / size


@pytest.mark.parametrize("mode", ["raw", "canonical"])
def test_stress_on_a_tube(builders, mode):
    tube = builders.tube(32, 32)
    assert stress(*tube, geodesic_embedding(*tube, size=8, mode=mode)) <= 0.08


def test_flat_sheet_embeds_isometrically(builders):
    sheet = builders.sheet(12, 12, jitter=0.2)
    sheet[0][:, 1] = 0
    assert stress(*sheet, geodesic_embedding(*sheet, size=8)) < 0.02


@pytest.mark.parametrize("mode", ["canonical", "landmarks"])  # rounding alone turns the axes of `raw`
def test_renumbering_vertices_permutes_rows_and_translation_changes_nothing(builders, mode):
    positions, faces = builders.tube(20, 15, flare=0.2, depth=0.8, twist=0.3)
    permuted, permuted_faces, old = builders.permute(positions + np.array([0.1, 1.0, -0.3]), faces)
    embedding = geodesic_embedding(positions, faces, mode=mode)
    again = geodesic_embedding(permuted, permuted_faces, mode=mode)
    # ties between equally far landmarks may be broken otherwise; nothing else may change
    np.testing.assert_allclose(again, embedding[old], atol=0.02 * np.abs(embedding).max())


@pytest.mark.parametrize("mode", ["canonical", "landmarks"])
def test_two_meshes_of_a_tube_agree(builders, mode):
    fine = builders.tube(48, 40, flare=0.2, depth=0.8, twist=1.0)
    coarse = builders.tube(28, 22, flare=0.2, depth=0.8)
    assert mismatch(fine, coarse, mode=mode) <= 0.08


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["canonical", "landmarks"])
def test_two_meshes_of_every_garment_agree(mode):
    for name in {name.rsplit("_", 1)[0] for name in asset_names("garment")}:
        assert mismatch(load(name, "4k"), load(name, "1k"), mode=mode) <= 0.08, name


def test_canonical_axes_follow_the_rest_pose(builders):
    positions, faces = builders.tube(24, 20, flare=0.2, depth=0.8)
    embedding = geodesic_embedding(positions, faces)
    for axis in range(3):
        assert np.corrcoef(embedding[:, axis], positions[:, axis])[0, 1] > 0.95


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("size", [2, 8, 16])
def test_any_size_on_a_tiny_mesh(builders, mode, size):
    embedding = geodesic_embedding(*builders.icosahedron(), size=size, mode=mode)
    assert embedding.shape == (12, size)
    assert embedding.dtype == np.float64
    assert np.isfinite(embedding).all()


@pytest.mark.parametrize("mode", MODES)
def test_components_get_finite_coordinates(builders, mode):
    positions, faces = builders.sheet(6, 6)
    both = np.concatenate([positions, positions + np.array([0.0, 0.3, 0.0])])
    embedding = geodesic_embedding(both, np.concatenate([faces, faces + 36]), mode=mode)
    assert np.isfinite(embedding).all()


def test_landmark_coordinates_fall_with_the_distance_to_a_corner(builders):
    positions, faces = builders.sheet(6, 8)
    nearest_corner = geodesic_embedding(positions, faces, mode="landmarks")[:, 0]
    distances = np.linalg.norm(positions - positions.min(axis=0), axis=1)
    np.testing.assert_allclose(nearest_corner, 0.4 * np.exp(-distances / 0.4), rtol=0.03)  # Dijkstra's error


def test_unknown_mode_is_named(builders):
    with pytest.raises(ConfigError, match="'polar' is unknown; use one of raw, canonical, landmarks"):
        geodesic_embedding(*builders.tube(), mode="polar")
