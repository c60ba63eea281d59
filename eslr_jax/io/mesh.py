"""Read triangle meshes in the units and axes of their files: OBJ, PLY, STL, glTF binary and NumPy archives."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from trimesh.exchange.ply import load_ply
from trimesh.exchange.stl import load_stl

from eslr_jax.errors import AssetError, MeshError
from eslr_jax.io.gltf_document import TRIANGLES, GltfDocument
from eslr_jax.io.npz import read_arrays
from eslr_jax.io.parsing import parsing

POSITION_KEYS = ("rest_positions", "positions", "vertices")  # accepted in an archive, first match
MAX_FILE_BYTES = 1 << 30  # far more than any garment has
_COMMENT = re.compile(r"(?:^|\s)#.*")  # behind a name, which may hold a #
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
    cuts: Int[np.ndarray, " polygons"] | None = (
        None  # corner of each polygon from which it was cut into triangles
    )


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
        path: Path of a .obj, .ply, .stl, .glb or .npz file.
        like: The same mesh in another shape, whose polygons are cut alike.

    Returns:
        The mesh.

    Raises:
        AssetError: The file is missing, unreadable or of an unknown kind.
        MeshError: A PLY file has faces that are not triangles, or an OBJ file some that can't be cut.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in _READERS:
        known = ", ".join(_READERS)
        raise AssetError(f"mesh file {path} has the unknown suffix {suffix!r}; convert it to one of {known}")
    with parsing(path, "mesh", max_bytes=MAX_FILE_BYTES):
        mesh = (
            _read_obj(path, None if like is None else like.cuts)
            if suffix == ".obj"
            else _READERS[suffix](path)
        )
        return dataclasses.replace(
            mesh, positions=np.array(mesh.positions, np.float64), faces=np.array(mesh.faces)
        )


def _read_obj(path: Path, cuts: np.ndarray | None = None) -> MeshFile:
    """Read vertices, faces, texture coordinates and part names of an OBJ file, without normals."""
    positions: list[list[float]] = []
    uvs: list[list[float]] = []
    polygons: list[list[tuple[int, int]]] = []  # corners as (vertex, texture coordinate or -1)
    lines: list[int] = []  # of the polygons
    names: dict[str, list[str]] = {"usemtl": [], "g": [], "o": []}
    current = dict.fromkeys(names, "")
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
        key, rest = (*line.split(maxsplit=1), "", "")[:2]
        if key in current:
            current[key] = _COMMENT.sub("", rest).strip()
            continue
        rest = rest.partition("#")[0]
        if key == "v":
            positions.append([float(value) for value in rest.split()[:3]])
        elif key == "vt":
            uvs.append([float(value) for value in rest.split()[:2]])
        elif key == "f":
            polygon = [_corner(word, len(positions), len(uvs)) for word in rest.split()]
            if len(polygon) < 3:
                raise MeshError(f"{path}, line {number}: a face of {len(polygon)} vertices; remove it")
            polygons.append(polygon)
            lines.append(number)
            for kind, chosen in names.items():
                chosen.append(current[kind])
    points = np.array(positions, np.float64).reshape(-1, 3)
    starts = cuts if cuts is not None and len(cuts) == len(polygons) else _fan_starts(points, polygons)
    if (folded := np.flatnonzero(starts < 0)).size:
        raise MeshError(
            f"{path}, line {lines[folded[0]]}: a face that crosses itself, or is too concave to be cut; "
            "triangulate the mesh"
        )
    triangles, owner = _cut_polygons(polygons, starts.tolist())
    faces = np.array(triangles, np.int64).reshape(-1, 3, 2)
    has_uvs = len(faces) > 0 and bool(np.all((faces[..., 1] >= 0) & (faces[..., 1] < len(uvs))))
    face_parts, part_names = _parts([[chosen[k] for k in owner] for chosen in names.values()])
    return MeshFile(
        positions=points,
        faces=faces[..., 0],
        corner_uvs=np.array(uvs, np.float64)[faces[..., 1]] if has_uvs else None,
        face_parts=face_parts,
        part_names=part_names,
        cuts=starts,
    )


def _corner(word: str, num_positions: int, num_uvs: int) -> tuple[int, int]:
    """Return the vertex and texture coordinate of v, v/vt, v//vn or v/vt/vn, counted from zero; -1 is none."""
    vertex, _, rest = word.partition("/")
    uv = rest.partition("/")[0]
    return _from_zero(int(vertex), num_positions), _from_zero(int(uv), num_uvs) if uv else -1


