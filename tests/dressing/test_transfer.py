"""A garment goes to another body: the cut follows, the ease stays, and nothing lies inside."""

import dataclasses

import numpy as np
import pytest
import trimesh
from cloth import shaped, stand_at, turn_about
from garment_files import TO_Z_UP, bundled, source
from other_bodies import BODIES, measure, smpl_female

from eslr_jax import ConfigError, MeshError
from eslr_jax.pipeline.assets import load_garment_file
from eslr_jax.pipeline.dressing.clearance import body_heights
from eslr_jax.pipeline.dressing.fit import fit_garment
from eslr_jax.pipeline.dressing.options import FitOptions
from eslr_jax.pipeline.dressing.postures import rest_posture
from eslr_jax.pipeline.dressing.report import describe_fit, describe_transfer
from eslr_jax.pipeline.dressing.transfer import pose_alike, transfer_garment
from eslr_jax.pipeline.rigs.rig import body_skeleton, make_body

SMALLER = 0.7


@pytest.fixture(scope="module")
def shirt():
    return bundled("tshirt_1k")


@pytest.fixture(scope="module")
def woman():
    """A woman on SMPL's joints, in a T-pose."""
    return make_body(smpl_female())


@pytest.fixture(scope="module")
def small(body):
    """The bundled body at seven tenths."""
    return shaped(body, lambda places: SMALLER * places)


def lengths(positions, faces):
    return trimesh.Trimesh(positions, faces, process=False).edges_unique_length


def test_the_own_body_changes_nothing(body, shirt):
    carried = transfer_garment(shirt, body, body)
    np.testing.assert_allclose(carried.sewn_positions, shirt.rest_positions, atol=1e-3)
    np.testing.assert_allclose(carried.rest_positions, carried.sewn_positions, atol=1e-6)
    assert carried.metadata["transfer"] == {"scale": "body", "girth": 1.0, "length": 1.0}
    np.testing.assert_array_equal(load_garment_file("tshirt", body=body).rest_positions, shirt.rest_positions)


@pytest.mark.slow
def test_the_girth_is_that_of_the_trunk_wherever_the_bodies_stand_and_face(body, shirt, woman):
    aside = np.array([3.0, 0.0, 0.0], np.float32)
    turn = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]], np.float32)
    scenes = (
        (shirt.rest_positions, body, woman),
        (shirt.rest_positions + aside, stand_at(body, aside), woman),
        (shirt.rest_positions @ turn, turn_about(body, turn), turn_about(woman, turn)),
    )
    reports = [
        transfer_garment(
            dataclasses.replace(shirt, rest_positions=positions), source, target, scale="girth"
        ).metadata["transfer"]
        for positions, source, target in scenes
    ]
    assert reports[1] == pytest.approx(reports[0], abs=2e-3)
    assert reports[2] == pytest.approx(reports[0], abs=2e-3)


@pytest.mark.parametrize("scale", ["body", "girth"])
def test_a_bundled_garment_comes_in_the_size_of_the_body(small, shirt, scale):
    carried = load_garment_file("tshirt", body=small, fit=FitOptions(scale=scale))
    np.testing.assert_allclose(carried.rest_positions, SMALLER * shirt.rest_positions, atol=3e-3)
    ratios = lengths(carried.sewn_positions, shirt.faces) / lengths(shirt.rest_positions, shirt.faces)
    np.testing.assert_allclose(np.median(ratios), SMALLER, rtol=0.01)
    assert np.abs(ratios / SMALLER - 1).max() < (0.2 if scale == "body" else 1e-4)
    assert "girth is 0.70" in describe_transfer(carried.metadata["transfer"])


def test_another_rig_in_another_pose_wears_it(body, woman, shirt):
    carried = transfer_garment(shirt, body, woman)
    posture, rest = pose_alike(woman, body_skeleton(body)), rest_posture(woman)
    arm = [posture.joints[woman.joint_names.index(f"left_{name}")] for name in ("shoulder", "elbow")]
    assert arm[1][1] < arm[0][1] - 0.1, "the arms are lowered from the T-pose to those of the garment's body"
    ease = [np.median(body_heights(*pair)[0]) for pair in (
        (shirt.rest_positions, rest_posture(body)), (carried.sewn_positions, posture),
    )]  # fmt: skip
    assert ease[1] == pytest.approx(0.92 * ease[0], abs=0.006)  # she is 0.92 of the height
    for points, pose in ((carried.sewn_positions, posture), (carried.rest_positions, rest)):
        assert body_heights(points, pose)[0].min() > 0
    after, before = (
        trimesh.triangles.area(points[shirt.faces])
        for points in (carried.sewn_positions, shirt.rest_positions)
    )
    assert 0.65 < (after / before).min() < (after / before).max() < 1.2, "the cut is even"
    assert carried.skin_indices.max() < len(woman.joint_names)
    np.testing.assert_allclose(carried.skin_weights.sum(axis=1), 1.0, atol=1e-6)
    np.testing.assert_array_equal(carried.is_pinned, shirt.is_pinned)


def test_a_mesh_of_another_body_is_put_on_that_body_first(body, small, shirt):
    """In centimetres, Z up, from the floor: recognised on the body that it was made for."""
    floor = [0.0, float(np.asarray(body.rest_positions)[:, 1].min()), 0.0]
    mesh = source(100 * (shirt.rest_positions - floor) @ TO_Z_UP.T, shirt.faces)
    options = FitOptions(units="cm", up="z", front="-y", arms="rest", scale="none")
    fitted = fit_garment(mesh, small, options, made_for=body)
    np.testing.assert_allclose(fitted.rest_positions, SMALLER * shirt.rest_positions, atol=4e-3)
    own, kept = (lengths(points, shirt.faces) for points in (shirt.rest_positions, fitted.sewn_positions))
    np.testing.assert_allclose(kept, own, atol=1e-5)
    assert "carried to the body: lengths kept as they were; its girth is 0.70" in describe_fit(
        fitted.metadata["fit"]
    )
    with pytest.raises(ConfigError, match="--made-for"):
        fit_garment(mesh, small, options)


def test_what_cannot_be_carried_is_told(body, shirt):
    nameless = body.replace(joint_names=tuple(f"bone.{k:03}" for k in range(len(body.joint_names))))
    with pytest.raises(MeshError, match="known as its left upper arm; name the joints as Mixamo does"):
        transfer_garment(shirt, body, nameless)
    with pytest.raises(ConfigError, match="--made-for"):
        transfer_garment(dataclasses.replace(shirt, sewn_positions=shirt.rest_positions), body, body)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "garment"), [("figure", "longsleeve"), ("smpl_female", "pants")])
def test_a_bundled_garment_sits_and_walks_on_another_body(name, garment):
    """`experiments/other_bodies.py` measures all nine garments on all five bodies."""
    ((row, *_),) = measure(make_body(BODIES[name]()), (garment,), frames=60)
    assert row["inside_at_rest"] == 0
    assert row["rest_inside_mm"] < 0.1
    assert row["standing_p99_stretch"] < 1.15
    assert row["standing_max_stretch"] < 1.2
    assert row["rest_p99_stretch"] < 1.2  # with the arms up, where the body rests so
    assert row["walk_finite"]
    assert row["walk_p99_stretch"] < 1.4
