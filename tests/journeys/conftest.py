"""Shared steps of journeys: the command line as a user runs it, and what becomes of a simulated garment."""

from __future__ import annotations

import json
from pathlib import Path

import commands
import numpy as np
import pytest
from scipy.spatial import cKDTree


def pytest_collection_modifyitems(items):
    """Mark every journey as slow."""
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.slow)


@pytest.fixture(scope="session")
def eslr():
    """A function that runs `eslr` with words and returns the finished process."""

    return commands.eslr


@pytest.fixture(scope="session")
def fit_report(eslr):
    """A function that fits a file with `eslr fit` and returns its report."""

    def run(path, *options):
        out = path.with_suffix(".npz") if path.suffix != ".npz" else path.with_name(f"{path.stem}_fitted.npz")
        result = eslr("fit", path, "--out", out, "--no-picture", "--json", *options)
        assert result.returncode == 0, result.stderr
        assert out.exists()
        return json.loads(result.stdout)

    return run


@pytest.fixture(scope="session")
def worn(eslr):
    """A function that simulates a garment file as the command does; it returns the report and the arrays."""

    def run(path, out, *options, frames=20):
        words = ("--simulator", "physics", "--frames", frames, "--no-pictures", "--json")
        result = eslr("simulate", "--garment", path, *words, *options, "--out", out)
        assert result.returncode == 0, result.stderr
        with np.load(out / "trajectory.npz") as arrays:
            return json.loads(result.stdout), dict(arrays)

    return run


@pytest.fixture(scope="session")
def slip():
    """A function that returns how far the top of a garment sank along the body by the last frame [m]."""

    def measure(trajectory, band=0.03):
        cloth, body = trajectory["positions"], trajectory["body_positions"]
        top = cloth[0, :, 1] > cloth[0, :, 1].max() - band
        _, nearest = cKDTree(body[0]).query(cloth[0, top])
        height = cloth[:, top, 1] - body[:, nearest, 1]
        return float(np.mean(height[0] - height[-1]))

    return measure
