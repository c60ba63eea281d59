"""Read the bundled formats of bodies and motions: npz archives, as `data/README.md` documents them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from eslr_jax.errors import AssetError, MotionError
from eslr_jax.files.npz import check_layout, read_arrays
from eslr_jax.numerics import to_device
from eslr_jax.pipeline.formats.registry import reader
from eslr_jax.pose.motion import Motion
from eslr_jax.types import Body

_BODY = {
    "rest_positions": ("f", "vertices 3"),
    "shape_directions": ("f", "vertices 3 shapes"),
    "joint_rest_positions": ("f", "joints 3"),
    "joint_shape_directions": ("f", "joints 3 shapes"),
    "parents": ("iu", "joints"),
    "joint_names": ("U", "joints"),
    "skin_weights": ("f", "vertices influences"),
    "skin_indices": ("iu", "vertices influences", "joints"),
    "faces": ("iu", "faces 3", "vertices"),
    "obstacle_faces": ("biu", "faces"),
}
_ROUNDED = 1e-3  # by which the sum of a vertex' skin weights may differ from one and is left alone
UPRIGHT = 0.7  # least height over the longest side of a standing body; a T-pose is as wide as it is high


@reader("body", [".npz"])
def read_body(path: Path, _meshes: str = "") -> Body:
    """Read a rigged body of the bundled format, Y up."""
    arrays = read_arrays(path, content="body")
    what, remedy = f"body file {path}", "give a body npz as documented"
    missing = [key for key in _BODY if key not in arrays]
    if missing:
        raise AssetError(f"{what} lacks {', '.join(missing)}; {remedy}")
    check_layout(arrays, _BODY, what=what, remedy=remedy)
    for key, (kinds, *_) in _BODY.items():
        if not len(arrays[key]) or (kinds == "f" and not np.isfinite(arrays[key]).all()):
            raise AssetError(f"{what}: {key} is empty or not finite; {remedy}")
    weights = arrays["skin_weights"]
    if (weights < 0).any() or not weights.any(axis=1).all():
        raise AssetError(f"{what}: a vertex has a negative skin weight, or none; {remedy}")
    total = weights.sum(axis=1, keepdims=True)
    arrays["skin_weights"] = weights / np.where(np.abs(total - 1) > _ROUNDED, total, 1.0)
    sides = np.ptp(arrays["rest_positions"], axis=0)
    if sides[1] < UPRIGHT * sides.max():
        raise AssetError(
            f"{what} is {sides[1]:.3g} m high and {sides.max():.3g} m long; turn it so that Y is up"
        )
    parents = arrays["parents"].astype(np.int64)
    if parents[0] != -1 or ((parents[1:] < 0) | (parents[1:] >= np.arange(1, len(parents)))).any():
        raise AssetError(f"{what}: parents don't come before their children; {remedy}")
    floats = {key: arrays[key] for key in _BODY if _BODY[key][0] == "f"}
    body = Body(
        **floats,
        skin_indices=arrays["skin_indices"],
        faces=arrays["faces"],
        is_obstacle=arrays["obstacle_faces"].astype(bool),
        parents=tuple(map(int, parents)),
        joint_names=tuple(map(str, arrays["joint_names"])),
    )
    return to_device(body)


def read_motion_archive(path: str | Path) -> dict[str, Motion]:
    """Read clips by name: `joint_names`, `<clip>/rotations`, `<clip>/translations`, `<clip>/fps`.

    Raises:
        AssetError: The file is missing or damaged.
        MotionError: The archive holds no clip, or a clip is incomplete or impossible.
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
            raise MotionError(f"{path}: clip {name} lacks {', '.join(missing)}; write the archive again")
        check_layout(arrays, layout, what=str(path), remedy="write the archive again", error=MotionError)
        clips[name] = Motion(
            name,
            arrays[f"{name}/rotations"].astype(np.float64),
            arrays[f"{name}/translations"].astype(np.float64),
            read_number(arrays[f"{name}/fps"], f"{path}: {name}/fps"),
            tuple(map(str, arrays["joint_names"])),
        )
    return clips


def pick_clip(path: str | Path, names: Sequence[str], clip: str) -> str:
    """Return the clip of a file that is asked for, or its only one where that is ""; raise a MotionError else."""
    if not clip and len(names) > 1:
        raise MotionError(f"{path} holds {len(names)} clips; name one, as in {path}#{names[0]}")
    if clip and clip not in names:
        raise MotionError(f"{path} has no clip {clip!r}; it has {', '.join(names)}")
    return clip or names[0]


def read_number(array: np.ndarray, what: str) -> float:
    """Return the one number that an array holds.

    Raises:
        MotionError: The array holds something else; `what` begins the message.
    """
    if array.size != 1 or array.dtype.kind not in "fiu":
        raise MotionError(f"{what} is {array.dtype} {array.shape}; expected one number")
    return float(array.ravel()[0])
