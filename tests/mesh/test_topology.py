"""Tables against brute force on small meshes, in the words of the definitions."""

import numpy as np
import pytest

from eslr_jax.mesh import topology


def sides(faces):
    return [
        (face[k], face[(k + 1) % 3], face[(k + 2) % 3], row)
        for row, face in enumerate(faces)
        for k in range(3)
    ]


def test_unique_edges_are_every_side_once(mesh):
    _, faces = mesh
    expected = sorted({(min(i, j), max(i, j)) for i, j, _, _ in sides(faces.tolist())})
    assert topology.unique_edges(faces).tolist() == [list(pair) for pair in expected]


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


def test_inverse_rest_frames_invert_the_rest_edges(mesh):
    positions, faces = mesh
    inverse = topology.inverse_rest_frames(positions, faces)
    corners = positions[faces]
    edges = np.stack([corners[:, 0] - corners[:, 2], corners[:, 1] - corners[:, 2]], axis=-1)
    deformation = edges @ inverse  # of the rest state: an isometry of the plane
    np.testing.assert_allclose(
        np.swapaxes(deformation, 1, 2) @ deformation, np.eye(2)[None] + 0 * inverse, atol=1e-10
    )
    areas = topology.face_areas(positions, faces)
    np.testing.assert_allclose(np.linalg.det(inverse), 0.5 / areas, rtol=1e-10)


def test_vertex_areas_share_face_areas(mesh):
    positions, faces = mesh
    areas = topology.face_areas(positions, faces)
    shared = topology.vertex_areas(areas, faces, len(positions))
    expected = [
        sum(areas[row] / 3 for row, face in enumerate(faces) if v in face) for v in range(len(positions))
    ]
    np.testing.assert_allclose(shared, expected, rtol=1e-12)


def test_vertex_normals_of_an_octahedron_point_along_its_corners(builders):
    positions, faces = builders.octahedron()
    lone = np.concatenate([positions, [[3.0, 0.0, 0.0]]])
    normals = topology.vertex_normals(lone, faces)
    np.testing.assert_allclose(normals[:6], positions / 0.3, atol=1e-12)
    np.testing.assert_array_equal(normals[6], 0)


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
    assert topology.boundary_loops(builders.octahedron()[1]) == []


def test_components_are_counted(builders):
    _, faces = builders.sheet(3, 3)
    count, labels = topology.vertex_components(np.concatenate([faces, faces + 9]), 18)
    assert count == 2
    assert len(set(labels[:9])) == len(set(labels[9:])) == 1
