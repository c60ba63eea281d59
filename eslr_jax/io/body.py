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
