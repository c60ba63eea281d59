"""Write point caches, PC2 and MDD: the positions of a mesh's vertices over time, without faces.

Modelling programs lay a cache over the mesh that it was made for, vertex by vertex. Both formats hold float32.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from eslr_jax.errors import MeshError
from eslr_jax.io.atomic import atomic_write


def write_pc2(path: str | Path, positions: np.ndarray) -> None:
    """Write a PC2 file with one sample per frame, atomically.

    Args:
        path: Path of the file, `*.pc2`.
        positions: Vertex positions [m], shape [frames, vertices, 3].

    Raises:
        MeshError: There are no positions, or one is not finite.
        AssetError: The file can't be written.
    """
    points = _checked(path, positions)
    # Magic, version, points, first frame, frames per sample, samples.
    header = struct.pack("<12siiffi", b"POINTCACHE2\0", 1, points.shape[1], 0.0, 1.0, points.shape[0])
    with atomic_write(path) as temporary, temporary.open("wb") as stream:
        stream.write(header)
        points.astype("<f4").tofile(stream)


def write_mdd(path: str | Path, positions: np.ndarray, timestep: float) -> None:
    """Write an MDD file, atomically.

    Args:
        path: Path of the file, `*.mdd`.
        positions: Vertex positions [m], shape [frames, vertices, 3].
        timestep: Time between frames [s].

    Raises:
        MeshError: There are no positions, or one is not finite.
        AssetError: The file can't be written.
    """
    points = _checked(path, positions)
    with atomic_write(path) as temporary, temporary.open("wb") as stream:
        stream.write(struct.pack(">ii", points.shape[0], points.shape[1]))
        (np.arange(len(points)) * timestep).astype(">f4").tofile(stream)
        points.astype(">f4").tofile(stream)


def _checked(path: str | Path, positions: np.ndarray) -> np.ndarray:
    """Return positions that can be written."""
    points = np.asarray(positions, np.float32)
    if points.ndim != 3 or points.shape[2] != 3 or 0 in points.shape or not np.isfinite(points).all():
        raise MeshError(
            f"{path}: positions {points.shape} must be finite [frames, vertices, 3]; nothing written"
        )
    return points
