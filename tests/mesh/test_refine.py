"""Refined meshes: still a manifold with the same boundary, on the same surface."""

import numpy as np
import pytest
import trimesh
from cloth import make_sheet

from eslr_jax.mesh.topology import face_areas, unique_edges
from eslr_jax.pipeline.dressing.remesh import refine


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
