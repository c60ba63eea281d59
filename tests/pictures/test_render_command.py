"""`eslr render`: a film, a sheet, one moment of a run."""

import re

import numpy as np
import pytest
from commands import eslr_here
from example_runs import write_run

from eslr_jax.pipeline.report.fields import FIELDS


@pytest.fixture(scope="module")
def run(tmp_path_factory, body):
    return write_run(tmp_path_factory.mktemp("runs"), body, "run")


def shape_of(path):
    image_module = pytest.importorskip("PIL.Image")
    with image_module.open(path) as image:
        return np.asarray(image).shape


def test_one_moment_is_one_picture_with_its_color_bar(run, tmp_path):
    pytest.importorskip("mitsuba")
    plain, colored = tmp_path / "plain.png", tmp_path / "colored.png"
    size = ("--width", 60, "--samples", 1)
    assert eslr_here("render", run, "--out", plain, "--at", "0.1s", *size).returncode == 0
    assert shape_of(plain) == (80, 60, 3)
    look = ("--color", "stretch", "--zoom", 2)
    assert eslr_here("render", run, "--out", colored, "--at", "3", *look, *size).returncode == 0
    height, width, _ = shape_of(colored)
    assert height > 80
    assert width == 60


def test_render_knows_every_field():
    text = " ".join(eslr_here("render", "--help").stdout.replace("│", " ").split())
    (colors,) = re.findall(r"--color \{(.*?)\}", text)
    assert set(colors.replace(" ", "").split(",")) == {"fabric", *FIELDS}