def _from_zero(index: int, count: int) -> int:
    """Return an OBJ index counted from zero; OBJ counts from one, and negative ones back from the last."""
    return index - 1 if index > 0 else count + index


def _fan_starts(points: np.ndarray, polygons: list[list[tuple[int, int]]]) -> np.ndarray:
    """Return for each polygon the corner from which a fan of triangles covers it; -1 if every fan folds over.

    Triangles look to the side of the polygon's area vector (Newell's). Quads are cut along their shorter diagonal
    if both will do, other polygons from their first such corner. So is a polygon with next to no area, in which
    rounding decides where triangles look.
    """
    starts = np.zeros(len(polygons), np.int64)
    sizes = np.array([len(polygon) for polygon in polygons])
    for size in np.unique(sizes[sizes > 3]):
        rows = np.flatnonzero(sizes == size)
        ids = np.array([[vertex for vertex, _ in polygons[row]] for row in rows])
        is_known = (ids.min(axis=1) >= 0) & (ids.max(axis=1) < len(points))
        is_known[is_known] = np.isfinite(points[ids[is_known]]).all(axis=(1, 2))
        rows, ids = rows[is_known], ids[is_known]  # the others are refused later
        corners = points[ids] - points[ids[:, :1]]
        area = np.cross(corners, np.roll(corners, -1, axis=1)).sum(axis=1)
        order = np.tile(np.arange(size), (len(rows), 1))
        if size == 4:
            diagonals = np.linalg.norm(corners[:, :2] - corners[:, 2:], axis=2)
            order = order[:, :2] ^ (diagonals[:, 1] < diagonals[:, 0])[:, None]
        edges = np.square(corners - np.roll(corners, -1, axis=1)).sum(axis=(1, 2))
        is_flat = np.square(area).sum(axis=1) < _SLIVER * np.square(edges)
        starts[rows] = np.where(is_flat, order[:, 0], -1)
        for start in order.T:
            spokes = np.take_along_axis(
                corners, ((start[:, None] + np.arange(size)) % size)[..., None], axis=1
            )
            spokes = spokes[:, 1:] - spokes[:, :1]
            normals = np.cross(spokes[:, :-1], spokes[:, 1:])
            heights = np.einsum("ptx,px->pt", normals, area)
            is_folded = heights.min(axis=1) < _FOLDED * np.einsum("px,px->p", area, area)
            starts[rows] = np.where((starts[rows] < 0) & ~is_folded, start, starts[rows])
    return starts


def _cut_polygons(
    polygons: list[list[tuple[int, int]]], starts: list[int]
) -> tuple[list[list[tuple[int, int]]], list[int]]:
    """Cut polygons into fans of triangles around their start corners; return also each triangle's polygon."""
    triangles, owner = [], []
    for k, (polygon, start) in enumerate(zip(polygons, starts, strict=True)):
        turned = polygon[start:] + polygon[:start]
        for i in range(1, len(turned) - 1):
            triangles.append([turned[0], turned[i], turned[i + 1]])
            owner.append(k)
    return triangles, owner


def _parts(choices: list[list[str]]) -> tuple[np.ndarray | None, tuple[str, ...]]:
    """Return each face's part, and the names, from the first list of names that tells faces apart."""
    for names in choices:
        distinct = tuple(dict.fromkeys(names))
        if len(distinct) > 1:
            index = {name: k for k, name in enumerate(distinct)}
            return np.array([index[name] for name in names]), tuple(name or "unnamed" for name in distinct)
    return None, ()


