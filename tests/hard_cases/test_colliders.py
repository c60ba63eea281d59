"""Analytic colliders against points whose distance is known and against brute force over triangles."""

import numpy as np
import pytest
from hard_cases.colliders import Capsule, Plane, RoundedCone, Sphere, triangle_distances

DOWN = np.array([0.0, -1.0, 0.0])
COLLIDERS = {
    "sphere": Sphere(np.array([0.1, 0.2, -0.1]), 0.25),
    "capsule": Capsule(np.array([-0.2, 0.0, 0.1]), np.array([0.3, 0.1, 0.0]), 0.06),
    "plane": Plane(np.array([0.0, 0.1, 0.0]), np.array([0.6, 0.8, 0.0])),
    "cone": RoundedCone(np.array([0.0, 0.3, 0.0]), DOWN, np.radians(15.0), 2e-3),
}


@pytest.fixture(params=COLLIDERS)
def collider(request):
    return COLLIDERS[request.param]


def numerical_gradient(collider, points, step=1e-6):
    steps = step * np.eye(3)
    return np.stack(
        [(collider.distance(points + s) - collider.distance(points - s)) / (2 * step) for s in steps], axis=-1
    )


def test_distance_is_euclidean_and_leads_to_the_surface(collider):
    points = np.random.default_rng(0).normal(scale=0.4, size=(400, 3))
    distance = collider.distance(points)
    points, distance = points[distance > 1e-3], distance[distance > 1e-3]
    gradient = numerical_gradient(collider, points)
    np.testing.assert_allclose(np.linalg.norm(gradient, axis=1), 1.0, atol=1e-6)
    np.testing.assert_allclose(collider.distance(points - distance[:, None] * gradient), 0.0, atol=1e-8)


def test_distance_of_known_points():
    assert COLLIDERS["sphere"].distance(np.array([0.1, 0.2, -0.1])) == -0.25
    assert COLLIDERS["capsule"].distance(np.array([-0.2, 0.0, 0.1])) == -0.06
    assert COLLIDERS["plane"].distance(np.zeros(3)) == pytest.approx(-0.08)
    cone = COLLIDERS["cone"]
    assert cone.distance(np.array([0.0, 0.302, 0.0])) == pytest.approx(0.0, abs=1e-15)
    on_axis = -0.1 * np.sin(np.radians(15.0)) - 2e-3  # 10 cm below the apex
    assert cone.distance(np.array([0.0, 0.2, 0.0])) == pytest.approx(on_axis)


def test_triangle_distance_is_the_least_over_a_dense_sampling(collider):
    random = np.random.default_rng(1)
    corners = random.normal(scale=0.2, size=(60, 1, 3)) + random.normal(scale=0.06, size=(60, 3, 3))
    i, j = np.meshgrid(np.arange(121), np.arange(121), indexing="ij")
    i, j = i[i + j <= 120], j[i + j <= 120]
    weights = np.stack([i, j, 120 - i - j], axis=-1) / 120
    dense = collider.distance(np.einsum("sk,fkx->fsx", weights, corners)).min(axis=1)
    found = triangle_distances(collider, corners)
    assert np.all(found <= dense + 1e-5)
    np.testing.assert_allclose(found, dense, atol=1e-3)  # half the spacing of the samples


def test_triangle_distance_sees_a_tip_between_vertices():
    cone = RoundedCone(np.zeros(3), DOWN, np.radians(10.0), 2e-3)
    corners = np.array([[[-0.05, -0.01, -0.03], [0.05, -0.01, -0.03], [0.0, -0.01, 0.06]]])
    assert cone.distance(corners).min() > 0.02
    assert triangle_distances(cone, corners)[0] == pytest.approx(
        -0.01 * np.sin(np.radians(10)) - 2e-3, abs=1e-6
    )
