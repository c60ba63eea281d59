"""Pictures and films on disk."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain
from pathlib import Path

import numpy as np

from eslr_jax.errors import AssetError
from eslr_jax.files.atomic import atomic_write
from eslr_jax.pipeline.extras import require


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
