"""A format is one file, and this is one: the public functions and the command know it by its suffix."""

import sys

import numpy as np
import pytest

from eslr_jax import AssetError, load_body, load_motion
from eslr_jax.pipeline.cli import app
from eslr_jax.pipeline.cli.runs import Export
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
    with pytest.raises(AssetError, match=r"file .*a\.rows can't be read") as caught:
        read_mesh_file(tmp_path / "a.rows")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("load", [load_body, load_motion])
def test_fbx_is_refused_with_the_way_out(tmp_path, load):
    (tmp_path / "avatar.fbx").write_bytes(b"Kaydara FBX Binary  \0")
    with pytest.raises(AssetError, match=r"export it as glTF .*File > Export > glTF 2\.0"):
        load(tmp_path / "avatar.fbx")
