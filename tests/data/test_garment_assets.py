"""The bundled garments are sound meshes, worn on the bundled body without touching it."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

DATA = Path(__file__).parents[2] / "data"
NUM_LOOPS = {
    "tshirt": 4, "tank": 4, "longsleeve": 4, "shorts": 3, "pants": 3,
    "dress": 4, "kneepants": 3, "shortsleeve": 4, "tightdress": 4,
}  # fmt: skip
NUM_VERTICES = {"1k": 1000, "4k": 4000, "10k": 10000}
PINNED = {"tank", "shorts", "pants", "dress", "kneepants", "tightdress"}
CASES = [
    pytest.param(name, level, marks=[pytest.mark.slow] if level != "1k" else [])
    for name in NUM_LOOPS
    for level in NUM_VERTICES
]
each_garment = pytest.mark.parametrize(("name", "level"), CASES)


@cache
def load_arrays(path: Path) -> dict[str, np.ndarray]:
    with np.load(path) as archive:
        return dict(archive)


def load_garment_arrays(name: str, level: str) -> dict[str, np.ndarray]:
    return load_arrays(DATA / "garments" / f"{name}_{level}.npz")


def directed_edges(faces: np.ndarray) -> np.ndarray:
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def edge_counts(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.unique(np.sort(directed_edges(faces), axis=1), axis=0, return_counts=True)


def count_parts(edges: np.ndarray, num_vertices: int) -> int:
    """Count the connected parts of the graph on the vertices that `edges` mentions."""
    graph = coo_matrix((np.ones(len(edges)), edges.T), shape=(num_vertices, num_vertices))
    labels = connected_components(graph, directed=False)[1]
    return len(np.unique(labels[np.unique(edges)]))


def distance_to_triangles(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return signed distances of points [N, 1, 3] to triangles [N, K, 3, 3], shape [N, K]."""
    following = np.roll(corners, -1, axis=2)
    along = following - corners
    offset = points[:, :, None] - corners
    t = np.clip((offset * along).sum(-1) / (along**2).sum(-1), 0.0, 1.0)
    to_edges = np.linalg.norm(offset - t[..., None] * along, axis=-1).min(axis=-1)
    normal = np.cross(along[:, :, 0], along[:, :, 1])
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    height = (offset[:, :, 0] * normal).sum(-1)
    inside = ((np.cross(along, offset) * normal[:, :, None]).sum(-1) >= 0).all(axis=-1)
    return np.where(inside, np.abs(height), to_edges) * np.where(height < 0, -1.0, 1.0)


def clearance(points: np.ndarray, body: dict[str, np.ndarray], candidates: int = 40) -> np.ndarray:
    """Return signed distances of points [N, 3] to the body [m], the closest of `candidates` near faces."""
    corners = body["rest_positions"].astype(float)[body["faces"]]
    nearest = cKDTree(corners.mean(axis=1)).query(points, k=candidates)[1]
    distance = distance_to_triangles(points[:, None], corners[nearest])
    return np.take_along_axis(distance, np.abs(distance).argmin(axis=1)[:, None], axis=1)[:, 0]


def test_clearance_of_a_box_is_the_height_above_its_faces():
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
    faces = np.array([[1, 5, 7], [1, 7, 3], [0, 2, 6], [0, 6, 4]])  # the faces z = 1 and z = 0, outward
    box = {"rest_positions": corners, "faces": faces}
    points = np.array([[0.3, 0.4, 1.2], [0.6, 0.2, 0.9], [0.5, 0.5, -0.3], [2.0, 0.5, 1.0]])
    np.testing.assert_allclose(clearance(points, box, candidates=4), [0.2, -0.1, 0.3, 1.0], atol=1e-12)


@each_garment
def test_garment_arrays_have_the_documented_types(name, level):
    garment = load_garment_arrays(name, level)
    num_vertices = len(garment["rest_positions"])
    assert abs(num_vertices / NUM_VERTICES[level] - 1.0) < 0.05
    expected = {
        "rest_positions": ((num_vertices, 3), np.float32),
        "faces": ((len(garment["faces"]), 3), np.int32),
        "skin_weights": ((num_vertices, 4), np.float32),
        "skin_indices": ((num_vertices, 4), np.int16),
        "pinned": ((num_vertices,), np.bool_),
    }
    assert {key: (array.shape, array.dtype.type) for key, array in garment.items()} == expected
    assert np.isfinite(garment["rest_positions"]).all()


