"""Read HOOD's garments.

Source: Grigorev, Black and Hilliges, "HOOD" (2023), repository at 9bc1076, utils/mesh_creation.py.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from eslr_jax.errors import AssetError
from eslr_jax.pipeline.formats.mesh import MeshFile
from eslr_jax.pipeline.formats.pickle import read_pickle
from eslr_jax.pipeline.formats.registry import reader

_PINNED = 3  # node_type of a pinned vertex (`NodeType.HANDLE`)


@reader("garment", [".pkl"])
def read_hood_garment(path: Path, name: str = "") -> MeshFile:
    """Read one garment of HOOD's dictionary: rest_pos, faces and node_type by name."""
    garments = read_pickle(path, content="garment")
    if not isinstance(garments, dict) or not all(isinstance(entry, dict) for entry in garments.values()):
        raise AssetError(f"garment file {path} holds no garments by name; give HOOD's garments_dict.pkl")
    names = [str(key) for key in garments]
    if not name and len(names) != 1:
        raise AssetError(f"{path} holds the garments {', '.join(names)[:300]}; name one, as in {path}#NAME")
    name = name or names[0]
    if name not in names:
        raise AssetError(f"{path} has no garment {name!r}; it has {', '.join(names)[:300]}")
    entry = garments[name]
    arrays = {}
    for key in ("rest_pos", "faces"):
        value = entry.get(key)
        if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu":
            raise AssetError(f"garment {name} of {path} has no array {key}; give HOOD's garments_dict.pkl")
        arrays[key] = value
    positions = arrays["rest_pos"].astype(np.float64)
    is_pinned = None
    if entry.get("node_type") is not None:
        kinds = np.ravel(entry["node_type"])
        if kinds.shape != positions.shape[:1]:
            raise AssetError(
                f"garment {name} of {path}: {len(kinds)} node_types for {len(positions)} vertices"
            )
        is_pinned = kinds == _PINNED
    return MeshFile(positions, arrays["faces"], is_metric=True, name=name, is_pinned=is_pinned)
