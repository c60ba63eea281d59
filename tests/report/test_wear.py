"""How a garment sits, and the words for it: a square of cloth over a ball."""

import re

import jax.numpy as jnp
import numpy as np
import pytest
from cloth import dented_sheets
from draped_ball import RADIUS, ball, drifting_ball, square
from hard_cases.build import make_cloth, make_scene

from eslr_jax import load_garment, load_motion, pose_body, prepare_scene
from eslr_jax.pipeline.report.crossing import intersecting_pairs
from eslr_jax.pipeline.report.report import describe_report, describe_start, start_crossing, trajectory_report
from eslr_jax.pipeline.report.score import foreign_trajectory
from eslr_jax.pipeline.report.wear import wear_report
from eslr_jax.pose.lbs import skin_garment
from eslr_jax.terms import FAST, Contact


@pytest.fixture(scope="module")
def worn():
    """A square that covers the top of the ball, its scene, a trajectory at rest and its skinned place."""
    garment, poses = square(), drifting_ball(3)
    scene, still = prepare_scene(garment, poses, terms=FAST), np.zeros(3)
    scene = scene.replace(terms=(*scene.terms, Contact(rows=512)))  # nothing has to be moved out of its way
    skinned = np.asarray(skin_garment(garment, poses.joint_transforms))
    trajectory = foreign_trajectory(
        skinned, scene, velocities=0 * skinned, friction_loads=0 * skinned[..., 0]
    ).replace(energies={term.name: still for term in scene.terms}, residuals=still)
    return garment, poses, scene, trajectory, skinned


def report_of(worn, positions):
    garment, poses, scene, trajectory, skinned = worn
    moved = trajectory.replace(positions=jnp.asarray(positions, jnp.float32))
    rest = {"error": None, "tolerance": 0.01, "within_tolerance": 1.0}
    parts = (np.zeros(len(garment.faces), int), ("scarf",))
    return (
        rest
        | trajectory_report(moved, scene, parts=parts)
        | wear_report(positions, garment, skinned, poses, parts=parts)
    )


def test_cloth_in_its_place_is_good(worn):
    report = report_of(worn, worn[4])
    assert report["slide_m"] == pytest.approx(0.0, abs=1e-6)
    assert report["coverage"] == 1.0
    assert report["skin_through_mm"] == pytest.approx(0.0, abs=1e-3)
    words = describe_report(report)
    assert words.warnings == []
    assert "no skin shows through the cloth" in words.good


def test_skin_through_cloth_is_measured_and_told(worn):
    sunk = worn[4].copy()
    sunk[2, :, 1] -= 0.010  # 4 mm above the ball's top before: 6 mm below it now
    report = report_of(worn, sunk)
    assert report["skin_through_mm"] == pytest.approx(6.0, abs=0.1)
    worst = report["worst_skin_through"]
    assert (worst["frame"], worst["part"]) == (2, "scarf")
    top = np.asarray(worn[1].rest_positions)[worst["body_vertex"]]
    np.testing.assert_allclose(top, [0, RADIUS, 0], atol=1e-6)
    assert any("by up to 6.0 mm, frame 2 (0.07 s)" in text for text in describe_report(report).warnings)


@pytest.mark.parametrize(("aside", "before", "shown_mm"), [(0.005, 1e-4, 0.1), (0.0, 0.005, 5.0)])
def test_skin_beside_a_fold_does_not_show_through_it(aside, before, shown_mm):
    """The square is folded down along its middle, like a hairpin beside the ball's top."""
    garment, poses = square(9), drifting_ball(2, speed=0.0, mesh=ball(3))  # whose top alone is covered
    steps = np.repeat(np.arange(9) - 4, 9)
    rest = np.asarray(garment.rest_positions)
    folded = rest * [0.0, 0.0, 1.0] + [aside, RADIUS - before, 0.0]
    folded -= np.stack([-0.00125 * np.maximum(steps, 0), 0.03 * np.abs(steps), 0.0 * steps], axis=1)
    report = wear_report(np.stack([rest, folded]), garment, np.stack([rest, rest]), poses)
    assert report["skin_through_mm"] == pytest.approx(shown_mm, rel=0.01, abs=0.2)


def test_penetration_and_stretch_name_frame_part_and_vertex(worn):
    pulled = worn[4].copy()
    pulled[1, 0] += [-0.06, 0.0, 0.0]
    pulled[2, 27, 1] -= 0.02
    report = report_of(worn, pulled)
    place = {"frame": 2, "time_s": pytest.approx(2 / 30), "vertex": 27, "part": "scarf"}
    assert report["worst_penetration"] == place
    assert report["worst_stretch"]["frame"] in (1, 2)
    warnings = describe_report(report).warnings
    assert any("mm inside the body, frame 2 (0.07 s), part scarf, vertex 27" in text for text in warnings)
    assert any("cloth is stretched by" in text and "part scarf" in text for text in warnings)
    (advised,) = (text for text in describe_report(report | {"substeps": 2}).warnings if "stretched" in text)
    assert advised.endswith("vertex 0; try --substeps 8")
    assert "10 frames were simulated" in describe_report(report | {"refined_frames": 10}).good[-1]


