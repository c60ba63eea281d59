"""Read meshes from STL, text or binary."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from eslr_jax.pipeline.formats.mesh import MeshFile, shared_vertices
from eslr_jax.pipeline.formats.registry import reader


@reader("mesh", [".stl"])
def read_stl(path: Path, _like: MeshFile | None = None) -> MeshFile:
    """Read an STL file, all solids as one mesh, and share its vertices."""
    from trimesh.exchange.stl import load_stl  # all of trimesh, for which every command would wait

    with path.open("rb") as stream:
        content = load_stl(stream)
    solids = list(content.get("geometry", {}).values()) or [content]  # text files nest several
    corners = [
        np.asarray(solid["vertices"]).reshape(-1, 3)[np.asarray(solid["faces"], np.int64).reshape(-1, 3)]
        for solid in solids
    ]
    positions = np.concatenate(corners).reshape(-1, 3)
    kept, place = shared_vertices(positions)
    return MeshFile(positions[kept], place.reshape(-1, 3))
