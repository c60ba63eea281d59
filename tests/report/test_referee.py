"""The referee on constructed intersections."""

import numpy as np
import pytest
from cloth import dented_sheets, make_sheet
from hard_cases.build import sheet

from eslr_jax.pipeline.report.crossing import find_crossings, intersecting_pairs

pytest.importorskip("ipctk")

FLAT = sheet(5, 5, (0.4, 0.4))  # 25 vertices, 32 faces
TRIANGLE = np.array([[0.0, -0.05, 0.01], [0.02, 0.05, 0.01], [-0.02, 0.05, 0.03]])  # stands upright


def two_layers(other):
    positions, faces = FLAT
    return np.concatenate([positions, other]), np.concatenate([faces, [[25, 26, 27]]])


def test_flat_and_rolled_cloth_is_clean():
    positions, faces = FLAT
    assert not len(intersecting_pairs(positions, faces))
    angle = positions[:, 0] / 0.1  # rolled up to less than a turn
    rolled = np.stack([0.1 * np.sin(angle), 0.1 * np.cos(angle), positions[:, 2]], axis=1)
    assert not len(intersecting_pairs(rolled, faces))


def test_piercing_triangle_is_paired_with_the_faces_it_crosses():
    positions, faces = two_layers(TRIANGLE)
    pairs = intersecting_pairs(positions, faces)
    # At height zero its cross-section runs from (0.01, 0.01) to (-0.01, 0.02) in (x, z).
    share = np.linspace(0, 1, 11)[:, None]
    points = (1 - share) * [0.01, 0.0, 0.01] + share * [-0.01, 0.0, 0.02]
    a, b, c = np.moveaxis(positions[faces[:-1]], 1, 0)
    inside = [
        np.cross(end - start, points[:, None] - start)[..., 1] for start, end in ((a, b), (b, c), (c, a))
    ]
    crossed = np.flatnonzero((np.min(inside, axis=0) > 0).any(axis=0))
    assert len(crossed) > 1
    np.testing.assert_array_equal(pairs, [[face, 32] for face in crossed])
    positions[25:, 1] += 0.0501
    assert not len(intersecting_pairs(positions, faces))


def test_pairs_with_the_body_are_counted_apart():
    positions, faces = FLAT
    count = len(intersecting_pairs(*two_layers(TRIANGLE)))
    pairs = intersecting_pairs(positions, faces, TRIANGLE, np.array([[0, 1, 2]]))
    assert len(pairs) == count
    assert (pairs == len(faces)).any(axis=1).all()
    lifted = TRIANGLE + np.array([0, 0.06, 0])
    assert not len(intersecting_pairs(positions, faces, lifted, np.array([[0, 1, 2]])))


def test_body_that_intersects_itself_is_not_counted():
    positions, faces = FLAT
    body, body_faces = two_layers(TRIANGLE)
    assert not len(intersecting_pairs(positions, faces, body + np.array([0, 1.0, 0]), body_faces))


def test_coplanar_overlap_is_an_intersection():
    flat = np.array([[0.01, 0.0, 0.02], [0.03, 0.0, 0.02], [0.02, 0.0, 0.03]])
    positions, faces = two_layers(flat)
    assert len(intersecting_pairs(positions, faces)) == 1  # it lies inside one face
    positions[25:, 0] += 1.0
    assert not len(intersecting_pairs(positions, faces))


def test_padded_vertices_do_no_harm():
    positions, faces = two_layers(TRIANGLE)
    padded = np.concatenate([positions, np.zeros((4, 3))])
    np.testing.assert_array_equal(intersecting_pairs(padded, faces), intersecting_pairs(positions, faces))


# --- where a mesh passes through itself: counted as the referee does, and as deep as it was pushed ----------


@pytest.mark.parametrize("dent", [0.005, 0.02, 0.06])
def test_pairs_are_the_referees(dent):
    positions, faces = dented_sheets(dent)
    found = find_crossings(positions, faces).faces
    np.testing.assert_array_equal(
        found, np.unique(np.sort(intersecting_pairs(positions, faces), axis=1), axis=0)
    )
    assert (len(found) > 0) == (dent > 0.01)


@pytest.mark.parametrize("dent", [0.02, 0.04])
def test_what_is_on_the_wrong_side_is_as_deep_as_it_was_pushed(dent):
    positions, faces = dented_sheets(dent)
    depths = find_crossings(positions, faces).depths
    upper = np.arange(len(positions)) >= len(positions) // 2
    lowest = -positions[upper, 1].min()
    assert depths[upper].max() == pytest.approx(lowest, rel=0.15)
    # Of the lower sheet, what the bowl encloses is on the wrong side as well; the rest of both is not.
    is_near = np.hypot(positions[:, 0], positions[:, 2]) < 0.1
    assert (depths[~is_near] == 0).all()
    assert np.sum(depths[upper] > 0) == np.sum(positions[upper, 1] < 0)


def test_a_flat_sheet_and_one_that_is_not_finite_cross_nowhere():
    flat, faces = make_sheet(5, 5, 0.02)
    for positions in (flat, flat * np.nan):
        assert not len(intersecting_pairs(positions, faces))
        crossings = find_crossings(positions, faces)
        assert crossings.faces.shape == (0, 2)
        assert (crossings.depths == 0).all()