def _read_ply(path: Path) -> MeshFile:
    """Read a PLY file, text or binary."""
    _check_ply_header(path)
    with path.open("rb") as stream:
        content = load_ply(stream, fix_texture=False, skip_materials=True)
    positions = np.asarray(content.get("vertices", np.empty((0, 3))))
    faces = content.get("faces")
    faces = np.empty((0, 3), np.int64) if faces is None else np.asarray(faces)
    num_polygons = content.get("metadata", {}).get("_ply_raw", {}).get("face", {}).get("length", 0)
    if faces.shape[1:] != (3,) or len(faces) != num_polygons:
        raise MeshError(f"{path}: not all of its {num_polygons} faces are triangles; triangulate the mesh")
    return MeshFile(positions, faces.astype(np.int64))


def _check_ply_header(path: Path) -> None:
    """Raise on an element count that the file is too small for: the parser would allocate it."""
    size = path.stat().st_size
    with path.open("rb") as stream:
        for line in stream.read(1 << 16).partition(b"end_header")[0].splitlines():
            words = line.split()
            if words[:1] == [b"element"] and not (len(words) == 3 and 0 <= int(words[2]) <= size):
                raise ValueError(f"impossible header line {line.decode('latin1')[:60]!r}")


def _read_stl(path: Path) -> MeshFile:
    """Read an STL file, all solids as one mesh, and share its vertices."""
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


def _read_glb(path: Path) -> MeshFile:
    """Read all triangles of a glTF binary into one mesh, in the scene's frame, and share split vertices.

    Morph targets count as much as their weights at rest say.
    """
    document = GltfDocument(path)
    world = document.world_matrices({}, 1)[0]
    positions, corners, uvs, names, materials, count = [], [], [], [], [], 0
    for index, node in enumerate(document.items("nodes")):
        mesh = document.item("meshes", node["mesh"]) if "mesh" in node else {}
        for primitive in mesh.get("primitives", []):
            if primitive.get("mode", TRIANGLES) < TRIANGLES:
                continue  # points and lines
            points, faces = document.shaped_triangles(node, primitive)
            positions.append(points @ world[index, :3, :3].T + world[index, :3, 3])
            corners.append(faces + count)
            count += len(points)
            uv = primitive["attributes"].get("TEXCOORD_0")
            uvs.append(None if uv is None else document.array(uv) * [1, -1] + [0, 1])  # counted from the top
            material = document.items("materials")[primitive["material"]] if "material" in primitive else {}
            names += [str(mesh.get("name", f"mesh{node['mesh']}"))] * len(faces)
            materials += [str(material.get("name", ""))] * len(faces)
    if not positions:
        return MeshFile(np.empty((0, 3)), np.empty((0, 3), np.int64))
    known = [
        uv for uv, points in zip(uvs, positions, strict=True) if uv is not None and len(uv) == len(points)
    ]
    points, faces = np.concatenate(positions), np.concatenate(corners)
    kept, place = shared_vertices(points)
    face_parts, part_names = _parts([names, materials])
    return MeshFile(
        points[kept],
        place[faces],
        corner_uvs=np.concatenate(known)[faces] if len(known) == len(uvs) else None,
        face_parts=face_parts,
        part_names=part_names,
        rows=place,
    )


def _read_npz(path: Path) -> MeshFile:
    """Read `faces` and one of `POSITION_KEYS` from a NumPy archive."""
    arrays = read_arrays(path, content="mesh")
    key = next((key for key in POSITION_KEYS if key in arrays), None)
    if key is None or "faces" not in arrays:
        raise AssetError(
            f"mesh file {path} has the arrays {', '.join(sorted(arrays)) or 'none'}; "
            f"it needs faces and {' or '.join(POSITION_KEYS)}"
        )
    return MeshFile(arrays[key], arrays["faces"])


def shared_vertices(positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find vertices at bit-identical positions, which exporters split where normals or textures differ.

    Args:
        positions: Vertex positions, shape [vertices, 3], or in several shapes, [vertices, shapes, 3].

    Returns:
        Indices of the vertices to keep, in their order, and the place of every vertex among them.
    """
    rows = positions.reshape(len(positions), -1)
    _, first, inverse = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return np.sort(first), rank[inverse.ravel()]


_READERS: dict[str, Callable[[Path], MeshFile]] = {
    ".obj": _read_obj,
    ".ply": _read_ply,
    ".stl": _read_stl,
    ".glb": _read_glb,
    ".npz": _read_npz,
}
