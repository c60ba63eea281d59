"""A format is one file, and this is one: the public functions and the command know it by its suffix."""

import contextlib
import os
import sys

import numpy as np
import pytest
from broken import refuses

from eslr_jax import AssetError
from eslr_jax.files.atomic import atomic_write, ensure_output_dir
from eslr_jax.files.npz import read_arrays, write_arrays
from eslr_jax.pipeline.assets.catalog import find_asset
from eslr_jax.pipeline.cli import app
from eslr_jax.pipeline.cli.runs import Export
from eslr_jax.pipeline.formats.bundled import read_body, read_motion_archive
from eslr_jax.pipeline.formats.garment import read_garment_source
from eslr_jax.pipeline.formats.mesh import MeshFile, read_mesh_file
from eslr_jax.pipeline.formats.mesh_sequence import MeshSequence, read_mesh_sequence
from eslr_jax.pipeline.formats.registry import reader, writer
from eslr_jax.pipeline.formats.trajectory import TrajectoryFile, write_trajectory

POSITIONS = np.random.default_rng(0).normal(size=(3, 4, 3)).astype(np.float32)
FACES = np.array([[0, 1, 2], [0, 2, 3]])


@writer("animation", [".rows"])
def write_rows(path, meshes, timestep):
    """Faces and vertices as rows of text, one frame after another."""
    rows = np.concatenate([meshes[0].faces, *meshes[0].positions])
    np.savetxt(path, rows, header=f"{len(meshes[0].faces)} {len(meshes[0].positions)} {timestep:.9g}")


@reader("mesh sequence", [".rows"])
def read_rows(path, _mesh, fps):
    with path.open() as stream:
        num_faces, num_frames, timestep = map(float, stream.readline().split()[1:])
    faces, points = np.split(np.loadtxt(path), [int(num_faces)])
    positions = points.reshape(int(num_frames), -1, 3)
    return [MeshSequence(path.name, positions, faces.astype(int), fps or 1 / timestep)]


@reader("mesh", [".rows"])
def read_first_rows(path, _like):
    (sequence,) = read_rows(path, "", None)
    return MeshFile(sequence.positions[0], sequence.faces)


@pytest.fixture
def run(tmp_path):
    write_trajectory(tmp_path / "trajectory.npz", TrajectoryFile(POSITIONS, POSITIONS, FACES, 1 / 25))
    return tmp_path


def test_a_run_is_exported_and_read_in_a_format_of_one_file(run, capsys):
    Export(run, run / "run.rows")()
    assert capsys.readouterr().out == f"{run / 'run.rows'}\n"
    sequence = read_mesh_sequence(run / "run.rows")
    np.testing.assert_array_equal(sequence.positions.astype(np.float32), POSITIONS)
    assert sequence.fps == pytest.approx(25.0)
    Export(run, run / "other", format="rows", content="garment")()
    assert (run / "other").read_bytes() == (run / "run.rows").read_bytes()
    for mesh in (read_mesh_file(run / "run.rows"), read_garment_source(run / "run.rows")):
        np.testing.assert_array_equal(mesh.positions.astype(np.float32), POSITIONS[0])
        np.testing.assert_array_equal(mesh.faces, FACES)


def test_it_is_named_in_help_and_in_errors(run, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["eslr", "export", "--help"])
    with pytest.raises(SystemExit):
        app.cli(prog="eslr")
    assert ", rows" in capsys.readouterr().out
    with pytest.raises(AssetError, match=r"name one with --format: .*glb, .*rows"):
        Export(run, run / "run.xyz")()
    with pytest.raises(AssetError, match=r"'\.xyz'; give one of .*\.rows"):
        read_mesh_file(run / "run.xyz")
    with pytest.raises(AssetError, match="suffix of another format than glb"):
        Export(run, run / "run.rows", format="glb")()


def test_whatever_its_reader_raises_is_one_named_line(tmp_path):
    (tmp_path / "a.rows").write_text("nonsense\n")
    refuses(read_mesh_file, tmp_path / "a.rows", "a.rows can't be read")


# --- the bundled formats of bodies and motions --------------------------------------------------------------

CLIP = {
    "joint_names": np.array(["a", "b"]),
    "walk/rotations": np.random.default_rng(0).normal(size=(4, 2, 3)),
    "walk/translations": np.random.default_rng(1).normal(size=(4, 3)),
    "walk/fps": np.array(33.3),
}


def test_a_clip_comes_back_exactly(tmp_path):
    write_arrays(tmp_path / "a.npz", CLIP)
    clip = read_motion_archive(tmp_path / "a.npz")["walk"]
    np.testing.assert_array_equal(clip.rotations, CLIP["walk/rotations"])
    np.testing.assert_array_equal(clip.translations, CLIP["walk/translations"])
    assert (clip.fps, clip.joint_names) == (33.3, ("a", "b"))


def test_skin_weights_of_a_body_sum_to_one(tmp_path):
    bundled = read_arrays(find_asset("body", "anny"), content="body")
    write_arrays(tmp_path / "body.npz", {**bundled, "skin_weights": 0.97 * bundled["skin_weights"]})
    np.testing.assert_allclose(
        read_body(tmp_path / "body.npz").skin_weights, bundled["skin_weights"], atol=1e-6
    )


# --- files appear whole or not at all -----------------------------------------------------------------------


def test_atomic_write_replaces_the_file_and_keeps_the_suffix(tmp_path):
    target = tmp_path / "result.npz"
    target.write_text("old")
    with atomic_write(target) as temporary:
        assert temporary.parent == tmp_path
        assert temporary.suffix == ".npz"
        temporary.write_text("new")
        assert target.read_text() == "old"
    assert target.read_text() == "new"
    assert os.listdir(tmp_path) == ["result.npz"]


def test_atomic_write_failure_leaves_everything_as_before(tmp_path):
    target = tmp_path / "result.npz"
    target.write_text("old")
    with contextlib.suppress(KeyboardInterrupt), atomic_write(target) as temporary:
        temporary.write_text("half")
        raise KeyboardInterrupt
    assert target.read_text() == "old"
    assert os.listdir(tmp_path) == ["result.npz"]


@pytest.mark.parametrize("place", ["", "missing/file", "file"])
def test_atomic_write_names_an_impossible_target_and_a_block_that_wrote_nothing(tmp_path, place):
    with pytest.raises(AssetError, match="can't write"), atomic_write(tmp_path / place):
        pass


def test_ensure_output_dir_creates_parents_and_names_a_file_in_the_way(tmp_path):
    assert not os.listdir(ensure_output_dir(tmp_path / "a" / "b"))
    (tmp_path / "file").write_text("")
    for name in ("file", "file/below"):
        with pytest.raises(AssetError, match="output folder"):
            ensure_output_dir(tmp_path / name)
