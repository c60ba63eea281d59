"""Numbers as colours, text and colour bars on pictures, pictures in rows and on disk."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import chain
from pathlib import Path

import numpy as np
from jaxtyping import Float

from eslr_jax.errors import AssetError
from eslr_jax.files.atomic import atomic_write
from eslr_jax.pipeline.extras import require

# Eight evenly spaced colours of viridis (matplotlib, CC0): even in lightness, and legible to the colour-blind.
_VIRIDIS = np.array([
    (0.267, 0.005, 0.329), (0.275, 0.195, 0.496), (0.213, 0.359, 0.552), (0.153, 0.497, 0.558),
    (0.122, 0.632, 0.531), (0.290, 0.759, 0.428), (0.622, 0.854, 0.226), (0.993, 0.906, 0.144),
])  # fmt: skip
_INK = (60, 60, 66)  # sRGB bytes
_PAPER = 255
_GAP = 4  # [pixels] between pictures
_LEAST_TEXT = 14  # [pixels] high; smaller is not read on a scaled sheet


def color_scale(
    values: Float[np.ndarray, "*shape"], low: float, high: float
) -> Float[np.ndarray, "*shape 3"]:
    """Return sRGB colours in [0, 1], dark blue at `low` and below or for NaN, yellow at `high` and above."""
    share = np.nan_to_num((np.asarray(values, np.float64) - low) / max(high - low, 1e-30))
    position = np.clip(share, 0.0, 1.0) * (len(_VIRIDIS) - 1)
    below = np.minimum(position.astype(int), len(_VIRIDIS) - 2)
    blend = (position - below)[..., None]
    return ((1.0 - blend) * _VIRIDIS[below] + blend * _VIRIDIS[below + 1]).astype(np.float32)


def write_label(picture: np.ndarray, text: str) -> np.ndarray:
    """Return a picture, uint8 [height, width, 3], with a line of text in its upper left corner."""
    image = require("PIL.Image").fromarray(picture)
    height = max(_LEAST_TEXT, picture.shape[0] // 26)
    _draw_text(image, (height // 2, height // 3), text, height)
    return np.asarray(image)


def add_color_bar(picture: np.ndarray, low: float, high: float, title: str) -> np.ndarray:
    """Return a picture, uint8 [height, width, 3], with a colour bar under it, which makes it higher.

    `low` and `high` are the values of the bar's ends, the title says what is shown, with its unit.
    """
    width = picture.shape[1]
    height = int(np.clip(width // 24, 10, 16))  # of the text and of the bar [pixels]
    margin = height // 2
    strip = np.full((3 * height + 2 * (height % 2), width, 3), _PAPER, np.uint8)
    ramp = color_scale(np.linspace(0.0, 1.0, width - 2 * margin), 0.0, 1.0)
    strip[margin : margin + height, margin : width - margin] = np.round(255 * ramp)
    image = require("PIL.Image").fromarray(strip)
    row = margin + height + 2
    _draw_text(image, (margin, row), f"{low:.3g}", height)
    _draw_text(image, (width // 2, row), title, height, anchor="ma")
    _draw_text(image, (width - margin, row), f"{high:.3g}", height, anchor="ra")
    return np.concatenate([picture, np.asarray(image)])


def side_by_side(
    pictures: Sequence[np.ndarray], labels: Sequence[str], *, columns: int | None = None
) -> np.ndarray:
    """Return pictures, uint8 of one size, in rows (by default one), each with its label in its corner."""
    labelled = [write_label(picture, text) for picture, text in zip(pictures, labels, strict=True)]
    columns = min(columns or len(labelled), len(labelled))
    rows = -(-len(labelled) // columns)
    height, width = labelled[0].shape[:2]
    sheet = np.full((rows * (height + _GAP) - _GAP, columns * (width + _GAP) - _GAP, 3), _PAPER, np.uint8)
    for number, picture in enumerate(labelled):
        top, left = (number // columns) * (height + _GAP), (number % columns) * (width + _GAP)
        sheet[top : top + height, left : left + width] = picture
    return sheet


def _draw_text(image, place: tuple[int, int], text: str, height: int, *, anchor: str = "la") -> None:
    """Draw a line of text of this height [pixels] into a Pillow image; `anchor` is Pillow's."""
    font = require("PIL.ImageFont").load_default(size=height)
    require("PIL.ImageDraw").Draw(image).text(place, text, fill=_INK, font=font, anchor=anchor)


def write_png(path: str | Path, image: np.ndarray) -> None:
    """Write a picture, sRGB in uint8 [height, width, 3], as PNG, atomically.

    Raises:
        AssetError: If the file can't be written.
        MissingExtraError: If Pillow is not installed.
    """
    pillow = require("PIL.Image")
    with atomic_write(path) as temporary:
        pillow.fromarray(_checked(image, path)).save(temporary, format="PNG")


def write_video(path: str | Path, frames: Iterable[np.ndarray], fps: float) -> None:
    """Write pictures as a film (H.264 in mp4 by default), atomically and one frame at a time.

    Pictures are uint8, [height, width, 3], of one size, of which an odd row or column is cut.

    Raises:
        AssetError: If there is no frame, sizes differ, or the file can't be written.
        MissingExtraError: If imageio-ffmpeg is not installed.
    """
    ffmpeg = require("imageio_ffmpeg", extra="video")
    if not np.isfinite(fps) or fps <= 0:
        raise AssetError(f"can't write {path} at {fps} frames per second; give a positive rate")
    pictures = iter(frames)
    first = next(pictures, None)
    if first is None:
        raise AssetError(f"no frame to write to {path}; give at least one")
    height, width = (size // 2 * 2 for size in first.shape[:2])  # H.264 halves the colour resolution
    with atomic_write(path) as temporary:
        writer = ffmpeg.write_frames(str(temporary), (width, height), fps=fps, macro_block_size=2, quality=8)
        writer.send(None)
        try:
            for picture in chain([first], pictures):
                if picture.shape != first.shape:
                    raise AssetError(
                        f"frames of {path} have sizes {first.shape} and {picture.shape}; use one size"
                    )
                writer.send(np.ascontiguousarray(_checked(picture, path)[:height, :width]))
        finally:
            writer.close()


def _checked(image: np.ndarray, path: str | Path) -> np.ndarray:
    """Return a picture; raise AssetError unless it is uint8 [height, width, 3]."""
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise AssetError(
            f"can't write {path}: the picture is {image.dtype} {image.shape}, not uint8 [height, width, 3]"
        )
    return image
