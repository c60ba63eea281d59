"""`eslr render`: a film, a sheet, one moment of a run."""

import typing

import numpy as np
import pytest
from commands import eslr_here
from example_runs import write_run

from eslr_jax.pipeline.cli.options import parse_seconds
from eslr_jax.pipeline.cli.runs import Render
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


def test_moments_are_frames_or_seconds():
    assert parse_seconds("375", 30.0, option="--at") == 12.5
    assert parse_seconds("12.5s", 30.0, option="--at") == 12.5


def test_render_knows_every_field():
    colors = typing.get_type_hints(Render)["color"]
    assert set(typing.get_args(colors)) == {"fabric", *FIELDS}