def rolled(flat):
    """The square with one half turned about its middle, through the other half."""
    x, y, z = flat.T
    return np.where((x > 0)[:, None], np.stack([-x, y + 0.3 * (x - 0.06), z], axis=1), flat)


def test_cloth_through_cloth_is_told_where_it_is_modelled(worn):
    garment, poses, scene, trajectory, skinned = worn
    layered = scene.with_term(scene.term(Contact).replace(has_layers=True))
    crossed = skinned.copy()
    crossed[2] = rolled(skinned[0] - skinned[0].mean(axis=0))
    report = report_of((garment, poses, layered, trajectory, skinned), crossed)
    assert report["crossing_pairs"] == len(intersecting_pairs(crossed[2], np.asarray(garment.faces))) > 0
    assert report["worst_crossing"]["frame"] == 2
    assert any("cloth passes through cloth" in text for text in describe_report(report).warnings)
    clean = report_of((garment, poses, layered, trajectory, skinned), skinned)
    assert (clean["crossing_pairs"], clean["worst_crossing"]) == (0, None)
    assert "no cloth passes through cloth" in describe_report(clean).good
    bare = scene.with_term(scene.term(Contact).replace(has_layers=False))
    assert report_of((garment, poses, bare, trajectory, skinned), crossed)["crossing_pairs"] is None


@pytest.mark.parametrize(("dent", "is_told"), [(0.0, False), (0.02, True), (0.05, True)])
def test_a_start_with_cloth_deep_behind_cloth_is_told_with_its_place(dent, is_told):
    start, faces = dented_sheets(dent)
    scene = make_scene(make_cloth((start, faces), {}, allow_components=True), start, 2, self_contact=True)
    parts = (np.repeat([0, 1], len(faces) // 2), ("skirt", "coat"))
    text = describe_start(start_crossing(scene, parts=parts), is_put_on=False)
    assert (text is not None) == is_told
    if text is not None:
        assert re.search(r"frame 0 \(0\.00 s\), part (coat|skirt)", text)
        assert "--start" in text
        put_on = describe_start(start_crossing(scene, parts=parts), is_put_on=True)
        assert put_on
        assert "--start" not in put_on, "which does not change the rest pose"
    bare = tuple(term for term in scene.terms if not isinstance(term, Contact))
    assert start_crossing(scene.replace(terms=bare)) is None


def test_cloth_that_slides_or_falls_is_told(worn):
    slid, fallen = worn[4].copy(), worn[4].copy()
    slid[2] += [0.3, 0.0, 0.0]
    fallen[1:, :, 1] -= 1.0
    report = report_of(worn, slid)
    assert report["slide_m"] == pytest.approx(0.3, abs=1e-5)
    assert any("0.30 m from its place, frame 2" in text for text in describe_report(report).warnings)
    report = report_of(worn, fallen)
    assert report["below_feet_at"] == 1
    assert report["coverage"] == 0.0
    assert any("fell off: in frame 1" in text for text in describe_report(report).warnings)


def test_a_bodice_that_slipped_is_told_though_the_skirt_is_in_its_place(worn, body):
    """The upper quarter of a dress hangs up to 31 cm lower: its centre has moved by 2 cm."""
    garment, poses = load_garment("dress"), pose_body(body, load_motion(), num_frames=3)
    carried = np.asarray(skin_garment(garment, poses.joint_transforms))
    height = np.asarray(garment.rest_positions)[:, 1]
    slipped = carried.copy()
    share = (height - height.min()) / np.ptp(height)
    slipped[2, :, 1] -= 0.31 * np.clip((share - 0.75) / 0.25, 0.0, 1.0)
    report = wear_report(slipped, garment, carried, poses)
    assert report["slide_m"] < 0.05
    assert 0.2 < report["edge_slide_m"] < 0.31
    texts = describe_report(report_of(worn, worn[4]) | report).warnings
    assert any(
        re.search(r"its edge 1\.\d\d m above the soles is 0\.2\d m from its place, frame 2", t) for t in texts
    )
    assert wear_report(carried, garment, carried, poses)["edge_slide_m"] == 0.0


@pytest.mark.parametrize(
    ("change", "share"), [({"coverage": 0.7}, "30 %"), ({"within_tolerance": 0.9}, "10.0 %")]
)
def test_skin_that_is_left_and_frames_that_ended_early_are_told(worn, change, share):
    (text,) = describe_report(report_of(worn, worn[4]) | change).warnings
    assert share in text
