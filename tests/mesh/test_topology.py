"""Tables against brute force on small meshes; areas and frames have the oracles of the energies."""

import numpy as np
import pytest
import trimesh
from cloth import make_sheet
from reference_models import make_scene

from eslr_jax.mesh import topology
from eslr_jax.mesh.coarse import add_coarse_edges, coarsen
from eslr_jax.mesh.topology import face_areas, unique_edges
from eslr_jax.pipeline.dressing.remesh import refine


def sides(faces):
    return [
        (face[k], face[(k + 1) % 3], face[(k + 2) % 3], row)
        for row, face in enumerate(faces)
        for k in range(3)
    ]


def test_directed_edges_are_sorted_and_reversed(mesh):
    _, faces = mesh
    senders, receivers, reverse = topology.directed_edges(topology.unique_edges(faces))
    pairs = list(zip(receivers.tolist(), senders.tolist(), strict=True))
    assert pairs == sorted({(j, i) for i, j, _, _ in sides(faces)} | {(i, j) for i, j, _, _ in sides(faces)})
    np.testing.assert_array_equal(senders[reverse], receivers)
    np.testing.assert_array_equal(receivers[reverse], senders)


def test_neighbor_table_lists_each_neighbor_once(mesh):
    positions, faces = mesh
    senders, receivers, _ = topology.directed_edges(topology.unique_edges(faces))
    table, mask = topology.neighbor_table(senders, receivers, len(positions))
    for vertex in range(len(positions)):
        expected = sorted(
            {j for i, j, _, _ in sides(faces) if i == vertex}
            | {i for i, j, _, _ in sides(faces) if j == vertex}
        )
        assert table[vertex, mask[vertex]].tolist() == expected
        assert (table[vertex, ~mask[vertex]] == vertex).all()
    assert mask.any(axis=0).all()


@pytest.mark.parametrize("of", ["faces", "hinges"])
def test_incidence_table_lists_flat_positions(mesh, of):
    positions, faces = mesh
    items = faces if of == "faces" else topology.find_hinges(faces)[0]
    table = topology.incidence_table(items, len(positions))
    for vertex in range(len(positions)):
        expected = np.flatnonzero(items.T.ravel() == vertex).tolist()
        assert table[vertex, : len(expected)].tolist() == expected
        assert (table[vertex, len(expected) :] == items.size).all()


def test_hinges_are_interior_edges_in_face_orientation(mesh):
    _, faces = mesh
    hinges, hinge_faces = topology.find_hinges(faces)
    by_side = {(i, j): (k, row) for i, j, k, row in sides(faces.tolist())}
    expected = sorted(
        (i, j, by_side[i, j][0], by_side[j, i][0]) for i, j in by_side if (j, i) in by_side and i < j
    )
    assert hinges.tolist() == [list(hinge) for hinge in expected]
    for (i, j, _, _), (left, right) in zip(hinges.tolist(), hinge_faces.tolist(), strict=True):
        assert by_side[i, j][1] == left
        assert by_side[j, i][1] == right


def test_vertex_normals_of_an_icosahedron_point_along_its_corners(builders):
    positions, faces = builders.icosahedron()
    lone = np.concatenate([positions, [[3.0, 0.0, 0.0]]])
    normals = topology.vertex_normals(lone, faces)
    np.testing.assert_allclose(normals[:-1], positions / 0.3, atol=1e-12)
    np.testing.assert_array_equal(normals[-1], 0)


def test_undirected_edges_count_faces_of_a_broken_mesh():
    edges, edge_of, counts = topology.undirected_edges(np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]]))
    shared = edges.tolist().index([0, 1])
    assert counts[shared] == 3
    assert np.flatnonzero(edge_of == shared).tolist() == [0, 3, 6]
    assert np.delete(counts, shared).tolist() == [1] * 6


def test_boundary_loops_are_ordered_cycles(builders):
    _, faces = builders.tube(9, 4)
    loops = topology.boundary_loops(faces)
    sides_of_mesh = {(i, j) for i, j, _, _ in sides(faces.tolist())}
    assert [len(loop) for loop in loops] == [9, 9]
    for loop in loops:
        assert all((i, j) in sides_of_mesh for i, j in zip(loop, np.roll(loop, -1), strict=True))
        assert loop[0] == loop.min()
    assert topology.boundary_loops(builders.icosahedron()[1]) == []


