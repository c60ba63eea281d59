"""A new character with a garment of its own, in one command; and a body that is a mesh in motion."""

import json

import numpy as np
import pytest
from commands import eslr, simulated, succeeded
from foreign_files import write_walker
from garment_shapes import write_obj

from eslr_jax import load_garment, load_motion, load_trajectory, pose_body, prepare_scene

SHORT = ("--frames", 4, "--iterations", 20)


@pytest.fixture(scope="module")
def avatar(tmp_path_factory, body):
    """A folder with a character as Mixamo's become in Blender, walking, and its shirt."""
    folder = tmp_path_factory.mktemp("avatar")
    write_walker(folder / "avatar.glb", folder / "shirt.obj", body)
    return folder


@pytest.mark.slow
def test_a_new_character_with_its_garment_is_one_command(avatar, tmp_path, body):
    out = tmp_path / "out"
    words = ("--body", avatar / "avatar.glb", "--garment", avatar / "shirt.obj", *SHORT)
    report, _ = simulated(out, *words)
    assert report["motion"].endswith("avatar.glb")  # its own animation
    run = load_trajectory(out)
    assert run.positions.shape == (4, 1000, 3)
    expected = pose_body(body, load_motion(), arm_abduction=0.0, num_frames=4)
    distance = np.linalg.norm(run.body.positions - np.asarray(expected.positions), axis=-1)
    assert np.quantile(distance, 0.99) < 2e-3  # [m]: glTF kept four of up to seven influences
    assert distance.max() < 0.015
    succeeded(eslr("export", out, "--out", tmp_path / "shirt.pc2"))


@pytest.mark.slow
def test_a_skipped_start_pose_is_in_the_report_and_said_with_a_point_cache(tmp_path, body):
    character, out = tmp_path / "avatar.glb", tmp_path / "out"
    write_walker(character, tmp_path / "shirt.obj", body, start_poses=2)
    report, _ = simulated(out, "--body", character, "--settle", 0, "--frames", 3, "--iterations", 5)
    skipped = 2 / load_motion().fps
    assert report["motion_start_s"] == pytest.approx(skipped, rel=1e-3)
    done = succeeded(eslr("export", out, "--out", tmp_path / "shirt.pc2"))
    assert done.stdout.strip() == str(tmp_path / "shirt.pc2")
    assert f"is {skipped:.3f} s after the first frame of the animation" in " ".join(done.stderr.split())


@pytest.mark.slow
def test_a_bundled_garment_is_carried_to_a_new_character_with_a_line_that_says_so(avatar, tmp_path):
    report, said = simulated(tmp_path / "out", "--body", avatar / "avatar.glb", *SHORT)
    assert report["penetration_max_mm"] < 1.0
    (line,) = [line for line in said.splitlines() if line.startswith("tshirt carried to ")]
    assert "cut anew for it; its girth is 1.00 and its length 1.00" in line  # it is the bundled body, renamed
    words = ("--scale", "none", "--out", tmp_path / "kept.npz", "--no-picture", "--json")
    done = succeeded(eslr("fit", "tank", "--body", avatar / "avatar.glb", *words))
    assert json.loads(done.stdout)["scale"] == "none"
    assert (tmp_path / "kept.npz").exists()


@pytest.mark.slow
def test_a_mesh_in_motion_is_a_body(tmp_path, walk):
    moving, garment, out = tmp_path / "body.npz", tmp_path / "shirt.obj", tmp_path / "out"
    np.savez(moving, positions=walk.positions[:5], faces=walk.faces, fps=30)
    # The shirt that the walk starts in: a garment has to fit the first frame.
    shirt = load_garment("tshirt")
    start = np.asarray(prepare_scene(shirt, walk).initial_state.position)
    write_obj(garment, (start, np.asarray(shirt.faces)))
    simulated(out, "--body", moving, "--garment", garment, "--iterations", 20)
    run = load_trajectory(out)
    np.testing.assert_allclose(run.body.positions, walk.positions[:5], atol=1e-6)
