"""The bundled body's format: one npz archive."""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import numpy as np

from eslr_jax.errors import AssetError
from eslr_jax.io.npz import read_arrays
from eslr_jax.types import Body

_KEYS = (
    "rest_positions",
    "shape_directions",
    "joint_rest_positions",
    "joint_shape_directions",
    "parents",
    "joint_names",
    "skin_weights",
    "skin_indices",
    "faces",
    "obstacle_faces",
)


def read_body(path: str | Path) -> Body:
    """Read a rigged body.

    Args:
        path: npz archive with the keys that `data/README.md` documents.

    Raises:
        AssetError: The file is missing, damaged, or lacks a key.
    """
    arrays = read_arrays(path, content="body")
    missing = [key for key in _KEYS if key not in arrays]
    if missing:
        raise AssetError(f"body file {path} lacks {', '.join(missing)}; give a body npz as documented")

    _check(path, arrays)

    def floats(key: str):
        return jnp.asarray(arrays[key], jnp.float32)

    return Body(
        rest_positions=floats("rest_positions"),
        shape_directions=floats("shape_directions"),
        joint_rest_positions=floats("joint_rest_positions"),
        joint_shape_directions=floats("joint_shape_directions"),
        skin_weights=floats("skin_weights"),
        skin_indices=jnp.asarray(arrays["skin_indices"], jnp.int32),
        faces=jnp.asarray(arrays["faces"], jnp.int32),
        is_obstacle=jnp.asarray(arrays["obstacle_faces"], bool),
        parents=tuple(int(parent) for parent in arrays["parents"]),
        joint_names=tuple(str(name) for name in np.asarray(arrays["joint_names"])),
    )


def _check(path: str | Path, arrays: dict[str, np.ndarray]) -> None:
    """Raise unless the arrays form a rigged body."""
    vertices, joints = arrays["rest_positions"].shape[:1], arrays["joint_rest_positions"].shape[:1]
    faces, shapes = arrays["faces"].shape[:1], arrays["shape_directions"].shape[2:]
    expected = {
        "rest_positions": ("f", (*vertices, 3)),
        "shape_directions": ("f", (*vertices, 3, *shapes)),
        "joint_rest_positions": ("f", (*joints, 3)),
        "joint_shape_directions": ("f", (*joints, 3, *shapes)),
        "parents": ("iu", joints),
        "joint_names": ("U", joints),
        "skin_weights": ("f", (*vertices, *arrays["skin_weights"].shape[1:2])),
        "skin_indices": ("iu", (*vertices, *arrays["skin_weights"].shape[1:2])),
        "faces": ("iu", (*faces, 3)),
        "obstacle_faces": ("biu", faces),
    }
    ranks = {"shape_directions": 3, "joint_shape_directions": 3, "skin_weights": 2, "skin_indices": 2}
    for key, (kinds, shape) in expected.items():
        array = arrays[key]
        fits = array.shape == shape and 0 not in shape[:1] and array.ndim == ranks.get(key, len(shape))
        if not fits or array.dtype.kind not in kinds:
            raise AssetError(
                f"body file {path}: {key} is {array.dtype} {array.shape}; give a body npz as documented"
            )
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise AssetError(f"body file {path}: {key} is not finite; write it again")
    parents = arrays["parents"].astype(np.int64)
    if parents[0] != -1 or ((parents[1:] < 0) | (parents[1:] >= np.arange(1, len(parents)))).any():
        raise AssetError(f"body file {path}: parents don't come before their children; write it again")
    for key, count in (("skin_indices", joints), ("faces", vertices)):
        if arrays[key].min() < 0 or arrays[key].max() >= count[0]:
            raise AssetError(
                f"body file {path}: {key} names {arrays[key].max()} of {count[0]}; write it again"
            )
