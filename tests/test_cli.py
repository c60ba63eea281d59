"""The command line as a user meets it."""

import json
import subprocess
import sys

import numpy as np
import pytest
import trimesh


def eslr(*arguments, cwd=None):
    command = [sys.executable, "-m", "eslr_jax.cli", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, check=False)


def refused(result, *words):
    lines = [line for line in result.stderr.strip().splitlines() if line.startswith("eslr: ")]
    assert result.returncode == 2, result.stderr
    assert len(lines) == 1, result.stderr
    assert "Traceback" not in result.stderr
    for word in words:
        assert word in lines[0]


@pytest.mark.slow
def test_simulate_writes_everything(tmp_path):
    result = eslr(
        "simulate", "--simulator", "physics", "--frames", 4, "--iterations", 20, "--out", tmp_path, "--json"
    )
    assert result.returncode == 0, result.stderr
    report = json.loads(result.stdout)
    for key in (
        "finite", "num_frames", "num_vertices", "terms", "total", "max_principal_stretch",
        "penetration_p999_mm", "penetration_max_mm", "penetrating_share", "frame_ms", "compile_s", "device",
        "versions",
    ):  # fmt: skip
        assert key in report
    assert report["num_frames"] == 4
    assert json.loads((tmp_path / "report.json").read_text()) == report
    assert {path.name for path in tmp_path.iterdir()} == {
        "trajectory.npz", "animation.glb", "sheet.png", "report.json",
    }  # fmt: skip


def test_assets_lists_every_kind():
    result = eslr("assets", "--json", "--verify")
    kinds = {asset["kind"] for asset in json.loads(result.stdout)}
    assert {"body", "garment", "motion"} <= kinds


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--garment", "tshrit"), ("no garment named", "tshirt")),
        (("--motion", "moonwalk"), ("no motion named", "cmu_016_32")),
        (("--body", "robot"), ("no body named", "anny")),
        (("--garment", "missing.obj"), ("missing.obj",)),
        (("--frames", "1"), ("two frames",)),
        (("--frames", "100000", "--simulator", "physics"), ("fewer than",)),
    ],
)
def test_unknown_names_are_refused_in_one_line(tmp_path, arguments, words):
    refused(eslr("simulate", "--out", tmp_path / "out", *arguments), *words)
    assert not list(tmp_path.glob("out/*"))


def test_unwritable_output_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    refused(eslr("simulate", "--out", tmp_path / "file"), "is a file")


def test_broken_mesh_is_refused(tmp_path):
    mesh = trimesh.creation.icosphere(radius=20.0)
    path = tmp_path / "large.obj"
    mesh.export(path)
    refused(eslr("simulate", "--garment", path, "--simulator", "physics", "--out", tmp_path / "out"), "scale")
    empty = tmp_path / "empty.obj"
    empty.write_text("")
    refused(
        eslr("simulate", "--garment", empty, "--simulator", "physics", "--out", tmp_path / "out"), "empty.obj"
    )


def test_broken_motion_is_refused(tmp_path):
    path = tmp_path / "walk.npz"
    np.savez(path, something=np.zeros(3))
    refused(
        eslr("simulate", "--motion", path, "--simulator", "physics", "--out", tmp_path / "out"), "no motion"
    )
