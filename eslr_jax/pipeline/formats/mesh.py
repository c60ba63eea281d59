"""Triangle meshes in the units and axes of their files."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from eslr_jax.files.parsing import parsing
from eslr_jax.pipeline.formats.registry import find_reader

# Of a mesh on the host, for signatures.
Positions = Float[np.ndarray, "vertices 3"]  # [m]
Faces = Int[np.ndarray, "faces 3"]
_FOLDED = -1e-6  # share of a polygon's squared area below which a triangle looks the other way
_SLIVER = 1e-4  # share of the squared sum of its edges' squares below which a polygon has no area


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
    name: str = ""  # of a garment
    is_pinned: Bool[np.ndarray, " vertices"] | None = None  # if the file tells


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


def cut_polygons(
    points: np.ndarray,
    sizes: Sequence[int] | np.ndarray,
    corners: np.ndarray,
    starts: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cut polygons into triangles, each as a fan.

    Triangles look to the side of the polygon's area vector (Newell's). Quads are cut along their shorter diagonal
    if both will do, other polygons from their first such corner. So is a polygon with next to no area, in which
    rounding decides where triangles look.

    Polygons have three or more corners each, `sizes`, whose vertices follow each other in `corners`. `starts` are
    the corners from which they were cut in another shape of the mesh; another number of them is left out.

    Returns:
        Triangles as places among the corners [triangles, 3]; the polygon of each triangle; and the corner from
        which each polygon was cut, -1 if every fan folds over.
    """
    sizes = np.asarray(sizes, np.int64)
    firsts = np.cumsum(sizes) - sizes
    if starts is None or len(starts) != len(sizes):
        starts = np.zeros(len(sizes), np.int64)
        for size in np.unique(sizes[sizes > 3]):
            rows = np.flatnonzero(sizes == size)
            ids = corners[firsts[rows, None] + np.arange(size)]
            is_known = (ids.min(axis=1) >= 0) & (ids.max(axis=1) < len(points))
            is_known[is_known] = np.isfinite(points[ids[is_known]]).all(axis=(1, 2))
            starts[rows[is_known]] = _fan_starts(points[ids[is_known]])  # the others are refused later
    owner = np.repeat(np.arange(len(sizes)), sizes - 2)
    second = 1 + np.arange(len(owner)) - (np.cumsum(sizes - 2) - (sizes - 2))[owner]
    turns = np.stack([np.zeros_like(second), second, second + 1], axis=1)
    places = (starts[owner, None] + turns) % sizes[owner, None]
    return firsts[owner, None] + places, owner, starts


def _fan_starts(polygons: np.ndarray) -> np.ndarray:
    """Return the corner from which to cut each of some polygons of one size, [polygons, corners, 3]."""
    count, size = polygons.shape[:2]
    corners = polygons - polygons[:, :1]
    area = np.cross(corners, np.roll(corners, -1, axis=1)).sum(axis=1)
    order = np.tile(np.arange(size), (count, 1))
    if size == 4:
        diagonals = np.linalg.norm(corners[:, :2] - corners[:, 2:], axis=2)
        order = order[:, :2] ^ (diagonals[:, 1] < diagonals[:, 0])[:, None]
    edges = np.square(corners - np.roll(corners, -1, axis=1)).sum(axis=(1, 2))
    is_flat = np.square(area).sum(axis=1) < _SLIVER * np.square(edges)
    starts = np.where(is_flat, order[:, 0], -1)
    for start in order.T:
        spokes = np.take_along_axis(corners, ((start[:, None] + np.arange(size)) % size)[..., None], axis=1)
        spokes = spokes[:, 1:] - spokes[:, :1]
        normals = np.cross(spokes[:, :-1], spokes[:, 1:])
        heights = np.einsum("ptx,px->pt", normals, area)
        is_folded = heights.min(axis=1) < _FOLDED * np.einsum("px,px->p", area, area)
        starts = np.where((starts < 0) & ~is_folded, start, starts)
    return starts


def join_meshes(
    positions: Sequence[np.ndarray], faces: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices and faces of several meshes as those of one."""
    starts = np.cumsum([0, *map(len, positions)])[:-1]
    moved = [own + start for own, start in zip(faces, starts, strict=True)]
    return np.concatenate(positions), np.concatenate(moved)


def stack_tables(tables: Sequence[np.ndarray]) -> np.ndarray:
    """Return tables below each other; those with fewer columns get columns of zeros."""
    width = max(table.shape[1] for table in tables)
    return np.concatenate([np.pad(table, ((0, 0), (0, width - table.shape[1]))) for table in tables])


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
