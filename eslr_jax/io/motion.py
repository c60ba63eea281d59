"""Motions in the bundled format: an npz archive of clips on one rig."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from eslr_jax.errors import MotionError
from eslr_jax.io.npz import read_arrays


class Clip(NamedTuple):
    """One clip of a motion archive."""

    rotations: np.ndarray  # local axis-angle [rad], shape [frames, joints, 3]
    translations: np.ndarray  # [m], shape [frames, 3]
    fps: float
    joint_names: tuple[str, ...]


def read_motion_archive(path: str | Path) -> dict[str, Clip]:
    """Read every clip of an archive with keys `<clip>/rotations`, `<clip>/translations`, `<clip>/fps`.

    Raises:
        AssetError: The file is missing or damaged.
        MotionError: It holds no clip, or a clip is incomplete.
    """
    arrays = read_arrays(path, content="motion")
    names = sorted(key.removesuffix("/rotations") for key in arrays if key.endswith("/rotations"))
    if not names or "joint_names" not in arrays:
        raise MotionError(f"{path} holds no motion; expected joint_names and <clip>/rotations arrays")
    table = arrays["joint_names"]
    if table.ndim != 1 or table.dtype.kind != "U":
        raise MotionError(f"{path}: joint_names is {table.dtype} {table.shape}; write a list of names")
    joint_names = tuple(str(name) for name in table)
    return {name: _clip(path, arrays, name, joint_names) for name in names}


def _clip(path: str | Path, arrays: dict[str, np.ndarray], name: str, joint_names: tuple[str, ...]) -> Clip:
    """Return one clip of an archive.

    Raises:
        MotionError: It is incomplete, or its arrays don't fit.
    """
    missing = [key for key in ("translations", "fps") if f"{name}/{key}" not in arrays]
    if missing:
        raise MotionError(f"{path}: clip {name} lacks {', '.join(missing)}; write the archive again")
    rotations, translations, fps = (arrays[f"{name}/{key}"] for key in ("rotations", "translations", "fps"))
    frames = translations.shape[:1]
    if (
        any(array.dtype.kind not in "fiu" for array in (rotations, translations, fps))
        or rotations.shape != (*frames, len(joint_names), 3)
        or translations.shape != (*frames, 3)
        or fps.size != 1
    ):
        raise MotionError(
            f"{path}: clip {name} has rotations {rotations.shape}, translations {translations.shape} and fps "
            f"{fps.shape} for {len(joint_names)} joints; write the archive again"
        )
    return Clip(
        rotations.astype(np.float64), translations.astype(np.float64), float(fps.ravel()[0]), joint_names
    )
