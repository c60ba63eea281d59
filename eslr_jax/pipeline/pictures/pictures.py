"""Pictures of a garment on a body: one frame, many frames, a contact sheet."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from eslr_jax.errors import ConfigError, MeshError, NonFiniteError
from eslr_jax.pipeline.extras import require
from eslr_jax.pipeline.formats.animated import Skin, check_moving
from eslr_jax.pipeline.formats.palette import GARMENT_COLORS
from eslr_jax.pipeline.pictures.annotate import side_by_side
from eslr_jax.pipeline.pictures.scene import Surface, facing_angles, follow, parse_angle, trace_picture
from eslr_jax.pipeline.rigs.clothing import body_pieces
from eslr_jax.types import Body

_PICTURE_SIZE = (480, 640)  # width, height [pixels]
_SHEET_PICTURE_SIZE = (252, 360)  # width, height [pixels]
_SAMPLES = 9  # camera rays per pixel; with the denoiser 1 % from a picture with twenty times as many
_MAX_SIZE = 16384  # [pixels]
_MAX_ZOOM = 100.0


def render_frames(
    body_positions: np.ndarray | None,
    body_faces: np.ndarray | None,
    garment_positions: np.ndarray,
    garment_faces: np.ndarray,
    *,
    frame_indices: Sequence[int] | None = None,
    rest_positions: np.ndarray | None = None,
    rig: Body | Skin | None = None,
    follows: bool = True,
    camera: str | float = "front",
    zoom: float = 1.0,
    size: tuple[int, int] = _PICTURE_SIZE,
    garment_color: tuple[float, float, float] = GARMENT_COLORS[0],
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
        rest_positions: The body at rest, facing +Z [m], shape [body_vertices, 3].
        rig: What moves the body; with it and the body at rest, the body wears neutral shorts and a top.
        follows: Turn the camera with the body; otherwise, or without the body at rest, it looks along the world's
            axes, and "front" is +Z.
        camera: "front", "side" (the body's left), "back", or degrees from the front towards the left.
        zoom: How many times larger than with the whole body in the picture; above 1 it looks at the garment.
        size: Width and height [pixels].
        garment_color: sRGB in [0, 1].
        vertex_colors: sRGB in [0, 1], shape [frames, vertices, 3] or [vertices, 3]; replaces `garment_color`.
        samples: Camera rays per pixel; noise falls with its root, time grows with it.

    Returns:
        An iterator of sRGB pictures, uint8, shape [height, width, 3].

    Raises:
        MeshError: If faces and positions disagree.
        NonFiniteError: If a position is NaN or infinite.
        ConfigError: If the camera, the zoom, the size or the number of samples is impossible.
        MissingExtraError: If the extra `render` is not installed.
    """
    angle = parse_angle(camera)
    if min(size) < 1 or max(size) > _MAX_SIZE:
        raise ConfigError(f"picture size is {size[0]} x {size[1]}; use 1 to {_MAX_SIZE} pixels")
    if samples < 1:
        raise ConfigError(f"samples is {samples}; use 1 or more")
    if not 1 / _MAX_ZOOM <= zoom <= _MAX_ZOOM:
        raise ConfigError(f"zoom is {zoom}; use {1 / _MAX_ZOOM:g} to {_MAX_ZOOM:g}")
    require("mitsuba")
    cloth, cloth_faces = _checked_mesh("garment", garment_positions, garment_faces)
    num_frames, num_vertices, _ = cloth.shape
    subject, angles, pieces = cloth, np.full(num_frames, angle), []
    if body_positions is not None:
        subject, skin_faces = _checked_mesh("body", body_positions, body_faces)
        if len(subject) != num_frames:
            raise MeshError(f"body has {len(subject)} frames and garment has {num_frames}; they must agree")
        rest = subject[0] if rest_positions is None else np.asarray(rest_positions)
        pieces = body_pieces(rest, skin_faces, None if rest_positions is None else rig)
        if rest_positions is not None and follows:
            angles += facing_angles(subject, rest)
    colors = np.asarray(garment_color if vertex_colors is None else vertex_colors, np.float32)
    if vertex_colors is not None and colors.shape not in ((num_vertices, 3), cloth.shape):
        raise MeshError(
            f"vertex_colors have shape {colors.shape}; they must be [{num_vertices}, 3] or "
            f"[{num_frames}, {num_vertices}, 3]"
        )
    colors = np.broadcast_to(colors, cloth.shape)
    focus = cloth if zoom > 1 else None
    cameras, ground_height = follow(subject, angles, aspect=size[0] / size[1], zoom=zoom, focus=focus)

    def trace(index: int) -> np.ndarray:
        surfaces = [Surface("garment", cloth[index], cloth_faces, colors[index], True)]
        for piece in pieces:
            place = piece.place(subject[index])
            surfaces.append(Surface(f"body {piece.name}", place, piece.faces, piece.color, False))
        return trace_picture(
            surfaces, cameras[index], ground_height=ground_height, size=size, samples=samples
        )

    return map(trace, range(num_frames) if frame_indices is None else list(frame_indices))


