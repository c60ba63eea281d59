"""Write point caches, PC2 and MDD: the positions of a mesh's vertices over time in float32, without faces.

Modelling programs lay a cache over the mesh that it was made for, vertex by vertex.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from eslr_jax.files.atomic import atomic_write
from eslr_jax.pipeline.formats.animated import AnimatedMesh
from eslr_jax.pipeline.formats.registry import writer


@writer("point cache", [".pc2"])
def write_pc2(path: Path, meshes: Sequence[AnimatedMesh], timestep: float) -> None:
    """Write a PC2 file with one sample a frame, atomically."""
    points = np.asarray(meshes[0].positions)
    # Magic, version, points, first frame, frames per sample, samples.
    header = struct.pack("<12siiffi", b"POINTCACHE2\0", 1, points.shape[1], 0.0, 1.0, points.shape[0])
    with atomic_write(path) as temporary, temporary.open("wb") as stream:
        stream.write(header)
        points.astype("<f4").tofile(stream)


@writer("point cache", [".mdd"])
def write_mdd(path: Path, meshes: Sequence[AnimatedMesh], timestep: float) -> None:
    """Write an MDD file, atomically; frame k is at k times the timestep [s]."""
    points = np.asarray(meshes[0].positions)
    with atomic_write(path) as temporary, temporary.open("wb") as stream:
        stream.write(struct.pack(">ii", points.shape[0], points.shape[1]))
        (np.arange(len(points)) * timestep).astype(">f4").tofile(stream)
        points.astype(">f4").tofile(stream)
