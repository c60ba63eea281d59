"""Point caches: the positions of a mesh's vertices over time, without faces; PC2 and MDD.

Modelling programs lay them over the mesh that they were made for, vertex by vertex. Both hold float32.
"""

from __future__ import annotations

import dataclasses
import struct
from pathlib import Path

import numpy as np

from eslr_jax.errors import MeshError
from eslr_jax.io.atomic import atomic_write
from eslr_jax.io.parsing import parsing

_PC2_MAGIC = b"POINTCACHE2\0"
_PC2_HEADER = struct.Struct("<12siiffi")  # magic, version, points, first frame, frames per sample, samples


@dataclasses.dataclass(frozen=True)
class PointCache:
    """Vertices over time."""

    positions: np.ndarray  # [frames, vertices, 3] [m], float32
    times: np.ndarray  # [frames]; seconds in MDD, frames in PC2


def write_pc2(path: str | Path, positions: np.ndarray) -> None:
    """Write a PC2 file, one sample a frame from frame 0, atomically.

    Args:
        path: The file, `*.pc2`.
        positions: Vertices [m], shape [frames, vertices, 3].

    Raises:
        MeshError: There is nothing to write, or it is not finite.
        AssetError: The file can't be written.
    """
    points = _checked(path, positions)
    header = _PC2_HEADER.pack(_PC2_MAGIC, 1, points.shape[1], 0.0, 1.0, points.shape[0])
    with atomic_write(path) as temporary, temporary.open("wb") as stream:
        stream.write(header)
        points.astype("<f4").tofile(stream)


def read_pc2(path: str | Path) -> PointCache:
    """Read a PC2 file.

    Raises:
        AssetError: The file is missing, or is no whole point cache.
    """
    with parsing(path, "point cache") as file:
        data = file.read_bytes()
        magic, version, points, start, rate, samples = _PC2_HEADER.unpack_from(data)
        if magic != _PC2_MAGIC or version != 1:
            raise ValueError("no PC2 of version 1")
        positions = _table(data[_PC2_HEADER.size :], "<f4", samples, points)
        return PointCache(positions, start + rate * np.arange(samples))


def write_mdd(path: str | Path, positions: np.ndarray, timestep: float) -> None:
    """Write an MDD file, atomically.

    Args:
        path: The file, `*.mdd`.
        positions: Vertices [m], shape [frames, vertices, 3].
        timestep: Time between frames [s].

    Raises:
        MeshError: There is nothing to write, or it is not finite.
        AssetError: The file can't be written.
    """
    points = _checked(path, positions)
    with atomic_write(path) as temporary, temporary.open("wb") as stream:
        stream.write(struct.pack(">ii", points.shape[0], points.shape[1]))
        (np.arange(len(points)) * timestep).astype(">f4").tofile(stream)
        points.astype(">f4").tofile(stream)


def read_mdd(path: str | Path) -> PointCache:
    """Read an MDD file.

    Raises:
        AssetError: The file is missing, or is no whole point cache.
    """
    with parsing(path, "point cache") as file:
        data = file.read_bytes()
        frames, points = struct.unpack_from(">ii", data)
        if frames < 1:
            raise ValueError(f"{frames} frames")
        times = np.frombuffer(data, ">f4", frames, 8).astype(np.float32)
        return PointCache(_table(data[8 + 4 * frames :], ">f4", frames, points), times)


def _checked(path: str | Path, positions: np.ndarray) -> np.ndarray:
    """Return positions that can be written."""
    points = np.asarray(positions, np.float32)
    if points.ndim != 3 or points.shape[2] != 3 or 0 in points.shape or not np.isfinite(points).all():
        raise MeshError(
            f"{path}: positions {points.shape} are no finite [frames, vertices, 3]; nothing written"
        )
    return points


def _table(data: bytes, dtype: str, frames: int, points: int) -> np.ndarray:
    """Return the samples that fill the rest of a file."""
    if frames < 1 or points < 1 or len(data) != 12 * frames * points:
        raise ValueError(f"{len(data)} bytes for {frames} samples of {points} points")
    return np.frombuffer(data, dtype).reshape(frames, points, 3).astype(np.float32)