@each_garment
def test_garment_is_one_manifold_sheet_with_its_openings(name, level):
    garment = load_garment_arrays(name, level)
    faces, num_vertices = garment["faces"], len(garment["rest_positions"])
    edges, counts = edge_counts(faces)
    boundary = edges[counts == 1]
    assert counts.max() == 2
    assert len(np.unique(directed_edges(faces), axis=0)) == 3 * len(faces)  # neighbours agree on orientation
    assert np.array_equal(np.unique(faces), np.arange(num_vertices))
    assert count_parts(edges, num_vertices) == 1
    assert set(np.bincount(boundary.ravel())) <= {0, 2}
    assert count_parts(boundary, num_vertices) == NUM_LOOPS[name]
    assert num_vertices - len(edges) + len(faces) == 2 - NUM_LOOPS[name]  # a sphere with holes


@each_garment
def test_garment_triangles_are_even(name, level):
    garment = load_garment_arrays(name, level)
    positions, faces = garment["rest_positions"].astype(float), garment["faces"]
    edges, _ = edge_counts(faces)
    length = np.linalg.norm(positions[edges[:, 0]] - positions[edges[:, 1]], axis=1)
    assert length.std() / length.mean() < 0.2
    along = positions[np.roll(faces, -1, axis=1)] - positions[faces]
    along /= np.linalg.norm(along, axis=2, keepdims=True)
    cosine = -(along * np.roll(along, 1, axis=1)).sum(axis=2)
    assert np.degrees(np.arccos(cosine.max())) > 15.0


@each_garment
def test_garment_faces_outward_and_clears_the_body(name, level):
    garment, body = load_garment_arrays(name, level), load_arrays(DATA / "body" / "anny_cmu.npz")
    positions, faces = garment["rest_positions"].astype(float), garment["faces"]
    sample = np.random.default_rng(0).choice(len(faces), 150, replace=False)
    corners = positions[faces[sample]]
    centres = corners.mean(axis=1)
    assert clearance(np.concatenate([corners[:, 0], centres]), body).min() > 0.003
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    rise = clearance(centres + 0.002 * normal, body) - clearance(centres, body)
    assert np.mean(rise > 0.0) > 0.9  # cloth in the crotch and under the arms may face another limb


@each_garment
def test_garment_skin_weights_are_convex(name, level):
    garment, body = load_garment_arrays(name, level), load_arrays(DATA / "body" / "anny_cmu.npz")
    assert (garment["skin_weights"] >= 0.0).all()
    np.testing.assert_array_equal(garment["skin_weights"].sum(axis=1), 1.0)
    assert garment["skin_indices"].min() >= 0
    assert garment["skin_indices"].max() < len(body["joint_names"])


@each_garment
def test_garment_pins_hold_the_top_of_both_sides(name, level):
    garment = load_garment_arrays(name, level)
    pinned, positions = garment["pinned"], garment["rest_positions"]
    if name not in PINNED:
        assert not pinned.any()
        return
    assert 0.002 < pinned.mean() < 0.12
    assert (positions[pinned, 0] > 0.05).any()
    assert (positions[pinned, 0] < -0.05).any()
    assert positions[pinned, 1].min() >= positions[~pinned, 1].max()


@pytest.mark.slow
@pytest.mark.parametrize("name", list(NUM_LOOPS))
def test_garment_levels_share_one_shape(name):
    coarse, fine = load_garment_arrays(name, "4k"), load_garment_arrays(name, "10k")
    distance = cKDTree(fine["rest_positions"]).query(coarse["rest_positions"])[0]
    edges, _ = edge_counts(fine["faces"])
    spacing = np.linalg.norm(np.diff(fine["rest_positions"][edges], axis=1), axis=-1).mean()
    assert distance.max() < spacing


def test_garments_stay_small():
    assert sum(path.stat().st_size for path in (DATA / "garments").glob("*.npz")) < 4.5e6
