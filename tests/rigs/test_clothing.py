"""What a body wears in pictures: all of its surface once, shorts below the top, and nothing on head and limbs."""

import numpy as np
import pytest

from eslr_jax.pipeline.rigs.clothing import body_pieces


@pytest.fixture(scope="module")
def pieces(body):
    positions, faces = np.asarray(body.rest_positions), np.asarray(body.faces)
    return {piece.name: piece for piece in body_pieces(positions, faces, body)}


def area(points, faces):
    corners = points[faces]
    return (
        0.5
        * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    )


def test_pieces_are_the_body_s_surface(body, pieces):
    positions, faces = np.asarray(body.rest_positions, np.float64), np.asarray(body.faces)
    assert set(pieces) == {"skin", "top", "shorts"}
    total = sum(area(piece.place(positions).astype(float), piece.faces) for piece in pieces.values())
    assert total == pytest.approx(area(positions, faces), rel=1e-4)
    sides = {name: area(piece.place(positions), piece.faces) / total for name, piece in pieces.items()}
    assert 0.1 < sides["top"] < 0.35
    assert 0.1 < sides["shorts"] < 0.3


def test_head_hands_and_feet_are_bare(body, pieces):
    positions = np.asarray(body.rest_positions)
    joints = {name: np.asarray(body.joint_rest_positions)[k] for k, name in enumerate(body.joint_names)}
    top, shorts = (pieces[name].place(positions) for name in ("top", "shorts"))
    assert top[:, 1].max() < joints["Head"][1]
    assert abs(top[:, 0]).max() < joints["LeftForeArm"][0]
    assert top[:, 1].min() == pytest.approx(shorts[:, 1].max(), abs=1e-5)  # they meet at the waist
    assert shorts[:, 1].min() > joints["LeftLeg"][1]  # over the knees
    assert abs(shorts[:, 0]).max() < joints["LeftForeArm"][0]


def test_a_body_of_unknown_joints_is_all_skin(body):
    unknown = body.replace(joint_names=tuple(f"bone{k}" for k in range(len(body.joint_names))))
    (piece,) = body_pieces(np.asarray(body.rest_positions), np.asarray(body.faces), unknown)
    assert piece.name == "skin"
    np.testing.assert_array_equal(piece.place(body.rest_positions), np.asarray(body.rest_positions))
