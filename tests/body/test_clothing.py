"""What a body wears in pictures: all of its surface once, shorts below the top, and nothing on head and limbs."""

import numpy as np
import pytest

from eslr_jax.body.clothing import SHORTS, SKIN, TOP, body_layers


@pytest.fixture(scope="module")
def layers(body):
    positions, faces = np.asarray(body.rest_positions), np.asarray(body.faces)
    return {layer.kind: layer for layer in body_layers(positions, faces, body)}


def area(points, faces):
    corners = points[faces]
    return (
        0.5
        * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    )


def test_layers_are_the_body_s_surface(body, layers):
    positions, faces = np.asarray(body.rest_positions, np.float64), np.asarray(body.faces)
    assert set(layers) == {SKIN, TOP, SHORTS}
    total = sum(area(layer.place(positions).astype(float), layer.faces) for layer in layers.values())
    assert total == pytest.approx(area(positions, faces), rel=1e-4)
    sides = [area(layer.place(positions), layer.faces) / total for layer in layers.values()]
    assert 0.1 < sides[TOP] < 0.35
    assert 0.1 < sides[SHORTS] < 0.3


def test_head_hands_and_feet_are_bare(body, layers):
    positions = np.asarray(body.rest_positions)
    joints = {name: np.asarray(body.joint_rest_positions)[k] for k, name in enumerate(body.joint_names)}
    top, shorts = (layers[kind].place(positions) for kind in (TOP, SHORTS))
    assert top[:, 1].max() < joints["Head"][1]
    assert abs(top[:, 0]).max() < joints["LeftForeArm"][0]
    assert top[:, 1].min() == pytest.approx(shorts[:, 1].max(), abs=1e-5)  # they meet at the waist
    assert shorts[:, 1].min() > joints["LeftLeg"][1]  # over the knees
    assert abs(shorts[:, 0]).max() < joints["LeftForeArm"][0]


def test_a_body_of_unknown_joints_is_all_skin(body):
    unknown = body.replace(joint_names=tuple(f"bone{k}" for k in range(len(body.joint_names))))
    (layer,) = body_layers(np.asarray(body.rest_positions), np.asarray(body.faces), unknown)
    assert layer.kind == SKIN
    np.testing.assert_array_equal(layer.place(body.rest_positions), np.asarray(body.rest_positions))
