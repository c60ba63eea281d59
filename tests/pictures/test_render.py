"""Pictures: what is where, what is refused; looks are judged by eye."""

import os
import sys

import numpy as np
import pytest
import trimesh

from eslr_jax import AssetError, ConfigError, MeshError, MissingExtraError, NonFiniteError
from eslr_jax.pipeline.pictures import (
    add_color_bar,
    color_scale,
    contact_sheet,
    render_frame,
    render_frames,
    write_png,
    write_video,
)

SMALL = {"size": (48, 64), "samples": 4}


@pytest.fixture
def scene():
    """A ball as body and a smaller one as cloth on its +X side, three frames moving along +Z."""
    pytest.importorskip("mitsuba")
    body = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
    cloth = trimesh.creation.icosphere(subdivisions=2, radius=0.2)
    steps = np.arange(3)[:, None, None] * np.array([0.0, 0.0, 0.5])
    return {
        "body_positions": np.asarray(body.vertices) + steps,
        "body_faces": np.asarray(body.faces),
        "garment_positions": np.asarray(cloth.vertices) + np.array([0.5, 0.0, 0.0]) + steps,
        "garment_faces": np.asarray(cloth.faces),
    }


def first_frame(scene):
    return {name: value[0] if name.endswith("positions") else value for name, value in scene.items()}


def is_blue(picture):
    """Tell the pixels where the blue cloth is."""
    pixels = picture.astype(int)
    return pixels[..., 2] - pixels[..., 0] > 25


def blue_columns(picture):
    """Return the mean column of the blue cloth, relative to the picture's width."""
    return np.nonzero(is_blue(picture))[1].mean() / picture.shape[1]


def test_render_frame_shows_the_cloth_on_the_right_side_of_the_body(scene):
    front = render_frame(**first_frame(scene), camera="front", **SMALL)
    back = render_frame(**first_frame(scene), camera="back", **SMALL)
    assert front.shape == (64, 48, 3)
    assert front.dtype == np.uint8
    # Seen from +Z with Y up, +X is on the right; seen from -Z it is on the left.
    assert blue_columns(front) > 0.6
    assert blue_columns(back) < 0.4
    by_name, by_angle = (render_frame(**first_frame(scene), camera=name, **SMALL) for name in ("side", 90.0))
    np.testing.assert_array_equal(by_name, by_angle)
    assert blue_columns(by_name) == pytest.approx(
        0.5, abs=0.03
    )  # the cloth is before the body: its left side


def test_render_frame_repeats_and_needs_no_body(scene):
    arguments = first_frame(scene) | {"body_positions": None, "body_faces": None}
    first, second = (render_frame(**arguments, **SMALL).astype(int) for _ in range(2))
    assert np.abs(first - second).max() <= 1  # threads add up a pixel's samples in any order


def test_render_frame_paints_vertex_colors(scene):
    arguments = first_frame(scene)
    colors = np.tile([0.1, 0.8, 0.1], (len(arguments["garment_positions"]), 1))
    picture = render_frame(**arguments, vertex_colors=colors, **SMALL).astype(int)
    assert ((picture[..., 1] - picture[..., 0] > 40) & (picture[..., 1] - picture[..., 2] > 40)).sum() > 20


def test_render_frames_follow_the_body(scene):
    first, last = render_frames(**scene, frame_indices=[0, 2], **SMALL)
    # The subject moves as a whole, so the camera sees the same picture but for noise of the light.
    assert np.abs(first.astype(int) - last).mean() < 3


def test_the_front_turns_with_the_body(scene):
    """Cloth at the body's left is on the right of every picture, wherever the body faces."""
    quarter = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])  # +Z becomes +X
    rest = scene["body_positions"][0] * [1.0, 1.3, 0.4]  # wider than deep, as a person
    cloth = scene["garment_positions"][0]
    moved = scene | {
        "body_positions": np.repeat((rest @ quarter.T)[None], 3, axis=0),
        "garment_positions": np.repeat((cloth @ quarter.T)[None], 3, axis=0),
    }
    (picture,) = render_frames(**moved, rest_positions=rest, frame_indices=[1], **SMALL)
    assert blue_columns(picture) > 0.6
    (fixed,) = render_frames(**moved, frame_indices=[1], **SMALL)
    assert not is_blue(fixed).any()  # the left is behind the body