def render_frame(
    body_positions: np.ndarray | None,
    body_faces: np.ndarray | None,
    garment_positions: np.ndarray,
    garment_faces: np.ndarray,
    **options: Any,
) -> np.ndarray:
    """Render one picture, [height, width, 3].

    Arguments and errors are those of `render_frames`; positions and colours have no axis of frames.
    """
    body = None if body_positions is None else np.asarray(body_positions)[None]
    cloth = np.asarray(garment_positions)[None]
    return next(render_frames(body, body_faces, cloth, garment_faces, **options))


def contact_sheet(
    body_positions: np.ndarray | None,
    body_faces: np.ndarray | None,
    garment_positions: np.ndarray,
    garment_faces: np.ndarray,
    *,
    num_frames: int = 8,
    columns: int = 4,
    size: tuple[int, int] = _SHEET_PICTURE_SIZE,
    timestep: float | None = None,
    on_picture: Callable[[int, int], None] | None = None,
    **options: Any,
) -> np.ndarray:
    """Render frames spread evenly over a motion, first and last included, into one picture.

    Arguments are those of `render_frames`; the size is that of one picture, of which there are `columns` a row.
    Where the motion is shorter there are fewer. With a timestep [s] labels tell the time too; `on_picture` is
    called with (pictures done, pictures in all) after each one.

    Returns:
        sRGB picture, uint8, shape [rows * height, columns * width, 3] plus gaps, with frame numbers.

    Raises:
        EslrError: A count is impossible, or see `render_frames`.
    """
    if num_frames < 1 or columns < 1:
        raise ConfigError(
            f"a contact sheet of {num_frames} frames in {columns} columns is empty; use 1 or more"
        )
    last = len(garment_positions) - 1
    indices = sorted({round(frame) for frame in np.linspace(0, last, num_frames)})
    meshes = (body_positions, body_faces, garment_positions, garment_faces)
    pictures = []
    for picture in render_frames(*meshes, frame_indices=indices, size=size, **options):
        pictures.append(picture)
        if on_picture is not None:
            on_picture(len(pictures), len(indices))
    labels = [str(index) if timestep is None else moment_text(index, timestep) for index in indices]
    return side_by_side(pictures, labels, columns=columns)


def moment_text(frame: int, timestep: float) -> str:
    """Return a frame's number and its time [s] as a label."""
    return f"{frame}  {frame * timestep:.2f} s"


def _checked_mesh(
    name: str, positions: np.ndarray, faces: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and faces; raise a named error unless they form a finite animated mesh."""
    points, triangles = np.asarray(positions, np.float32), np.asarray(faces)
    check_moving(points, triangles, what=name, remedy="correct it", not_finite=NonFiniteError)
    return points, triangles
