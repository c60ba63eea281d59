"""Triangle meshes of a user: OBJ, PLY, STL, glTF binary and NumPy archives, as the file has them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from trimesh import load_scene
from trimesh.exchange.ply import load_ply
from trimesh.exchange.stl import load_stl

from eslr_jax.errors import AssetError, MeshError
from eslr_jax.io.npz import read_arrays

Mesh = tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]

POSITION_KEYS = ("rest_positions", "positions", "vertices")  # accepted in an archive, first match


def read_mesh(path: str | Path) -> Mesh:
    """Read a triangle mesh without repairing it.

    OBJ, PLY and NPZ keep their vertices and order. STL can't share a vertex between faces, and GLB splits
    vertices where normals or texture coordinates differ, so there vertices at bit-identical positions
    become one.

    Args:
        path: A .obj, .ply, .stl, .glb or .npz file, in metres, Y up.

    Returns:
        Positions [m], float64, shape [vertices, 3], and faces, int64, shape [faces, 3]; unvalidated.

    Raises:
        AssetError: The file is missing, unreadable or of an unknown kind.
        MeshError: The file has faces that are not triangles.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in _READERS:
        known = ", ".join(_READERS)
        raise AssetError(f"mesh file {path} has the unknown suffix {suffix!r}; convert it to one of {known}")
    if not path.is_file():
        cause = "is a folder" if path.is_dir() else "doesn't exist"
        raise AssetError(f"mesh file {path} {cause}; check the path")
    try:
        positions, faces = _READERS[suffix](path)
    except (AssetError, MeshError):
        raise
    except Exception as error:  # a parser may raise anything on a damaged file
        reason = (str(error).splitlines() or [""])[0] or type(error).__name__
        raise AssetError(f"mesh file {path} can't be read ({reason}); export it again") from error
    return np.array(positions, np.float64), np.array(faces)


def _read_obj(path: Path) -> Mesh:
    """Read vertices and faces of an OBJ file; normals, texture coordinates and materials are skipped."""
    positions, faces = [], []
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
        key, _, rest = line.partition("#")[0].strip().partition(" ")
        if key == "v":
            positions.append([float(value) for value in rest.split()[:3]])
        elif key == "f":
            corners = [int(word.partition("/")[0]) for word in rest.split()]
            if len(corners) != 3:
                raise MeshError(
                    f"{path}, line {number}: a face of {len(corners)} vertices; triangulate the mesh"
                )
            # OBJ counts from one; negative indices count back from the vertices read so far
            faces.append([index - 1 if index > 0 else len(positions) + index for index in corners])
    return np.array(positions, np.float64).reshape(-1, 3), np.array(faces, np.int64).reshape(-1, 3)


def _read_ply(path: Path) -> Mesh:
    """Read a PLY file, text or binary."""
    with path.open("rb") as stream:
        content = load_ply(stream, fix_texture=False, skip_materials=True)
    positions = np.asarray(content.get("vertices", np.empty((0, 3))))
    faces = content.get("faces")
    faces = np.empty((0, 3), np.int64) if faces is None else np.asarray(faces)
    num_polygons = content.get("metadata", {}).get("_ply_raw", {}).get("face", {}).get("length", 0)
    if faces.shape[1:] != (3,) or len(faces) != num_polygons:
        raise MeshError(f"{path}: not all of its {num_polygons} faces are triangles; triangulate the mesh")
    return positions, faces.astype(np.int64)


def _read_stl(path: Path) -> Mesh:
    """Read an STL file and share the corners that have bit-identical positions."""
    with path.open("rb") as stream:
        content = load_stl(stream)
    content = next(iter(content.get("geometry", {}).values()), content)  # text files nest their solids
    return _share_vertices(np.asarray(content["vertices"]), np.asarray(content["faces"], np.int64))


def _read_glb(path: Path) -> Mesh:
    """Read all meshes of a glTF binary into one, in the scene's frame, sharing split vertices."""
    mesh = load_scene(path, process=False).to_mesh()
    return _share_vertices(np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int64))


def _read_npz(path: Path) -> Mesh:
    """Read `faces` and one of `POSITION_KEYS` from a NumPy archive."""
    arrays = read_arrays(path, content="mesh")
    key = next((key for key in POSITION_KEYS if key in arrays), None)
    if key is None or "faces" not in arrays:
        raise AssetError(
            f"mesh file {path} has the arrays {', '.join(sorted(arrays)) or 'none'}; "
            f"it needs faces and {' or '.join(POSITION_KEYS)}"
        )
    return arrays[key], arrays["faces"]


def _share_vertices(positions: np.ndarray, faces: np.ndarray) -> Mesh:
    """Return the mesh with bit-identical positions made one vertex, in order of first appearance."""
    if not len(positions):
        return positions.reshape(-1, 3), faces.reshape(-1, 3)
    _, first, inverse = np.unique(positions, axis=0, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return positions[np.sort(first)], rank[inverse.ravel()][faces]


_READERS: dict[str, Callable[[Path], Mesh]] = {
    ".obj": _read_obj,
    ".ply": _read_ply,
    ".stl": _read_stl,
    ".glb": _read_glb,
    ".npz": _read_npz,
}
