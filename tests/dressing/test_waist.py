"""Garments that do not hang from the shoulders are held at the waist, and nothing else is."""

import numpy as np
import pytest
from cloth import stand_at
from garment_files import bundled, source
from garment_shapes import cape, poncho, rings, shorts, skirt, trousers, tube_dress

from eslr_jax import ConfigError
from eslr_jax.pipeline.dressing.fit import fit_garment
from eslr_jax.pipeline.dressing.options import FitOptions
from eslr_jax.pipeline.dressing.pins import WAISTBAND, find_waist
from eslr_jax.pipeline.dressing.postures import shoulder_height
from eslr_jax.pipeline.dressing.report import describe_cost, describe_fit

GIVEN = {"units": "m", "up": "y", "front": "z", "arms": "rest"}


def standing(shape, body):
    positions, faces = shape()
    return positions + np.array([0.0, float(np.asarray(body.rest_positions)[:, 1].min()), 0.0]), faces


def joined(*shapes):
    """Return several shapes as one mesh."""
    counts = np.cumsum([0, *(len(positions) for positions, _ in shapes)])
    faces = [faces + start for (_, faces), start in zip(shapes, counts[:-1], strict=True)]
    return np.concatenate([positions for positions, _ in shapes]), np.concatenate(faces)


@pytest.mark.parametrize("shape", [skirt, shorts, trousers, tube_dress])
def test_waistband_is_the_top_of_what_has_no_shoulders(body, shape):
    positions, faces = standing(shape, body)
    waist = find_waist(positions, faces, body)
    below = positions[:, 1].max() - positions[:, 1]
    assert waist.is_held[below < 0.9 * WAISTBAND].all()
    assert below[waist.is_held].max() <= WAISTBAND
    assert not waist.is_falling
    assert "waistband" in waist.reason


@pytest.mark.parametrize("shape", [trousers, poncho, cape])
def test_a_body_that_stands_elsewhere_has_the_same_pins(body, shape):
    positions, faces = standing(shape, body)
    waist = find_waist(positions, faces, body)
    aside = stand_at(body, [3.0, 0.0, 0.0])
    moved = find_waist(positions + np.array([3.0, 0.0, 0.0]), faces, aside)
    np.testing.assert_array_equal(moved.is_held, waist.is_held)
    assert moved.reason == waist.reason


def test_a_cape_is_held_at_its_neckline_and_what_lies_on_the_shoulders_is_not(body):
    positions, faces = standing(cape, body)
    waist = find_waist(positions, faces, body)
    below = positions[:, 1].max() - positions[:, 1]
    np.testing.assert_array_equal(waist.is_held, below < WAISTBAND)
    assert "open around the neck" in waist.reason
    assert not waist.is_falling
    waist = find_waist(*standing(poncho, body), body)
    assert not waist.is_held.any()
    assert waist.reason == "it hangs from the shoulders"


def test_raised_arms_of_a_body_without_a_rig_raise_no_shoulders(body):
    raised = np.array(body.rest_positions)  # as the first frame of a moving mesh
    middle, top = np.median(raised[:, 0]), raised[:, 1].max()
    raised[np.abs(raised[:, 0] - middle) > 0.3, 1] = top + 0.5
    bones = body.replace(parents=(-1,), joint_rest_positions=raised.mean(axis=0, keepdims=True))
    expected = raised[:, 1].min() + 0.8 * (top - raised[:, 1].min())
    assert shoulder_height(bones.replace(rest_positions=raised)) == pytest.approx(expected, abs=1e-3)


def test_waistband_is_that_of_the_bundled_garments(body):
    for name in ("shorts", "pants", "kneepants"):
        garment = bundled(f"{name}_1k")
        held = find_waist(garment.rest_positions, garment.faces, body).is_held
        assert np.mean(garment.is_pinned[held]) == 1.0, name
        assert held.sum() > 0.6 * garment.is_pinned.sum(), name
    for name in ("tshirt", "tank", "longsleeve", "dress", "shortsleeve", "tightdress"):
        garment = bundled(f"{name}_1k")
        assert not find_waist(garment.rest_positions, garment.faces, body).is_held.any(), name


def test_parts_are_judged_one_by_one(body):
    shirt = bundled("tshirt_1k")
    positions, faces = joined((shirt.rest_positions, shirt.faces), standing(shorts, body))
    held = find_waist(positions, faces, body).is_held
    assert not held[: len(shirt.rest_positions)].any()
    assert held[len(shirt.rest_positions) :].sum() == find_waist(*standing(shorts, body), body).is_held.sum()


def test_leg_warmers_fall_and_the_report_says_so(body):
    legs = [rings([(0.5, 0.09, 0.09, 0.02), (0.2, 0.09, 0.09, 0.0)], around=24, rows=16) for _ in range(2)]
    for (positions, _), side in zip(legs, (0.175, -0.175), strict=True):
        positions[:, 0] += side
    fitted = fit_garment(source(*joined(*legs)), body, FitOptions(**GIVEN))
    assert not fitted.is_pinned.any()
    texts = fitted.metadata["fit"]["warnings"]
    (warning,) = (text for text in texts if "nothing holds the garment up" in text)
    assert "give eslr fit --pin" in warning


def test_pins_replace_the_waistband(body):
    def fit(*pins):
        return fit_garment(source(*shorts()), body, FitOptions(pin=pins, **GIVEN))

    default = fit()
    assert default.metadata["fit"]["pinned"] == default.is_pinned.sum() > 50
    text = describe_fit(default.metadata["fit"])
    assert "feet at the origin" in text
    assert "pinned: 100 vertices (waistband at 1.10 m above the floor" in text
    free = fit("none")
    assert not free.is_pinned.any()
    assert "warning: nothing holds the garment up" in describe_fit(free.metadata["fit"])
    loop = fit("loop:top")
    assert loop.is_pinned.sum() == 50
    both = fit("waist", "vertices:0")
    assert both.is_pinned.sum() == default.is_pinned.sum() + 1
    with pytest.raises(ConfigError, match="'none' holds nothing"):
        fit("none", "waist")
    shirt = bundled("tshirt_1k")
    with pytest.raises(ConfigError, match="'waist' holds no vertex: it hangs from the shoulders"):
        fit_garment(source(shirt.rest_positions, shirt.faces), body, FitOptions(pin=("waist",), arms="rest"))


def test_cost_is_told_for_large_meshes_only():
    assert describe_cost(10_000) is None
    text = describe_cost(251_000)
    assert text.startswith("251,000 vertices are many: fitting takes about 75 s")
    assert "eslr fit --edge-length" in text
