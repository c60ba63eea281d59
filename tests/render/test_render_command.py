"""`eslr render`: a film, a sheet, one moment of a run."""

import typing

import numpy as np
import pytest
from eslr_jax.cli.moment import parse_seconds
from example_runs import write_run

from eslr_jax.cli.runs import render
from eslr_jax.errors import ConfigError
from eslr_jax.evaluation.fields import FIELDS


@pytest.fixture(scope="module")
def run(tmp_path_factory, body):
    return write_run(tmp_path_factory.mktemp("runs"), body, "run")


def shape_of(path):
    image_module = pytest.importorskip("PIL.Image")
    with image_module.open(path) as image:
        return np.asarray(image).shape


def test_one_moment_is_one_picture_with_its_color_bar(run, tmp_path):
    pytest.importorskip("mitsuba")
    render(run, tmp_path / "plain.png", at="0.1s", width=60, samples=1)
    assert shape_of(tmp_path / "plain.png") == (80, 60, 3)
    render(run, tmp_path / "colored.png", at="3", color="stretch", width=60, samples=1, zoom=2.0)
    height, width, _ = shape_of(tmp_path / "colored.png")
    assert height > 80
    assert width == 60


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"frames": 0}, "--frames 0"),
        ({"at": "9s"}, r"ends at frame 5, 0\.17 s"),
        ({"at": "noon"}, "a frame, such as 375"),
        ({"at": "1", "frames": 2}, "no --frames"),
    ],
)
def test_impossible_pictures_are_refused(run, tmp_path, options, message):
    with pytest.raises(ConfigError, match=message):
        render(run, tmp_path / "a.png", **options)
    assert not list(tmp_path.iterdir())


def test_moments_are_frames_or_seconds():
    assert parse_seconds("375", 30.0, option="--at") == 12.5
    assert parse_seconds("12.5s", 30.0, option="--at") == 12.5
    for text in ("-1", "-1s", "1.5", "s", "nan", "infs", ""):
        with pytest.raises(ConfigError, match="--at"):
            parse_seconds(text, 30.0, option="--at")


def test_render_knows_every_field():
    colors = typing.get_type_hints(render)["color"]
    assert set(typing.get_args(colors)) == {"fabric", *FIELDS}
