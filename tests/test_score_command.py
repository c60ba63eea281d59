"""`eslr score`: what a run says of itself, what its files say, and what is refused."""

import json

import jax
import numpy as np
import pytest
from commands import eslr, refused, simulated, succeeded

from eslr_jax.pose.lbs import skin_garment


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A short run, and its garment as other programs write it."""
    folder = tmp_path_factory.mktemp("score")
    simulated(folder / "run", "--iterations", 50, "--frames", 8)
    return folder


@pytest.fixture(scope="module")
def carried(tshirt, walk):
    """A T-shirt that the joints carry."""
    return np.asarray(jax.jit(skin_garment)(tshirt, walk.joint_transforms))


def scored(*arguments):
    done = succeeded(eslr("score", *arguments, "--json", "--every", 2))
    return json.loads(done.stdout)


@pytest.mark.slow
def test_a_run_its_glb_and_its_npz_score_as_the_run_s_report_says(folder):
    report = json.loads((folder / "run" / "report.json").read_text())
    assert eslr("export", folder / "run", "--out", folder / "own.npz").returncode == 0
    own = scored(folder / "run")
    for file in (None, "own.npz", "run/animation.glb"):
        score = own if file is None else scored(folder / file, "--run", folder / "run")
        for name in (
            "num_frames", "num_vertices", "max_principal_stretch", "p99_principal_stretch", "rms_speed_m_s",
            "penetration_max_mm", "penetrating_share", "slide_m", "coverage", "total",
        ):  # fmt: skip
            assert score[name] == pytest.approx(report[name], rel=5e-3, abs=1e-6), (file, name)
        assert score["gap_relative_median"] < 0.01
        assert score["intersections_cloth"] == own["intersections_cloth"]


@pytest.mark.slow
def test_an_outfit_is_scored_together_and_by_garment(tmp_path):
    worn = ("--garment", "pants", "--garment", "tshirt")
    options = ("--iterations", 30, "--frames", 4, "--settle", 0, "--integrator", "euler")
    report, _ = simulated(tmp_path / "run", *worn, *options)
    glb = tmp_path / "run" / "animation.glb"
    refused(eslr("score", glb), "pants, tshirt", "--garment for every garment")
    score = scored(glb, "--run", tmp_path / "run")
    assert list(score["garments"]) == ["pants", "tshirt"]
    for name, row in report["garments"].items():
        for key, value in row.items():
            assert score["garments"][name][key] == pytest.approx(value, rel=5e-3, abs=2e-2), (name, key)
    for key in ("max_principal_stretch", "penetration_max_mm"):
        assert max(row[key] for row in score["garments"].values()) == score[key]
    assert score["num_vertices"] == sum(row["num_vertices"] for row in score["garments"].values())
    if score["intersections_cloth"] is not None:
        ours = sum(row["intersections_cloth"] for row in score["garments"].values())
        assert score["intersections_cloth"] <= ours <= 2 * score["intersections_cloth"]
    assert score["gap_relative_median"] < 0.1
    named = succeeded(eslr("score", glb, *worn))
    assert [line.split()[0] for line in named.stdout.splitlines()[-2:]] == ["pants", "tshirt"]


@pytest.mark.slow
def test_somebody_else_s_trajectory_is_scored_in_a_named_scene_and_shown_as_a_table(folder, carried, tshirt):
    from peers import SCORE, describe_rollout

    from eslr_jax.pipeline.report.calibrate import example_scene

    np.savez(folder / "carried.npz", positions=carried, faces=np.asarray(tshirt.faces))
    done = succeeded(eslr("score", folder / "carried.npz", "--motion", "cmu_016_32"))
    assert "optimality gap" in done.stdout
    assert "the garment stays where it was put on" in done.stdout
    score = scored(folder / "carried.npz")
    assert score["gap_relative_median"] > 0.1
    row = describe_rollout(carried, example_scene("tshirt", "1k", "cmu_016_32", 8), every=2)
    for name, column in SCORE.items():  # as in the table of peers
        assert score[name] == pytest.approx(row[column], rel=5e-3, abs=1e-6), name


@pytest.mark.slow
def test_what_can_t_be_scored_is_refused_in_one_line(tmp_path, carried, tshirt):
    faces = np.asarray(tshirt.faces)
    for name, arrays, words in (
        ("far", {"positions": 100 * carried}, ("far.npz begins", "metres, Y up")),
        ("slow", {"positions": carried, "fps": 24}, ("24 frames a second",)),
        ("few", {"positions": carried[:2]}, ("2 frames are too few",)),
        ("other", {"positions": carried[:, :900]}, ("900 vertices, the garment 1000",)),
    ):
        np.savez(tmp_path / f"{name}.npz", faces=faces % arrays["positions"].shape[1], **arrays)
        refused(eslr("score", tmp_path / f"{name}.npz"), *words)
    assert {path.suffix for path in tmp_path.iterdir()} == {".npz"}