def test_the_front_turns_evenly_through_whole_turns(scene):
    turns = np.linspace(0.0, 7.0, 40)
    cosine, sine, zero = np.cos(turns), np.sin(turns), np.zeros(40)
    rows = [(cosine, zero, sine), (zero, zero + 1.0, zero), (-sine, zero, cosine)]
    rotations = np.array(rows).transpose(2, 0, 1)
    rest = scene["body_positions"][0] * [1.0, 1.3, 0.4]
    turned = scene | {
        "body_positions": rest @ rotations.transpose(0, 2, 1),
        "garment_positions": scene["garment_positions"][0] @ rotations.transpose(0, 2, 1),
    }
    pictures = render_frames(**turned, rest_positions=rest, frame_indices=[0, 17, 18, 39], **SMALL)
    first, *others = (picture.astype(int) for picture in pictures)
    assert max(np.abs(picture - first).mean() for picture in others) < 3


def test_zoom_enlarges_the_garment_and_looks_at_it(scene):
    whole, close = (is_blue(next(render_frames(**scene, zoom=zoom, **SMALL))) for zoom in (1.01, 2.02))
    assert close.sum() == pytest.approx(4 * whole.sum(), rel=0.15)
    row, column = np.argwhere(close).mean(axis=0)
    assert row == pytest.approx(31.5, abs=1.5)
    assert column == pytest.approx(23.5, abs=6)  # its left half is inside the body


def test_a_color_bar_spans_the_scale_under_the_picture():
    pytest.importorskip("PIL")
    picture = np.zeros((60, 200, 3), np.uint8)
    found = add_color_bar(picture, 0.0, 2.0, "stretch")
    np.testing.assert_array_equal(found[:60], picture)
    ends = np.round(255 * color_scale(np.array([0.0, 1.0]), 0.0, 1.0))
    rows = (found[60:] == ends[0]).all(axis=2).any(axis=1)
    bar = found[60:][np.argmax(rows)]
    is_ramp = ~(bar == 255).all(axis=1)
    np.testing.assert_array_equal(bar[is_ramp][[0, -1]], ends)
    assert is_ramp.sum() > 180


def test_contact_sheet_tiles_frames_and_reports_progress(scene):
    done = []
    sheet = contact_sheet(
        **scene, num_frames=8, columns=2, on_picture=lambda *counts: done.append(counts), **SMALL
    )
    assert sheet.shape == (2 * 64 + 4, 2 * 48 + 4, 3)  # three frames exist
    assert done == [(1, 3), (2, 3), (3, 3)]
    assert (sheet[68:, 52:] == 255).all()


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"camera": "top"}, ConfigError),
        ({"camera": float("nan")}, ConfigError),
        ({"size": (0, 10)}, ConfigError),
        ({"samples": 0}, ConfigError),
        ({"zoom": 0.0}, ConfigError),
        ({"garment_positions": np.full((162, 3), np.nan)}, NonFiniteError),
        ({"garment_faces": np.array([[0, 1, 999]])}, MeshError),
        ({"garment_faces": np.zeros((0, 3), int)}, MeshError),
        ({"body_faces": None}, MeshError),
        ({"vertex_colors": np.zeros((3, 3))}, MeshError),
    ],
)
def test_render_frame_names_what_is_wrong(scene, change, error):
    with pytest.raises(error):
        render_frame(**(first_frame(scene) | SMALL | change))


def test_contact_sheet_refuses_to_be_empty(scene):
    with pytest.raises(ConfigError, match="empty"):
        contact_sheet(**scene, num_frames=0)


