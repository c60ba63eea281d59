"""Where a mesh passes through itself: counted as the referee does, and as deep as it was pushed."""

import numpy as np
import pytest
from cloth import make_sheet

from eslr_jax.pipeline.report.crossing import find_crossings, intersecting_pairs

SPACING, GAP = 0.02, 0.01  # [m]


def stacked(dent: float):
    """Two level sheets 1 cm apart; the middle of the upper one is pushed down by a depth [m], as a bowl."""
    flat, faces = make_sheet(13, 13, SPACING, jitter=0.1)
    flat = flat - flat.mean(axis=0)
    upper = flat + np.array([0.003, GAP, 0.004])
    upper[:, 1] -= dent * np.exp(-np.sum(upper[:, [0, 2]] ** 2, axis=1) / (2 * 0.04**2))
    return np.concatenate([flat, upper]), np.concatenate([faces, faces + len(flat)])


@pytest.mark.parametrize("dent", [0.005, 0.02, 0.06])
def test_pairs_are_the_referees(dent):
    positions, faces = stacked(dent)
    found = find_crossings(positions, faces).faces
    np.testing.assert_array_equal(
        found, np.unique(np.sort(intersecting_pairs(positions, faces), axis=1), axis=0)
    )
    assert (len(found) > 0) == (dent > GAP)


@pytest.mark.parametrize("dent", [0.02, 0.04])
def test_what_is_on_the_wrong_side_is_as_deep_as_it_was_pushed(dent):
    positions, faces = stacked(dent)
    depths = find_crossings(positions, faces).depths
    upper = np.arange(len(positions)) >= len(positions) // 2
    lowest = -positions[upper, 1].min()
    assert depths[upper].max() == pytest.approx(lowest, rel=0.15)
    # Of the lower sheet, what the bowl encloses is on the wrong side as well; the rest of both is not.
    is_near = np.hypot(positions[:, 0], positions[:, 2]) < 0.1
    assert (depths[~is_near] == 0).all()
    assert np.sum(depths[upper] > 0) == np.sum(positions[upper, 1] < 0)


def test_a_flat_sheet_and_one_that_is_not_finite_cross_nowhere():
    flat, faces = make_sheet(5, 5, SPACING)
    for positions in (flat, flat * np.nan):
        crossings = find_crossings(positions, faces)
        assert crossings.faces.shape == (0, 2)
        assert (crossings.depths == 0).all()