# --- refined meshes: still a manifold with the same boundary, on the same surface ---------------------------


@pytest.mark.parametrize("scheme", ["t", "q", "tq"])
def test_a_refined_sheet_is_flat_and_covers_the_same_area(scheme):
    positions, faces = make_sheet(7, 9, 0.1, jitter=0)
    finer = refine(faces, len(positions), scheme)
    points = finer.smooth @ positions
    assert len(finer.faces) == len(finer.parents)
    growth = {"t": 3, "q": 4}
    assert len(finer.faces) == len(faces) * np.prod([growth[letter] for letter in scheme])
    sides = np.sort(np.concatenate([finer.faces[:, [k, (k + 1) % 3]] for k in range(3)]), axis=1)
    assert np.unique(sides, axis=0, return_counts=True)[1].max() == 2
    directed = np.concatenate([finer.faces[:, [k, (k + 1) % 3]] for k in range(3)])
    assert len(np.unique(directed, axis=0)) == len(directed), "all faces turn the same way"
    assert len(points) - len(unique_edges(finer.faces)) + len(finer.faces) == 1
    np.testing.assert_allclose(points[:, 1], positions[0, 1], atol=1e-12)
    area = face_areas(points, finer.faces)
    assert (area > 0).all()
    # Corners of the boundary are rounded, by less than a coarse face.
    np.testing.assert_allclose(area.sum(), face_areas(positions, faces).sum(), atol=0.006)


def test_a_refined_ball_stays_round_and_attributes_are_interpolated():
    ball = trimesh.creation.icosphere(subdivisions=2, radius=1.0)
    finer = refine(ball.faces, len(ball.vertices), "tq")
    radius = np.linalg.norm(finer.smooth @ ball.vertices, axis=1)
    assert np.ptp(radius) < 0.01
    for matrix in (finer.smooth, finer.linear):
        np.testing.assert_allclose(matrix.sum(axis=1), 1.0, atol=1e-12)
    old = finer.linear[: len(ball.vertices)]
    np.testing.assert_array_equal(old.toarray(), np.eye(len(ball.vertices)))
    centroid, coarse = (finer.linear @ ball.vertices)[finer.faces].mean(axis=1), ball.triangles_center
    assert np.linalg.norm(centroid - coarse[finer.parents], axis=1).max() < 0.35, "near its parent"


# --- coarse levels of small graphs whose levels can be drawn by hand ----------------------------------------


def path(count):
    return np.stack([np.arange(count - 1), np.arange(1, count)], axis=1)


def test_every_level_of_a_path_keeps_every_other_vertex():
    levels = coarsen(path(9), 9)  # the centre is vertex 4
    np.testing.assert_array_equal(levels[0], [[0, 2], [2, 4], [4, 6], [6, 8]])
    np.testing.assert_array_equal(levels[1], [[0, 4], [4, 8]])
    assert len(levels[2]) == 0  # the ends are at one hop and have no farther neighbours


def test_components_are_coarsened_alone():
    both = np.concatenate([path(5), path(5) + 5])
    level = coarsen(both, 10)[0]
    np.testing.assert_array_equal(level, [[0, 2], [2, 4], [5, 7], [7, 9]])


@pytest.mark.parametrize("count", [9, 10])
def test_a_ring_is_closed_again(count):
    """Opposite the centre of nine, two kept neighbours meet; of ten, one is removed between two kept ones."""
    ring = np.concatenate([path(count), [[count - 1, 0]]])
    level = coarsen(ring, count)[0]
    np.testing.assert_array_equal(np.unique(level, return_counts=True)[1], [2, 2, 2, 2, 2])


@pytest.mark.parametrize("pad", [False, True])
def test_coarse_edges_are_directed_sorted_and_paired(pad):
    garment = add_coarse_edges(make_scene(8, 6, pad=pad)[0])
    kept = np.count_nonzero(garment.vertex_mask)
    for level in garment.coarse:
        assert (np.diff(level.receivers) >= 0).all()
        np.testing.assert_array_equal(level.senders[level.reverse_edges], level.receivers)
        np.testing.assert_array_equal(
            np.flatnonzero(level.is_kept), np.unique(level.senders[level.edge_mask])
        )
        assert np.count_nonzero(level.is_kept) <= 0.6 * kept
        kept = np.count_nonzero(level.is_kept)
    assert bool(pad) == (not garment.coarse[0].edge_mask.all())
