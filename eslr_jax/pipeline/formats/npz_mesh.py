"""Read and write meshes, at rest and in motion, as NumPy archives of `faces` and positions."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from eslr_jax.errors import AssetError, MeshError
from eslr_jax.files.npz import read_arrays, write_arrays
from eslr_jax.pipeline.formats.animated import AnimatedMesh
from eslr_jax.pipeline.formats.bundled import read_number
from eslr_jax.pipeline.formats.mesh import MeshFile
from eslr_jax.pipeline.formats.mesh_sequence import DEFAULT_FPS, POSITION_KEYS, MeshSequence
from eslr_jax.pipeline.formats.registry import reader, writer
from eslr_jax.pose.skeleton import whole_rate


@reader("mesh", [".npz"])
def read_npz_mesh(path: Path, _like: MeshFile | None = None) -> MeshFile:
    """Read `faces` and one of `POSITION_KEYS` from a NumPy archive."""
    arrays = read_arrays(path, content="mesh")
    key = next((key for key in POSITION_KEYS if key in arrays), None)
    if key is None or "faces" not in arrays:
        raise AssetError(
            f"mesh file {path} has the arrays {', '.join(sorted(arrays)) or 'none'}; "
            f"it needs faces and {' or '.join(POSITION_KEYS)}"
        )
    return MeshFile(arrays[key], arrays["faces"])


@reader("mesh sequence", [".npz"])
def read_npz_sequence(path: Path, _mesh: str = "", fps: float | None = None) -> list[MeshSequence]:
    """Read an archive with `faces`, positions, and optionally `fps` or `timestep`."""
    keys = (*POSITION_KEYS, "faces", "fps", "timestep")
    arrays = read_arrays(path, content="mesh sequence", names=keys)
    key = next((key for key in POSITION_KEYS if key in arrays), None)
    if key is None or "faces" not in arrays:
        raise AssetError(f"mesh sequence {path} lacks faces or {' or '.join(POSITION_KEYS)}; add them")
    positions = arrays[key]
    if positions.dtype.kind not in "fiu":
        raise MeshError(f"{path}: {key} of type {positions.dtype}; expected numbers")
    rate = DEFAULT_FPS if fps is None else fps
    if fps is None and "fps" in arrays:
        rate = read_number(arrays["fps"], f"{path}: fps")
    elif fps is None and "timestep" in arrays:
        step = read_number(arrays["timestep"], f"{path}: timestep")
        rate = whole_rate(1.0 / step) if step > 0 else 0.0
    return [MeshSequence(path.name, positions.astype(np.float64), arrays["faces"], rate)]


@writer("animation", [".npz"])
def write_npz_sequence(path: Path, meshes: Sequence[AnimatedMesh], timestep: float) -> None:
    """Write a mesh in motion as an archive that `read_mesh_sequence` reads."""
    mesh = meshes[0]
    arrays = {
        "positions": np.asarray(mesh.positions, np.float32),
        "faces": np.asarray(mesh.faces, np.int32),
        "timestep": np.array(timestep, np.float64),
        "name": np.array(mesh.name),
    }
    if mesh.corner_uvs is not None:
        arrays["corner_uvs"] = np.asarray(mesh.corner_uvs, np.float32)
    write_arrays(path, arrays)
