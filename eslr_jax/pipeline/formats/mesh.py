"""Triangle meshes in the units and axes of their files."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from eslr_jax.files.parsing import parsing
from eslr_jax.pipeline.formats.registry import find_reader


@dataclasses.dataclass(frozen=True)
class MeshFile:
    """A mesh in the units and axes of its file."""

    positions: Float[np.ndarray, "vertices 3"]  # float64
    faces: Int[np.ndarray, "faces 3"]  # int64, unvalidated
    corner_uvs: Float[np.ndarray, "faces 3 2"] | None = None  # texture coordinates of each face's corners
    face_parts: Int[np.ndarray, " faces"] | None = None  # index into part_names
    part_names: tuple[str, ...] = ()  # materials, or else groups, or else objects
    rows: Int[np.ndarray, " rows"] | None = None  # vertex of each row of the file, where rows were shared
    # Corner of each polygon from which it was cut into triangles
    cuts: Int[np.ndarray, " polygons"] | None = None
    is_metric: bool = False  # the format prescribes metres and Y up


def read_mesh(path: str | Path) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]:
    """Read the positions [vertices, 3] and faces [faces, 3] of a mesh file; see `read_mesh_file`."""
    mesh = read_mesh_file(path)
    return mesh.positions, mesh.faces


def read_mesh_file(path: str | Path, *, like: MeshFile | None = None) -> MeshFile:
    """Read a mesh without repairing it.

    Polygons are cut into triangles. OBJ, PLY and NPZ keep their vertices and order. In STL and GLB, which store a
    vertex more than once, vertices at bit-identical positions become one; `rows` leads from the order of a GLB to
    them. An STL has corners and no vertices: programs number them as here, by where they first appear.

    Args:
        path: Path of a file of one of `registry.suffixes_of("mesh")`.
        like: The same mesh in another shape, whose polygons are cut alike.

    Raises:
        AssetError: The file is missing, unreadable or of an unknown kind.
        MeshError: A PLY file has faces that are not triangles, or an OBJ file some that can't be cut.
    """
    read = find_reader("mesh", path)
    with parsing(path, "mesh"):
        mesh = read(path, like)
        return dataclasses.replace(
            mesh, positions=np.array(mesh.positions, np.float64), faces=np.array(mesh.faces)
        )


def name_parts(choices: list[list[str]]) -> tuple[np.ndarray | None, tuple[str, ...]]:
    """Return each face's part, and the names, from the first list of names that tells faces apart."""
    for names in choices:
        distinct = tuple(dict.fromkeys(names))
        if len(distinct) > 1:
            index = {name: k for k, name in enumerate(distinct)}
            return np.array([index[name] for name in names]), tuple(name or "unnamed" for name in distinct)
    return None, ()


def shared_vertices(positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find vertices at bit-identical positions, which exporters split where normals or textures differ.

    Positions have the shape [vertices, 3] or, in several shapes, [vertices, shapes, 3].

    Returns:
        Indices of the vertices to keep, in their order, and the place of every vertex among them.
    """
    rows = positions.reshape(len(positions), -1)
    _, first, inverse = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return np.sort(first), rank[inverse.ravel()]
