"""The referee on constructed intersections."""

import numpy as np
import pytest

from eslr_jax.evaluation.referee import Referee

pytest.importorskip("ipctk")


def sheet(size=5, spacing=0.1):
    index = np.arange(size * size).reshape(size, size)
    u = (np.arange(size) - (size - 1) / 2) * spacing
    x, z = np.meshgrid(u, u, indexing="ij")
    positions = np.stack([x.ravel(), np.zeros(size * size), z.ravel()], axis=1)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    return positions, np.concatenate([np.stack([a, d, c], 1), np.stack([a, c, b], 1)])


TRIANGLE = np.array([[0.0, -0.05, 0.01], [0.02, 0.05, 0.01], [-0.02, 0.05, 0.03]])  # stands upright


def two_layers(other):
    positions, faces = sheet()
    return np.concatenate([positions, other]), np.concatenate([faces, [[25, 26, 27]]])


def test_flat_and_folded_cloth_is_clean():
    positions, faces = sheet()
    referee = Referee(faces, 25)
    assert referee.judge(positions).cloth_cloth == 0
    angle = positions[:, 0] / 0.1  # rolled up to less than a turn
    rolled = np.stack([0.1 * np.sin(angle), 0.1 * np.cos(angle), positions[:, 2]], axis=1)
    assert referee.judge(rolled).cloth_cloth == 0


def test_piercing_triangle_is_counted_and_lifted_one_is_not():
    positions, faces = two_layers(TRIANGLE)
    referee = Referee(faces, 28)
    pairs = referee.intersecting_pairs(positions)
    assert len(pairs) > 0
    assert np.all(pairs[:, 1] == 32)  # all with the piercing triangle
    positions[25:, 1] += 0.0501
    assert referee.judge(positions).cloth_cloth == 0


def test_folding_over_counts_every_crossing_pair():
    positions, faces = sheet(3)
    positions[:3, 0] = 0.15  # the first row swings over to the other side and through it
    positions[:3, 1] = [-0.05, 0.05, -0.05]
    positions[3:6, 1] = 0.1
    assert Referee(faces, 9).judge(positions).cloth_cloth > 0


def test_body_pairs_are_told_from_cloth_pairs():
    positions, faces = sheet()
    referee = Referee(faces, 25, np.array([[0, 1, 2]]), 3)
    verdict = referee.judge(positions, TRIANGLE)
    assert verdict.cloth_cloth == 0
    assert verdict.cloth_body > 0
    assert referee.judge(positions, TRIANGLE + np.array([0, 0.06, 0])).cloth_body == 0


def test_body_that_intersects_itself_is_no_matter():
    positions, faces = sheet()
    body = np.concatenate([positions, TRIANGLE]) + np.array([0, 1.0, 0])
    referee = Referee(faces, 25, np.concatenate([faces, [[25, 26, 27]]]), 28)
    assert referee.judge(positions, body).cloth_body == 0


def test_coplanar_overlap_is_an_intersection():
    flat = np.array([[0.01, 0.0, 0.02], [0.03, 0.0, 0.02], [0.02, 0.0, 0.03]])
    positions, faces = two_layers(flat)
    assert Referee(faces, 28).judge(positions).cloth_cloth > 0
    positions[25:, 0] += 1.0
    assert Referee(faces, 28).judge(positions).cloth_cloth == 0


def test_minimum_distance():
    positions, faces = two_layers(TRIANGLE + np.array([0, 0.06, 0]))
    referee = Referee(faces, 28)
    assert referee.minimum_distance(positions) == pytest.approx(0.01, rel=1e-6)
    assert referee.minimum_distance(positions, reach=0.005) == np.inf
    sheet_positions, sheet_faces = sheet()
    with_body = Referee(sheet_faces, 25, np.array([[0, 1, 2]]), 3)
    body = TRIANGLE + np.array([0, 0.06, 0])
    assert with_body.minimum_distance(sheet_positions, body, between="cloth_body") == pytest.approx(0.01)
    assert with_body.minimum_distance(sheet_positions, body, between="cloth_cloth") == np.inf


def test_first_contact_finds_what_frames_hide():
    positions, faces = two_layers(TRIANGLE + np.array([0, 0.15, 0]))  # lowest point 10 cm above the sheet
    through = positions.copy()
    through[25:, 1] -= 0.4  # all of it is below the sheet at the end
    referee = Referee(faces, 28)
    assert referee.judge(positions).cloth_cloth == referee.judge(through).cloth_cloth == 0
    assert referee.first_contact(positions, through) == pytest.approx(0.25, rel=0.02)
    assert referee.first_contact(positions, positions + np.array([0.0, 0.3, 0.0])) == 1.0


def test_nan_positions_count_nothing():
    positions, faces = sheet()
    assert Referee(faces, 25).judge(positions * np.nan).cloth_cloth == 0


def test_padded_vertices_do_no_harm():
    positions, faces = two_layers(TRIANGLE)
    padded = np.concatenate([positions, np.zeros((4, 3))])
    assert Referee(faces, 32).judge(padded) == Referee(faces, 28).judge(positions)
