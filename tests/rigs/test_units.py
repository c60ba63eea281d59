"""Bodies in odd units, and bodies of other shapes."""

import dataclasses
import re
import warnings

import numpy as np
import pytest
from foreign_files import moving, rigged

from eslr_jax import AssetError, ConfigError, load_body, load_motion
from eslr_jax.pipeline.rigs.rig import (
    UnitsWarning,
    make_body,
    make_motion,
    metres_per_unit,
)


@pytest.mark.parametrize(
    ("extent", "scale"),
    [(170.0, 0.01), (200.0, 0.01), (1700.0, 0.001), (71.0, 0.0254), (5.6, 0.3048), (0.017, 100.0)],
)
def test_a_body_in_odd_units_is_made_a_person_with_a_line_that_says_so(extent, scale):
    person = f"{1.7 / extent:.3g} m per unit"
    with pytest.warns(
        UnitsWarning, match=rf"name its unit if not \(a person of 1.7 m has {re.escape(person)}\)"
    ):
        assert metres_per_unit("body", extent) == pytest.approx(scale)


def test_metres_and_named_units_are_not_guessed():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for extent in (0.35, 0.4, 1.7, 2.9):  # a doll, a baby, a person, a giant
            assert metres_per_unit("body", extent) == 1.0
        assert metres_per_unit("body", 1.7, "cm") == 0.01
        assert metres_per_unit("body", 71.0, "0.02") == 0.02


@pytest.mark.parametrize(("extent", "units"), [(1.7, "parsec"), (1.7, "-1"), (0.0, None), (1e9, None)])
def test_no_unit_is_refused(extent, units):
    with pytest.raises(AssetError, match="unit"):
        metres_per_unit("body", extent, units)


def test_a_character_in_centimetres_moves_as_in_metres(body):
    """The motion of its file is in centimetres too, and still its own."""
    motion = load_motion("cmu_016_32")
    source = moving(body)
    skeleton = dataclasses.replace(source.skeleton, rest_positions=100 * source.skeleton.rest_positions)
    with pytest.warns(UnitsWarning, match="in cm"):
        character = make_body(rigged(body, positions=100 * rigged(body).positions, skeleton=skeleton))
    np.testing.assert_allclose(character.joint_rest_positions, body.joint_rest_positions, atol=1e-6)
    moved = make_motion(
        dataclasses.replace(source, skeleton=skeleton, positions=100 * source.positions), character
    )
    assert moved.arm_abduction == 0.0
    np.testing.assert_allclose(moved.translations, motion.translations, atol=1e-6)


def test_a_shape_moves_vertices_and_joints_along_its_directions(body):
    shaped = load_body(betas=[0.0, 2.0])
    np.testing.assert_allclose(
        shaped.rest_positions, body.rest_positions + 2.0 * body.shape_directions[:, :, 1], atol=1e-6
    )
    np.testing.assert_allclose(
        shaped.joint_rest_positions,
        body.joint_rest_positions + 2.0 * body.joint_shape_directions[:, :, 1],
        atol=1e-6,
    )
    motion = load_motion("cmu_016_32", body=shaped)
    soles = float(np.asarray(shaped.rest_positions)[:, 1].min())
    standing = float(shaped.joint_rest_positions[0, 1]) - soles
    assert motion.translations[:, 1].mean() == pytest.approx(standing, rel=0.05)  # longer legs, higher hips


@pytest.mark.parametrize("betas", [np.zeros(1000), [np.nan]])
def test_shapes_that_a_body_lacks_are_refused(betas):
    with pytest.raises(ConfigError, match="betas"):
        load_body(betas=betas)
