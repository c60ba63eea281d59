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
    joint_names = tuple(str(name) for name in arrays["joint_names"])
    clips = {}
    for name in names:
        missing = [key for key in ("translations", "fps") if f"{name}/{key}" not in arrays]
        if missing:
            raise MotionError(f"{path}: clip {name} lacks {', '.join(missing)}; write the archive again")
        clips[name] = Clip(
            np.asarray(arrays[f"{name}/rotations"], np.float64),
            np.asarray(arrays[f"{name}/translations"], np.float64),
            float(arrays[f"{name}/fps"]),
            joint_names,
        )
    return clips
