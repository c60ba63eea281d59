"""A file's unit, axes and place are recognised, obeyed where given, and doubted aloud where unclear."""

import numpy as np
import pytest
from cloth import stand_at, turn_about
from garment_files import TO_Z_UP, bundled
from garment_shapes import cape, poncho, shorts, skirt, trousers, tube_dress

from eslr_jax import MeshError
from eslr_jax.pipeline.dressing.options import FitOptions
from eslr_jax.pipeline.dressing.placement import DOUBTFUL, find_placement
from eslr_jax.pipeline.dressing.postures import arm_postures, rest_posture
from eslr_jax.pose.motion import chest_direction

KEPT = FitOptions(units="m", up="y", front="z", keep_place=True)


@pytest.fixture(scope="module")
def postures(body):
    return arm_postures(body)


def standing(postures):
    """Return the offset from a file whose origin is between the feet to the body's frame [m]."""
    return np.array([0.0, postures[0].floor, 0.0])


@pytest.mark.parametrize("shape", [skirt, tube_dress, poncho, cape, shorts, trousers])
@pytest.mark.parametrize(("scale", "axes"), [(1.0, np.eye(3)), (100.0, TO_Z_UP)])
def test_feet_at_the_origin_are_recognised(postures, shape, scale, axes):
    positions, faces = shape()
    placement = find_placement(scale * positions @ axes.T, faces, postures)
    assert placement.origin == "floor"
    np.testing.assert_allclose(
        placement.apply(scale * positions @ axes.T), positions + standing(postures), atol=1e-9
    )


def test_garment_in_the_bodys_frame_stays_there_with_confidence(postures):
    positions, faces = skirt()
    placement = find_placement(positions + standing(postures), faces, postures)
    assert placement.origin == "body"
    np.testing.assert_array_equal(placement.translation, 0.0)
    assert placement.confidence > 0.99
    assert placement.warnings == ()


def test_trousers_that_are_partly_inside_are_doubted_though_nothing_fits_better(postures):
    """Their origin is another body's pelvis, a hand above this one's, and their legs are close together."""
    positions, faces = trousers()
    narrow = (positions + standing(postures)) * [0.7, 1.0, 0.9] - [0.0, 0.14, 0.0]
    placement = find_placement(narrow, faces, postures)
    assert placement.confidence < DOUBTFUL
    assert "% of it is more than 1 cm inside the body" in placement.warnings[0]


def test_sleeves_that_limbs_pierce_are_told_to_name_their_body(postures):
    garment = bundled("longsleeve_1k")
    x, y, z = garment.rest_positions.T
    raised = np.stack([x, y + 1.2 * np.maximum(np.abs(x) - 0.2, 0.0), z], axis=1)
    placement = find_placement(raised, garment.faces, postures[:1], KEPT)
    assert any(
        "limbs of the body pierce the cloth" in text and "--made-for" in text for text in placement.warnings
    )


def test_a_file_in_the_axes_of_a_body_that_faces_backwards_is_left_as_it_is(body):
    turn = np.diag([-1.0, 1.0, -1.0])  # as characters in VRM 0 stand
    turned = turn_about(body, turn)
    facing = chest_direction(turned)
    np.testing.assert_allclose(facing, [0.0, 0.0, -1.0], atol=0.3)
    garment = bundled("tshirt_1k")
    worn = np.asarray(garment.rest_positions)
    for positions, front, rotation in ((worn @ turn, "-z", np.eye(3)), (worn, "z", turn)):
        placement = find_placement(positions, garment.faces, [rest_posture(turned)], facing=facing)
        assert (placement.up, placement.front) == ("y", front)
        np.testing.assert_array_equal(placement.rotation, rotation)
        np.testing.assert_allclose(placement.apply(positions), worn @ turn, atol=1e-6)
    options = FitOptions(units="m", up="y", front="-z")
    given = find_placement(worn @ turn, garment.faces, [rest_posture(turned)], options, facing=facing)
    np.testing.assert_array_equal(given.rotation, np.eye(3))


def test_a_file_may_have_the_origin_of_a_body_that_stands_aside(body):
    positions, faces = skirt()
    aside = stand_at(body, [3.0, 0.0, -2.0])
    postures = arm_postures(aside)
    exported = positions + np.array([3.0, 0.0, -2.0])  # as on a body whose export was lowered alone
    placement = find_placement(exported, faces, postures)
    assert placement.origin == "floor"
    np.testing.assert_allclose(placement.translation, [0.0, postures[0].floor, 0.0])


