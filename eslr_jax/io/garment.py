"""Garment files: a rest mesh with skin weights and pins in a NumPy archive."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from eslr_jax.errors import AssetError
from eslr_jax.io.npz import read_arrays, write_arrays


@dataclasses.dataclass(frozen=True)
class GarmentFile:
    """The arrays of a garment file, as `prepare_garment` takes them."""

    rest_positions: Float[np.ndarray, "vertices 3"]  # [m], float64
    faces: Int[np.ndarray, "faces 3"]
    skin_weights: Float[np.ndarray, "vertices influences"]
    skin_indices: Int[np.ndarray, "vertices influences"]
    is_pinned: Bool[np.ndarray, " vertices"]


def read_garment_npz(path: str | Path) -> GarmentFile:
    """Read a garment file with the arrays rest_positions, faces, skin_weights, skin_indices and pinned.

    `pinned` may be absent: then nothing is pinned.

    Raises:
        AssetError: The file is missing or damaged, or an array is missing.
    """
    arrays = read_arrays(path, content="garment")
    missing = [
        key for key in ("rest_positions", "faces", "skin_weights", "skin_indices") if key not in arrays
    ]
    if missing:
        raise AssetError(
            f"garment file {path} lacks {', '.join(missing)}; it has {', '.join(sorted(arrays))}"
        )
    return GarmentFile(
        rest_positions=arrays["rest_positions"].astype(np.float64),
        faces=arrays["faces"].astype(np.int64),
        skin_weights=arrays["skin_weights"].astype(np.float64),
        skin_indices=arrays["skin_indices"].astype(np.int64),
        is_pinned=arrays.get("pinned", np.zeros(len(arrays["rest_positions"]))).astype(bool),
    )


def write_garment_npz(path: str | Path, garment: GarmentFile) -> None:
    """Write a garment file, atomically.

    Raises:
        AssetError: The file can't be written.
    """
    arrays = {
        "rest_positions": garment.rest_positions.astype(np.float32),
        "faces": garment.faces.astype(np.int32),
        "skin_weights": garment.skin_weights.astype(np.float32),
        "skin_indices": garment.skin_indices.astype(np.int16),
        "pinned": garment.is_pinned,
    }
    write_arrays(path, arrays, is_compressed=True)
