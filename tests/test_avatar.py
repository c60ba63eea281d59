"""A new character with a garment of its own, in one command; and a body that is a mesh in motion."""

import json
import subprocess
import sys

import numpy as np
import pytest
from formats import write_smpl, write_walker
from other_bodies import smpl_female

from eslr_jax.assets import load_motion
from eslr_jax.io.obj import obj_text
from eslr_jax.io.trajectory import read_trajectory


def eslr(*arguments):
    command = [sys.executable, "-m", "eslr_jax.cli", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def avatar(tmp_path_factory, body):
    """A folder with a character as Mixamo's become in Blender, walking, and its shirt."""
    folder = tmp_path_factory.mktemp("avatar")
    write_walker(folder / "avatar.glb", folder / "shirt.obj", body)
    return folder


@pytest.mark.slow
def test_a_new_character_with_its_garment_is_one_command(avatar, tmp_path, body):
    out = tmp_path / "out"
    result = eslr(
        "simulate", "--body", avatar / "avatar.glb", "--garment", avatar / "shirt.obj", "--simulator", "physics",
        "--frames", 4, "--iterations", 20, "--no-pictures", "--json", "--out", out,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    report = json.loads(result.stdout)
    assert report["finite"]
    assert report["motion"].endswith("avatar.glb")  # its own animation
    run = read_trajectory(out / "trajectory.npz")
    assert run.positions.shape == (4, 1000, 3)
    from eslr_jax.body.motion import pose_body

    expected = pose_body(body, load_motion(), arm_abduction=0.0, num_frames=4)
    distance = np.linalg.norm(run.body.positions - np.asarray(expected.positions), axis=-1)
    assert np.quantile(distance, 0.99) < 2e-3  # [m]: glTF kept four of up to seven influences
    assert distance.max() < 0.015
    result = eslr("export", out, "--out", tmp_path / "shirt.pc2")
    assert result.returncode == 0, result.stderr


@pytest.mark.slow
def test_a_skipped_start_pose_is_in_the_report_and_said_with_a_point_cache(tmp_path, body):
    character = tmp_path / "avatar.glb"
    write_walker(character, tmp_path / "shirt.obj", body, start_poses=2)
    result = eslr(
        "simulate", "--body", character, "--simulator", "physics", "--frames", 3, "--iterations", 5,
        "--settle", 0, "--no-pictures", "--json", "--out", tmp_path / "out",
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    skipped = 2 / load_motion().fps
    assert json.loads(result.stdout)["motion_start_s"] == pytest.approx(skipped, rel=1e-3)
    result = eslr("export", tmp_path / "out", "--out", tmp_path / "shirt.pc2")
    assert result.returncode == 0, result.stderr
    assert result.stdout.strip() == str(tmp_path / "shirt.pc2")
    assert f"is {skipped:.3f} s after the first frame of the animation" in " ".join(result.stderr.split())


@pytest.mark.slow
def test_a_bundled_garment_is_carried_to_a_new_character_with_a_line_that_says_so(avatar, tmp_path):
    out, words = tmp_path / "out", ("--simulator", "physics", "--frames", 4, "--iterations", 20)
    result = eslr(
        "simulate", "--body", avatar / "avatar.glb", *words, "--no-pictures", "--json", "--out", out
    )
    assert result.returncode == 0, result.stderr
    report = json.loads(result.stdout)
    assert report["finite"]
    assert report["penetration_max_mm"] < 1.0
    (line,) = [line for line in result.stderr.splitlines() if line.startswith("tshirt carried to ")]
    assert "cut anew for it; its girth is 1.00 and its length 1.00" in line  # it is the bundled body, renamed
    fitted = tmp_path / "kept.npz"
    result = eslr(
        "fit",
        "tank",
        "--body",
        avatar / "avatar.glb",
        "--scale",
        "none",
        "--out",
        fitted,
        "--no-picture",
        "--json",
    )
    assert result.returncode == 0, result.stderr
    assert json.loads(result.stdout)["scale"] == "none"
    assert fitted.exists()


@pytest.mark.slow
def test_a_mesh_in_motion_is_a_body(avatar, tmp_path, body, walk):
    np.savez(tmp_path / "body.npz", positions=walk.positions[:5], faces=body.faces, fps=30)
    # The shirt that the walk starts in: a garment has to fit the first frame.
    from eslr_jax.assets import load_garment
    from eslr_jax.scene.build import skin_garment

    shirt = load_garment("tshirt")
    start = np.asarray(skin_garment(shirt, walk.joint_transforms))[0]
    garment = tmp_path / "shirt.obj"
    garment.write_text(obj_text("shirt", start, np.asarray(shirt.faces)))
    out = tmp_path / "out"
    result = eslr(
        "simulate", "--body", tmp_path / "body.npz", "--garment", garment, "--simulator", "physics",
        "--iterations", 20, "--no-pictures", "--json", "--out", out,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    run = read_trajectory(out / "trajectory.npz")
    np.testing.assert_allclose(run.body.positions, walk.positions[:5], atol=1e-6)
    assert json.loads(result.stdout)["finite"]


@pytest.mark.slow
def test_what_contradicts_is_refused_in_one_line(avatar, tmp_path, body):
    np.savez(tmp_path / "body.npz", positions=np.zeros((2, 3, 3)), faces=np.array([[0, 1, 2]]))
    cases = ((("--body", tmp_path / "body.npz", "--motion", "turn"), "follows no other"),)
    for arguments, word in cases:
        result = eslr(
            "simulate", *arguments, "--simulator", "physics", "--frames", 2, "--out", tmp_path / "out"
        )
        lines = [line for line in result.stderr.splitlines() if line.startswith("eslr: ")]
        assert result.returncode == 2, result.stderr
        assert len(lines) == 1
        assert word in lines[0]
    assert not (tmp_path / "out").exists(), "what is refused leaves no folder"


def test_the_joint_map_is_printed_and_written(avatar, tmp_path):
    result = eslr(
        "joints",
        "--body",
        "anny",
        "--motion",
        avatar / "avatar.glb",
        "--out",
        tmp_path / "map.json",
        "--json",
    )
    assert result.returncode == 0, result.stderr
    found = json.loads(result.stdout)
    assert json.loads((tmp_path / "map.json").read_text()) == found
    assert found["LeftArm"] == "mixamorig:LeftArm"
    assert found["Spine1"] == "mixamorig:Spine2"


@pytest.mark.slow
def test_a_character_of_200_m_is_scaled_with_a_line_and_wears_a_bundled_garment(tmp_path, body):
    write_walker(tmp_path / "giant.glb", tmp_path / "shirt.obj", body, size=118.0)
    out = tmp_path / "out"
    result = eslr(
        "simulate", "--body", tmp_path / "giant.glb", "--simulator", "physics", "--frames", 3, "--iterations", 20,
        "--no-pictures", "--json", "--out", out,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    assert "taken to be in cm" in result.stderr
    report = json.loads(result.stdout)
    assert report["finite"]
    assert report["motion"].endswith("giant.glb")
    run = read_trajectory(out / "trajectory.npz")
    assert 1.5 < np.ptp(run.body.positions[-1][:, 1]) < 2.2
    assert report["max_principal_stretch"] < 2.0
    assert report["penetration_max_mm"] < 1.0


@pytest.mark.slow
def test_the_default_shirt_is_carried_to_a_smpl_file(tmp_path):
    write_smpl(tmp_path / "smpl.pkl", smpl_female())
    result = eslr(
        "simulate", "--body", tmp_path / "smpl.pkl", "--simulator", "physics", "--frames", 3, "--iterations", 20,
        "--no-pictures", "--json", "--out", tmp_path / "out",
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    report = json.loads(result.stdout)
    assert report["finite"]
    assert report["garment"] == "tshirt"
    assert report["max_principal_stretch"] < 2.0
    assert report["penetration_max_mm"] < 1.0
    assert "tshirt carried to " in result.stderr