def test_rendering_without_the_extra_names_it(scene, monkeypatch):
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    with pytest.raises(MissingExtraError, match=r'pip install "eslr-jax\[render\]"'):
        render_frame(**first_frame(scene))


@pytest.mark.parametrize(("extents", "size"), [
    ((0.8, 1.8, 0.8), (28, 40)), ((2.0, 0.2, 2.0), (40, 40)), ((1.0, 1.0, 1.0), (40, 20)),
])  # fmt: skip
def test_the_whole_subject_fills_the_picture_from_anywhere(extents, size):
    pytest.importorskip("mitsuba")
    cylinder = trimesh.creation.cylinder(radius=0.5, height=1.0).apply_transform(
        trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0])
    )
    positions = cylinder.vertices * extents + [1.0, 2.0, 3.0]
    for camera in (0.0, 57.0, 230.0):
        picture = render_frame(None, None, positions, cylinder.faces, camera=camera, size=size, samples=4)
        rows, columns = np.nonzero(is_blue(picture))
        shares = np.ptp(columns) / size[0], np.ptp(rows) / size[1]
        assert 0.7 < max(shares) < 0.97
        assert min(columns.min(), rows.min()) > 0
        assert min(size[0] - 1 - columns.max(), size[1] - 1 - rows.max()) > 0


def test_few_rays_are_as_good_as_many(scene):
    """The denoiser takes the grain, and keeps the edges."""
    arguments = first_frame(scene) | {"size": (48, 64)}
    few, many = (render_frame(**arguments, samples=samples).astype(int) for samples in (9, 200))
    assert np.abs(few - many).mean() < 0.01 * 255
    assert np.abs(few - many).max() < 0.2 * 255


def test_write_png_round_trips(tmp_path):
    image_module = pytest.importorskip("PIL.Image")
    picture = np.random.default_rng(0).integers(0, 256, (7, 5, 3), dtype=np.uint8)
    write_png(tmp_path / "a.png", picture)
    with image_module.open(tmp_path / "a.png") as image:
        np.testing.assert_array_equal(np.asarray(image), picture)


def test_write_video_holds_every_frame(tmp_path):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    frames = [np.full((49, 65, 3), value, np.uint8) for value in (0, 80, 160, 240)]
    write_video(tmp_path / "a.mp4", frames, fps=10)
    num_frames, seconds = ffmpeg.count_frames_and_secs(str(tmp_path / "a.mp4"))
    assert num_frames == 4
    assert seconds == pytest.approx(0.4, abs=0.05)
    assert os.listdir(tmp_path) == ["a.mp4"]


PICTURE = np.zeros((4, 4, 3), np.uint8)


@pytest.mark.parametrize("picture", [PICTURE[..., 0], PICTURE.astype(float), PICTURE[:0]])
def test_write_png_refuses_what_is_no_picture(tmp_path, picture):
    pytest.importorskip("PIL")
    with pytest.raises(AssetError, match="not uint8"):
        write_png(tmp_path / "a.png", picture)
    assert not os.listdir(tmp_path)


@pytest.mark.parametrize("frames", [[], [PICTURE, PICTURE[:2]]])
def test_write_video_refuses_no_frames_and_mixed_sizes(tmp_path, frames):
    pytest.importorskip("imageio_ffmpeg")
    with pytest.raises(AssetError):
        write_video(tmp_path / "a.mp4", frames, fps=10)
    assert not os.listdir(tmp_path)


def test_color_scale_ends_and_order():
    colors = color_scale(np.array([-9.0, 0.0, 0.5, 1.0, 9.0, np.nan]), 0.0, 1.0)
    np.testing.assert_array_equal(colors[0], colors[1])
    np.testing.assert_array_equal(colors[3], colors[4])
    np.testing.assert_array_equal(colors[5], colors[1])
    lightness = color_scale(np.linspace(0, 1, 30), 0.0, 1.0) @ [0.3, 0.6, 0.1]
    assert np.all(np.diff(lightness) > 0)
