"""What works without any extra: everything but pictures, pages, films and remeshing."""

import json
import subprocess
import sys

import numpy as np
import pytest
from commands import refused, succeeded

# Packages of the extras, and of the development environment.
EXTRAS = (
    "mitsuba", "PIL", "viser", "pxr", "imageio_ffmpeg", "matplotlib", "pyacvd", "pyvista", "pythoncdt",
    "tensorboardX", "ipctk", "pygeodesic", "torch", "newton", "warp", "bpy", "beartype", "hypothesis", "pytest",
)  # fmt: skip
WITHOUT = f"""
import sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {EXTRAS}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Missing())
"""
SHORT = ("simulate", "--frames", "5", "--simulator", "physics", "--iterations", "5")


def run(code: str, *arguments: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-c", WITHOUT + code, *arguments], capture_output=True, text=True, timeout=600
    )


def eslr(*arguments: str) -> subprocess.CompletedProcess:
    return run("from eslr_jax.pipeline.cli import main; main()", *arguments)


def test_every_public_name_loads_without_extras():
    code = "import eslr_jax; print([getattr(eslr_jax, name) for name in eslr_jax.__all__])"
    assert "rollout" in succeeded(run(code)).stdout


@pytest.mark.slow
def test_simulate_works_without_extras(tmp_path):
    done = succeeded(eslr(*SHORT, "--no-pictures", "--json", "--out", str(tmp_path)))
    report = json.loads(done.stdout)
    assert report["finite"]
    assert report["num_frames"] == 5
    assert not list(tmp_path.glob("*.png"))
    with np.load(tmp_path / "trajectory.npz") as trajectory:
        assert trajectory["positions"].shape[0] == 5
    assert (tmp_path / "animation.glb").read_bytes()[:4] == b"glTF"


@pytest.mark.slow
def test_a_missing_extra_is_named_in_one_line(tmp_path):
    """Pictures are part of a run that goes on without them; a command that makes nothing else ends."""
    extra = 'this needs mitsuba, which is not installed: pip install "eslr-jax[render]"'
    done = succeeded(eslr(*SHORT, "--out", str(tmp_path)))
    (line,) = [line for line in done.stderr.splitlines() if "eslr-jax[" in line]
    assert f"no pictures: {extra}" in line
    assert "Traceback" not in done.stderr
    assert (tmp_path / "trajectory.npz").exists()
    refused(eslr("render", str(tmp_path), "--out", str(tmp_path / "sheet.png")), extra)
