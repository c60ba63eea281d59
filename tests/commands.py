"""Commands of `eslr`, as a user types them: in a process of their own, or cheaply in this one."""

import contextlib
import io
import json
import subprocess
import sys
import warnings
from unittest import mock

import numpy as np
from scipy.spatial import cKDTree

from eslr_jax.pipeline.cli import main


def eslr(*words, cwd=None):
    """Run a command in a process of its own."""
    command = [sys.executable, "-m", "eslr_jax.pipeline.cli", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, check=False, timeout=600)


def eslr_here(*words):
    """Run a command in this process, through the program's own entry."""
    out, err, code = io.StringIO(), io.StringIO(), 0
    with (
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        mock.patch.object(sys, "argv", ["eslr", *map(str, words)]),
        warnings.catch_warnings(),
    ):
        try:
            main()
        except SystemExit as end:
            code = end.code or 0
    return subprocess.CompletedProcess(words, code, out.getvalue(), err.getvalue())


def succeeded(done):
    """Check that a command ended well, and return it."""
    assert done.returncode == 0, done.stderr
    return done


def refused(done, *causes):
    """Check that a command ended with exit code 2 and one line that names the cause and what to do."""
    lines = [line for line in done.stderr.splitlines() if line.startswith("eslr: ")]
    assert done.returncode == 2, done.stderr
    assert len(lines) == 1, done.stderr
    assert "Traceback" not in done.stderr
    assert len(lines[0]) > 25  # more than a name
    for cause in causes:
        assert cause in lines[0]


def simulated(out, *words):
    """Simulate by the solver; return the report, and what is said beside it."""
    options = ("--simulator", "physics", "--no-pictures", "--json", "--out", out)
    done = succeeded(eslr("simulate", *words, *options))
    report = json.loads(done.stdout)
    assert report["finite"]
    return report, done.stderr


def worn(out, *words):
    """Simulate by the solver; return the report, and the arrays of the trajectory."""
    report, _ = simulated(out, *words)
    with np.load(out / "trajectory.npz") as arrays:
        return report, dict(arrays)


def slip(trajectory, band=0.03):
    """Return how far the top of a garment sank along the body by the last frame [m]."""
    cloth, body = trajectory["positions"], trajectory["body_positions"]
    top = cloth[0, :, 1] > cloth[0, :, 1].max() - band
    _, nearest = cKDTree(body[0]).query(cloth[0, top])
    height = cloth[:, top, 1] - body[:, nearest, 1]
    return float(np.mean(height[0] - height[-1]))
