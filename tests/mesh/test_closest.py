"""Closest points against dense sampling, and the skin weights taken from them."""

import numpy as np
import pytest
from scipy.optimize import nnls

from eslr_jax.mesh.closest import barycentric_of_closest, closest_points
from eslr_jax.mesh.skinning import smooth, transfer_skin_weights
from eslr_jax.pipeline.assets import load_garment_file


def test_closest_point_solves_the_constrained_least_squares():
    random = np.random.default_rng(0)
    points, triangles = random.normal(size=(200, 3)), random.normal(size=(200, 3, 3))
    found = barycentric_of_closest(points, triangles)
    np.testing.assert_allclose(found.sum(axis=1), 1, atol=1e-12)
    assert found.min() >= -1e-12
    distance = np.linalg.norm(np.einsum("pc,pcx->px", found, triangles) - points, axis=1)
    for point, triangle, gap in zip(points, triangles, distance, strict=True):
        heavy = 1e4  # weight of the constraint that the coordinates sum to one
        _, residual = nnls(np.vstack([triangle.T, heavy * np.ones(3)]), np.append(point, heavy))
        np.testing.assert_allclose(gap, residual, rtol=1e-4)


@pytest.mark.parametrize("num_candidates", [1, 4, 1000])
def test_closest_face_is_exact_for_any_number_of_candidates(builders, num_candidates):
    random = np.random.default_rng(1)
    positions, faces = builders.tube(11, 4)  # long thin faces: nearest centroids mislead
    points = random.uniform(-0.4, 0.8, (60, 3))
    face, barycentric = closest_points(points, positions, faces, num_candidates=num_candidates)
    found = np.linalg.norm(np.einsum("pc,pcx->px", barycentric, positions[faces[face]]) - points, axis=1)
    every = barycentric_of_closest(points[:, None], positions[faces][None])
    gaps = np.linalg.norm(np.einsum("pfc,fcx->pfx", every, positions[faces]) - points[:, None], axis=2)
    np.testing.assert_allclose(found, gaps.min(axis=1), atol=1e-12)


def test_weights_of_a_garment_on_the_body_are_the_bodys(builders):
    positions, faces = builders.tube(16, 12)
    share = np.clip(positions[:, 1] / 0.6, 0, 1)
    weights, indices = np.stack([share, 1 - share], axis=1), np.tile([3, 7], (len(positions), 1))
    found, joints = transfer_skin_weights(
        positions * [1.05, 1, 1.05], positions, faces, weights, indices, faces=faces, smoothing_steps=0
    )
    dense = np.zeros((len(positions), 8))
    np.put_along_axis(dense, joints, found, axis=1)
    np.testing.assert_allclose(dense[:, 3], share, atol=1e-6)
    np.testing.assert_allclose(found.sum(axis=1), 1, atol=1e-12)
    assert joints.dtype == np.int32
    assert found.shape == joints.shape == (len(positions), 4)


def test_smoothing_keeps_constants_and_softens_a_jump(builders):
    positions, faces = builders.tube(16, 12)
    constant = np.ones((len(positions), 2))
    np.testing.assert_allclose(smooth(constant, faces, 7), constant)
    jump = (positions[:, :1] > 0).astype(float)
    soft = smooth(jump, faces, 20)
    assert soft.min() >= 0
    assert soft.max() <= 1
    assert np.abs(np.diff(soft[:, 0].reshape(12, 16), axis=1)).max() < 0.4


def test_bundled_garment_weights_are_recovered(body):
    shirt = load_garment_file("tshirt")
    found, joints = transfer_skin_weights(
        np.asarray(shirt.rest_positions),
        np.asarray(body.rest_positions),
        np.asarray(body.faces),
        np.asarray(body.skin_weights),
        np.asarray(body.skin_indices),
        faces=shirt.faces,
    )
    ours, theirs = np.zeros((2, len(found), len(body.joint_names)))
    np.put_along_axis(ours, joints, found, axis=1)
    np.add.at(theirs, (np.arange(len(found))[:, None], shirt.skin_indices), shirt.skin_weights)
    # Of at most two; the bundled ones are smoothed more.
    assert np.abs(ours - theirs).sum(axis=1).mean() < 0.4
