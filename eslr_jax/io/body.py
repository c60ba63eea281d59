"""Read the bundled body's format, one npz archive."""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import numpy as np

from eslr_jax.errors import AssetError
from eslr_jax.io.npz import check_layout, read_arrays
from eslr_jax.types import Body

_LAYOUT = {
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
_REMEDY = "give a body npz as documented"
_ROUNDED = 1e-3  # by which the sum of a vertex' skin weights may differ from one and is left alone
UPRIGHT = 0.7  # least height over the longest side of a standing body; a T-pose is as wide as it is high


def read_body(path: str | Path) -> Body:
    """Read a rigged body.

    Args:
        path: Path of an npz archive with the arrays that `data/README.md` documents.

    Returns:
        The body, float32.

    Raises:
        AssetError: The file is missing or damaged, lacks an array, a vertex follows no joint, or Y is not up.
    """
    arrays = read_arrays(path, content="body")
    what = f"body file {path}"
    missing = [key for key in _LAYOUT if key not in arrays]
    if missing:
        raise AssetError(f"{what} lacks {', '.join(missing)}; {_REMEDY}")
    check_layout(arrays, _LAYOUT, what=what, remedy=_REMEDY)
    for key, (kinds, *_) in _LAYOUT.items():
        if not len(arrays[key]) or (kinds == "f" and not np.isfinite(arrays[key]).all()):
            raise AssetError(f"{what}: {key} is empty or not finite; {_REMEDY}")
    weights = arrays["skin_weights"]
    if (weights < 0).any() or not weights.any(axis=1).all():
        raise AssetError(f"{what}: a vertex has a negative skin weight, or none; {_REMEDY}")
    total = weights.sum(axis=1, keepdims=True)
    arrays["skin_weights"] = weights / np.where(np.abs(total - 1) > _ROUNDED, total, 1.0)
    sides = np.ptp(arrays["rest_positions"], axis=0)
    if sides[1] < UPRIGHT * sides.max():
        raise AssetError(
            f"{what} is {sides[1]:.3g} m high and {sides.max():.3g} m long; turn it so that Y is up"
        )
    parents = arrays["parents"].astype(np.int64)
    if parents[0] != -1 or ((parents[1:] < 0) | (parents[1:] >= np.arange(1, len(parents)))).any():
        raise AssetError(f"{what}: parents don't come before their children; {_REMEDY}")
    floats = {key: jnp.asarray(arrays[key], jnp.float32) for key in _LAYOUT if _LAYOUT[key][0] == "f"}
    return Body(
        **floats,
        skin_indices=jnp.asarray(arrays["skin_indices"], jnp.int32),
        faces=jnp.asarray(arrays["faces"], jnp.int32),
        is_obstacle=jnp.asarray(arrays["obstacle_faces"], bool),
        parents=tuple(map(int, parents)),
        joint_names=tuple(map(str, arrays["joint_names"])),
    )
