"""Pictures of a garment on a body: one frame, many frames, a contact sheet."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from eslr_jax.errors import ConfigError, MeshError, NonFiniteError
from eslr_jax.extras import require
from eslr_jax.render.camera import Camera, parse_angle, place_camera
from eslr_jax.render.scene import Surface, trace_picture

GARMENT_COLOR = (0.30, 0.50, 0.70)  # sRGB
BODY_COLOR = (0.88, 0.73, 0.64)  # sRGB
_PICTURE_SIZE = (480, 640)  # width, height [pixels]
_SHEET_PICTURE_SIZE = (280, 400)  # width, height [pixels]
_SAMPLES = 16  # camera rays per pixel: the noise is just not seen


def render_frame(
    body_positions: np.ndarray | None,
    body_faces: np.ndarray | None,
    garment_positions: np.ndarray,
    garment_faces: np.ndarray,
    *,
    camera: str | float = "front",
    size: tuple[int, int] = _PICTURE_SIZE,
    garment_color: tuple[float, float, float] = GARMENT_COLOR,
    vertex_colors: np.ndarray | None = None,
    samples: int = _SAMPLES,
) -> np.ndarray:
    """Render one picture.

    Args:
        body_positions: Body vertex positions [m], shape [body_vertices, 3]; None without a body.
        body_faces: Body triangles, shape [body_faces, 3]; None without a body.
        garment_positions: Garment vertex positions [m], shape [vertices, 3].
        garment_faces: Garment triangles, shape [faces, 3].
        camera: "front" (from +Z), "side" (from +X), "back", or degrees from the front towards the side.
        size: Width and height [pixels].
        garment_color: sRGB in [0, 1].
        vertex_colors: sRGB in [0, 1] per garment vertex, shape [vertices, 3]; replaces `garment_color`.
        samples: Camera rays per pixel; noise falls with its root, time grows with it.

    Returns:
        sRGB picture, uint8, shape [height, width, 3].

    Raises:
        MeshError: If faces and positions disagree.
        NonFiniteError: If a position is NaN or infinite.
        ConfigError: If the camera, the size or the number of samples is impossible.
        MissingExtraError: If the extra `render` is not installed.
    """
    frames = render_frames(
        None if body_positions is None else np.asarray(body_positions)[None],
        body_faces,
        np.asarray(garment_positions)[None],
        garment_faces,
        camera=camera,
        size=size,
        garment_color=garment_color,
        vertex_colors=None if vertex_colors is None else np.asarray(vertex_colors)[None],
        samples=samples,
    )
    return next(frames)


def render_frames(
    body_positions: np.ndarray | None,
    body_faces: np.ndarray | None,
    garment_positions: np.ndarray,
    garment_faces: np.ndarray,
    *,
    frame_indices: Sequence[int] | None = None,
    camera: str | float = "front",
    size: tuple[int, int] = _PICTURE_SIZE,
    garment_color: tuple[float, float, float] = GARMENT_COLOR,
    vertex_colors: np.ndarray | None = None,
    samples: int = _SAMPLES,
) -> Iterator[np.ndarray]:
    """Render pictures one after the other, with a camera that follows at a constant distance.

    Args:
        body_positions: Body vertex positions [m], shape [frames, body_vertices, 3]; None without a body.
        body_faces: Body triangles, shape [body_faces, 3]; None without a body.
        garment_positions: Garment vertex positions [m], shape [frames, vertices, 3].
        garment_faces: Garment triangles, shape [faces, 3].
        frame_indices: Which frames, in which order; None renders all.
        camera: "front" (from +Z), "side" (from +X), "back", or degrees from the front towards the side.
        size: Width and height [pixels].
        garment_color: sRGB in [0, 1].
        vertex_colors: sRGB in [0, 1], shape [frames, vertices, 3] or [vertices, 3]; replaces `garment_color`.
        samples: Camera rays per pixel.

    Returns:
        An iterator of sRGB pictures, uint8, shape [height, width, 3].

    Raises:
        MeshError: If faces and positions disagree.
        NonFiniteError: If a position is NaN or infinite.
        ConfigError: If the camera, the size or the number of samples is impossible.
        MissingExtraError: If the extra `render` is not installed.
    """
    angle = parse_angle(camera)
    _check_picture(size, samples)
    require("mitsuba")
    garment = _checked_mesh("garment", garment_positions, garment_faces)
    body = None if body_positions is None else _checked_mesh("body", body_positions, body_faces)
    if body is not None and len(body.positions) != len(garment.positions):
        raise MeshError(
            f"body has {len(body.positions)} frames and garment has {len(garment.positions)}; they must agree"
        )
    colors = _frame_colors(garment, garment_color, vertex_colors)
    indices = range(len(garment.positions)) if frame_indices is None else list(frame_indices)
    subject = garment if body is None else body
    cameras, ground_height = _follow(subject.positions[np.asarray(indices)], angle, size[0] / size[1])

    def trace(index: int, view: Camera) -> np.ndarray:
        surfaces = [Surface("garment", garment.positions[index], garment.faces, colors[index], True)]
        if body is not None:
            surfaces.append(Surface("body", body.positions[index], body.faces, BODY_COLOR, False))
        return trace_picture(
            surfaces, view, light_angle=angle, ground_height=ground_height, size=size, samples=samples
        )

    return (trace(index, view) for index, view in zip(indices, cameras, strict=True))


def contact_sheet(
    body_positions: np.ndarray | None,
    body_faces: np.ndarray | None,
    garment_positions: np.ndarray,
    garment_faces: np.ndarray,
    *,
    num_frames: int = 8,
    columns: int = 4,
    camera: str | float = "front",
    size: tuple[int, int] = _SHEET_PICTURE_SIZE,
    garment_color: tuple[float, float, float] = GARMENT_COLOR,
    vertex_colors: np.ndarray | None = None,
    samples: int = _SAMPLES,
    on_picture: Callable[[int, int], None] | None = None,
) -> np.ndarray:
    """Render frames spread evenly over a motion, first and last included, into one picture.

    Args:
        body_positions: Body vertex positions [m], shape [frames, body_vertices, 3]; None without a body.
        body_faces: Body triangles, shape [body_faces, 3]; None without a body.
        garment_positions: Garment vertex positions [m], shape [frames, vertices, 3].
        garment_faces: Garment triangles, shape [faces, 3].
        num_frames: How many pictures, or fewer when the motion is shorter.
        columns: Pictures per row.
        camera: "front" (from +Z), "side" (from +X), "back", or degrees from the front towards the side.
        size: Width and height of one picture [pixels].
        garment_color: sRGB in [0, 1].
        vertex_colors: sRGB in [0, 1], shape [frames, vertices, 3] or [vertices, 3]; replaces `garment_color`.
        samples: Camera rays per pixel.
        on_picture: Called with (pictures done, pictures in all) after each one.

    Returns:
        sRGB picture, uint8, shape [rows * height, columns * width, 3] plus gaps, with frame numbers.

    Raises:
        MeshError: If faces and positions disagree.
        NonFiniteError: If a position is NaN or infinite.
        ConfigError: If the camera, a size or a count is impossible.
        MissingExtraError: If the extra `render` is not installed.
    """
    if num_frames < 1 or columns < 1:
        raise ConfigError(
            f"a contact sheet of {num_frames} frames in {columns} columns is empty; use 1 or more"
        )
    last = len(garment_positions) - 1
    indices = sorted({round(frame) for frame in np.linspace(0, last, num_frames)})
    frames = render_frames(
        body_positions,
        body_faces,
        garment_positions,
        garment_faces,
        frame_indices=indices,
        camera=camera,
        size=size,
        garment_color=garment_color,
        vertex_colors=vertex_colors,
        samples=samples,
    )
    pictures = []
    for index, picture in zip(indices, frames, strict=True):
        pictures.append(_label(picture, str(index)))
        if on_picture is not None:
            on_picture(len(pictures), len(indices))
    return _tile(pictures, columns)


def side_by_side(
    pictures: Sequence[np.ndarray], labels: Sequence[str], *, columns: int | None = None
) -> np.ndarray:
    """Return pictures of one size in rows, each with a label in its corner.

    Args:
        pictures: sRGB pictures, uint8, each of shape [height, width, 3].
        labels: A short text each.
        columns: Pictures per row; all in one row by default.
    """
    labelled = [_label(picture, text) for picture, text in zip(pictures, labels, strict=True)]
    return _tile(labelled, columns or len(labelled))


@dataclasses.dataclass(frozen=True)
class _Moving:
    """A checked mesh over time."""

    positions: np.ndarray  # [frames, vertices, 3], [m]
    faces: np.ndarray  # [faces, 3]


def _check_picture(size: tuple[int, int], samples: int) -> None:
    """Raise ConfigError unless a picture of this size can be made."""
    if min(size) < 1 or max(size) > 16384:
        raise ConfigError(f"picture size is {size[0]} x {size[1]}; use 1 to 16384 pixels")
    if samples < 1:
        raise ConfigError(f"samples is {samples}; use 1 or more")


def _checked_mesh(name: str, positions: np.ndarray, faces: np.ndarray | None) -> _Moving:
    """Raise a named error unless positions and faces form a finite animated mesh."""
    points, triangles = np.asarray(positions, np.float32), np.asarray(faces)
    if points.ndim != 3 or points.shape[2] != 3 or 0 in points.shape:
        raise MeshError(f"{name} positions have shape {points.shape}; they must be [frames, vertices, 3]")
    if (
        triangles.ndim != 2
        or triangles.shape[1] != 3
        or triangles.dtype.kind not in "iu"
        or not len(triangles)
    ):
        raise MeshError(f"{name} faces have shape {triangles.shape}; they must be integers [faces, 3]")
    if triangles.min() < 0 or triangles.max() >= points.shape[1]:
        raise MeshError(f"{name} has a face that names vertex {triangles.max()} of {points.shape[1]}")
    is_finite = np.isfinite(points).all(axis=(1, 2))
    if not is_finite.all():
        raise NonFiniteError(
            f"{name} positions are NaN or infinite from frame {int(np.argmin(is_finite))} on"
        )
    return _Moving(points, triangles)


def _frame_colors(
    garment: _Moving, garment_color: tuple[float, float, float], vertex_colors: np.ndarray | None
) -> np.ndarray:
    """One colour per frame, [frames, 3], or one per frame and vertex, [frames, vertices, 3]."""
    num_frames, num_vertices, _ = garment.positions.shape
    if vertex_colors is None:
        return np.broadcast_to(np.asarray(garment_color, np.float32), (num_frames, 3))
    colors = np.asarray(vertex_colors, np.float32)
    if colors.shape not in ((num_vertices, 3), (num_frames, num_vertices, 3)):
        raise MeshError(
            f"vertex_colors have shape {colors.shape}; they must be [{num_vertices}, 3] or "
            f"[{num_frames}, {num_vertices}, 3]"
        )
    return np.broadcast_to(colors, garment.positions.shape)


def _follow(positions: np.ndarray, angle: float, aspect: float) -> tuple[list[Camera], float]:
    """Cameras that keep the subject in the middle at one distance, and the height of the floor.

    Args:
        positions: The subject [m], shape [frames, vertices, 3].
        angle: Direction of the camera around +Y, from +Z towards +X [rad].
        aspect: Picture width over height.

    Returns:
        A camera per frame, and the lowest point over all frames [m].
    """
    floor, top = float(positions[..., 1].min()), float(positions[..., 1].max())
    centers = positions.mean(axis=1)
    centers[:, 1] = (floor + top) / 2
    offsets = positions - centers[:, None]
    radius = float(np.hypot(offsets[..., 0], offsets[..., 2]).max())
    cameras = [place_camera(center, (top - floor) / 2, radius, angle, aspect) for center in centers]
    return cameras, floor


def _label(picture: np.ndarray, text: str) -> np.ndarray:
    """Write a small text into the upper left corner."""
    image = require("PIL.Image").fromarray(picture)
    height = max(9, picture.shape[0] // 26)
    font = require("PIL.ImageFont").load_default(size=height)
    require("PIL.ImageDraw").Draw(image).text((height // 2, height // 3), text, fill=(60, 60, 66), font=font)
    return np.asarray(image)


def _tile(pictures: Sequence[np.ndarray], columns: int, gap: int = 4) -> np.ndarray:
    """Lay pictures of one size out in rows on white."""
    columns = min(columns, len(pictures))
    rows = -(-len(pictures) // columns)
    height, width = pictures[0].shape[:2]
    sheet = np.full((rows * (height + gap) - gap, columns * (width + gap) - gap, 3), 255, np.uint8)
    for number, picture in enumerate(pictures):
        top, left = (number // columns) * (height + gap), (number % columns) * (width + gap)
        sheet[top : top + height, left : left + width] = picture
    return sheet