# What is lowered is not where the body is, and has to be moved along it.
@pytest.mark.parametrize(
    ("shape", "lowered"), [(skirt, 0.0), (poncho, 0.0), (trousers, 0.0), (poncho, 0.4), (trousers, 0.4)]
)
def test_a_body_that_stands_aside_wears_the_garment_at_the_same_place(body, postures, shape, lowered):
    positions, faces = shape()
    positions = positions - [0.0, lowered, 0.0]
    aside = np.array([3.0, 0.0, -2.0])
    usual = find_placement(positions, faces, postures)
    moved = find_placement(positions, faces, arm_postures(stand_at(body, aside)))
    assert (moved.factor, moved.posture, moved.up) == (usual.factor, usual.posture, usual.up)
    np.testing.assert_array_equal(moved.rotation, usual.rotation)
    np.testing.assert_allclose(moved.translation, usual.translation + aside, atol=0.04)


@pytest.mark.parametrize("shape", [poncho, cape])
@pytest.mark.parametrize("raised", [False, True])
@pytest.mark.parametrize("aside", [0.0, 1.5])
def test_kept_place_is_obeyed_even_beside_the_body(postures, shape, raised, aside):
    positions, faces = shape()
    floor = standing(postures)
    positions = positions + np.array([aside, 0.0, 0.0]) + raised * floor
    placement = find_placement(positions, faces, postures[:1], KEPT)
    if aside:
        assert "the garment is not on the body, and stays there as asked" in placement.warnings[-1]
        assert placement.translation[0] == 0.0
    else:
        np.testing.assert_allclose(placement.translation, (not raised) * floor)
        assert placement.warnings == ()


@pytest.mark.parametrize("miss", [0.006, -0.018, 0.04])
def test_a_kept_place_does_not_follow_soles_that_nearly_stand_on_the_origin(body, miss):
    posture = rest_posture(stand_at(body, [0.0, miss - float(body.rest_positions[:, 1].min()), 0.0]))
    assert posture.floor == pytest.approx(miss, abs=1e-6)
    positions, faces = skirt()
    placement = find_placement(positions, faces, [posture], KEPT)
    np.testing.assert_allclose(placement.translation, [0.0, miss if miss > 0.02 else 0.0, 0.0], atol=1e-6)


def test_refusal_names_only_the_options_that_are_missing(postures):
    positions, faces = skirt()
    with pytest.raises(MeshError, match=r"give eslr fit --units and --front, or model it on the body"):
        find_placement(positions + 9.0, faces, postures, FitOptions(keep_place=True, up="y"))


@pytest.mark.parametrize("name", ["pants_1k", "longsleeve_1k"])
def test_odd_unit_is_told(postures, name):
    garment = bundled(name)
    written = garment.rest_positions - standing(postures)
    assert find_placement(written, garment.faces, postures).warnings == ()
    (text,) = find_placement(37.3 * written, garment.faces, postures).warnings
    told = float(text.split("(")[1].split()[0])
    assert told == pytest.approx(37.3, rel=0.03)


def test_doubt_is_told_with_the_rival(postures):
    garment = bundled("dress_1k")
    centered = garment.rest_positions - garment.rest_positions.mean(axis=0)
    placement = find_placement(1000 * centered @ TO_Z_UP.T, garment.faces, postures)
    assert placement.confidence < DOUBTFUL
    assert "moved along the body fits almost as well; look at the picture" in placement.warnings[0]


@pytest.mark.parametrize(
    ("name", "axes"), [("tshirt_1k", np.eye(3)), ("tank_1k", TO_Z_UP), ("dress_1k", TO_Z_UP)]
)
def test_inches_are_no_centimetres_on_a_head(postures, name, axes):
    garment = bundled(name)
    written = (garment.rest_positions - garment.rest_positions.mean(axis=0)) @ axes.T / 0.0254
    placement = find_placement(written, garment.faces, postures)
    assert placement.factor == 0.0254
    assert (placement.up, placement.front) == (("y", "z") if axes[1, 1] else ("z", "-y"))
    off = np.linalg.norm(placement.apply(written) - garment.rest_positions, axis=1)
    assert off.mean() < 0.1  # where a wide dress sits along the body is open
