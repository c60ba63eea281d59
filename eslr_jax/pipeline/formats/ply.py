"""Read meshes from PLY, text or binary, and write one file a frame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from eslr_jax.errors import MeshError
from eslr_jax.pipeline.formats.animated import AnimatedMesh, split_seams, write_frames
from eslr_jax.pipeline.formats.mesh import MeshFile
from eslr_jax.pipeline.formats.registry import reader, writer


@reader("mesh", [".ply"])
def read_ply(path: Path, _like: MeshFile | None = None) -> MeshFile:
    """Read the positions and faces of a PLY file."""
    from trimesh.exchange.ply import load_ply  # all of trimesh, for which every command would wait

    with path.open("rb") as stream:
        # A count that the file is too small for: trimesh would allocate it.
        for line in stream.read(1 << 16).partition(b"end_header")[0].splitlines():
            words = line.split()
            if words[:1] == [b"element"] and not (
                len(words) == 3 and 0 <= int(words[2]) <= path.stat().st_size
            ):
                raise ValueError(f"impossible header line {line.decode('latin1')[:60]!r}")
        stream.seek(0)
        content = load_ply(stream, fix_texture=False, skip_materials=True)
    positions = np.asarray(content.get("vertices", np.empty((0, 3))))
    faces = content.get("faces")
    faces = np.empty((0, 3), np.int64) if faces is None else np.asarray(faces)
    num_polygons = content.get("metadata", {}).get("_ply_raw", {}).get("face", {}).get("length", 0)
    if faces.shape[1:] != (3,) or len(faces) != num_polygons:
        raise MeshError(f"{path}: not all of its {num_polygons} faces are triangles; triangulate the mesh")
    return MeshFile(positions, faces.astype(np.int64))


@writer("frames", [".ply"])
def write_ply_frames(folder: Path, meshes: Sequence[AnimatedMesh], timestep: float) -> None:
    """Write a binary PLY file a frame; vertices on seams are split, and the copies come last."""
    mesh = meshes[0]
    faces, vertices, uvs = split_seams(np.asarray(mesh.faces), mesh.positions.shape[1], mesh.corner_uvs)
    fields = ["x", "y", "z"] + (["s", "t"] if uvs is not None else [])
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(vertices)}",
        *(f"property float {name}" for name in fields),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    header = ("\n".join(lines) + "\n").encode()
    table = np.empty(len(faces), [("count", "u1"), ("corners", "<i4", 3)])
    table["count"], table["corners"] = 3, faces

    def content(positions: np.ndarray) -> bytes:
        columns = [positions[vertices]] + ([uvs] if uvs is not None else [])
        return header + np.concatenate(columns, axis=1).astype("<f4").tobytes() + table.tobytes()

    write_frames(folder, mesh, ".ply", content)
