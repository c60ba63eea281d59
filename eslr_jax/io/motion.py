"""Read motions in the bundled format: an npz archive of clips on one rig."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from eslr_jax.errors import MotionError
from eslr_jax.io.npz import check_layout, read_arrays

_REMEDY = "write the archive again"


class Clip(NamedTuple):
    """One clip of a motion archive."""

    rotations: np.ndarray  # local axis-angle [rad], shape [frames, joints, 3]
    translations: np.ndarray  # position of the root joint [m], shape [frames, 3]
    fps: float  # [1/s]
    joint_names: tuple[str, ...]


def read_motion_archive(path: str | Path) -> dict[str, Clip]:
    """Read every clip of an archive with `joint_names`, `<clip>/rotations`, `<clip>/translations`, `<clip>/fps`.

    Args:
        path: Path of the archive.

    Returns:
        Clips by name.

    Raises:
        AssetError: The file is missing or damaged.
        MotionError: The archive holds no clip, or a clip is incomplete.
    """
    arrays = read_arrays(path, content="motion")
    names = sorted(key.removesuffix("/rotations") for key in arrays if key.endswith("/rotations"))
    if not names or "joint_names" not in arrays:
        raise MotionError(f"{path} holds no motion; expected joint_names and <clip>/rotations arrays")
    clips = {}
    for name in names:
        layout = {
            "joint_names": ("U", "joints"),
            f"{name}/rotations": ("fiu", "frames joints 3"),
            f"{name}/translations": ("fiu", "frames 3"),
        }
        missing = [key for key in (*layout, f"{name}/fps") if key not in arrays]
        if missing:
            raise MotionError(f"{path}: clip {name} lacks {', '.join(missing)}; {_REMEDY}")
        check_layout(arrays, layout, what=str(path), remedy=_REMEDY, error=MotionError)
        clips[name] = Clip(
            arrays[f"{name}/rotations"].astype(np.float64),
            arrays[f"{name}/translations"].astype(np.float64),
            read_number(arrays[f"{name}/fps"], f"{path}: {name}/fps"),
            tuple(map(str, arrays["joint_names"])),
        )
    return clips


def read_number(array: np.ndarray, what: str) -> float:
    """Return the one number that an array holds.

    Raises:
        MotionError: The array holds something else; `what` begins the message.
    """
    if array.size != 1 or array.dtype.kind not in "fiu":
        raise MotionError(f"{what} is {array.dtype} {array.shape}; expected one number")
    return float(array.ravel()[0])
