"""Read meshes from Wavefront OBJ, and write one file a frame."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from eslr_jax.errors import MeshError
from eslr_jax.files.parsing import read_lines
from eslr_jax.pipeline.formats.animated import AnimatedMesh, write_frames
from eslr_jax.pipeline.formats.mesh import MeshFile, name_parts
from eslr_jax.pipeline.formats.registry import reader, writer

_COMMENT = re.compile(r"(?:^|\s)#.*")  # behind a name, which may hold a #
_FOLDED = -1e-6  # share of a polygon's squared area below which a triangle looks the other way
_SLIVER = 1e-4  # share of the squared sum of its edges' squares below which a polygon has no area


@reader("mesh", [".obj"])
def read_obj(path: Path, like: MeshFile | None = None) -> MeshFile:
    """Read vertices, faces, texture coordinates and part names of an OBJ file, without normals."""
    positions: list[list[float]] = []
    uvs: list[list[float]] = []
    polygons: list[list[tuple[int, int]]] = []  # corners as (vertex, texture coordinate or -1)
    lines: list[int] = []  # of the polygons
    names: dict[str, list[str]] = {"usemtl": [], "g": [], "o": []}
    current = dict.fromkeys(names, "")
    begun = ""  # of a line that goes on in the next one
    for number, line in enumerate(read_lines(path), 1):
        line, begun = begun + line, ""
        if line.endswith("\\") and "#" not in line:  # a comment may end in a path
            begun = line[:-1] + " "
            continue
        key, rest = (*line.split(maxsplit=1), "", "")[:2]
        if key in current:
            current[key] = _COMMENT.sub("", rest).strip()
            continue
        words = rest.partition("#")[0].split()
        if key == "v":
            positions.append([float(value) for value in words[:3]])
        elif key == "vt":
            uvs.append([float(value) for value in words[:2]])
        elif key == "f":
            if len(words) < 3:
                raise MeshError(f"{path}, line {number}: a face of {len(words)} vertices; remove it")
            polygons.append([_corner(word, len(positions), len(uvs)) for word in words])
            lines.append(number)
            for kind, chosen in names.items():
                chosen.append(current[kind])
    points = np.array(positions, np.float64).reshape(-1, 3)
    starts = None if like is None else like.cuts
    if starts is None or len(starts) != len(polygons):
        starts = _fan_starts(points, polygons)
    if (folded := np.flatnonzero(starts < 0)).size:
        raise MeshError(
            f"{path}, line {lines[folded[0]]}: a face that crosses itself, or is too concave to be cut; "
            "triangulate the mesh"
        )
    fans = [polygon[start:] + polygon[:start] for polygon, start in zip(polygons, starts, strict=True)]
    triangles = [(fan[0], *fan[k : k + 2]) for fan in fans for k in range(1, len(fan) - 1)]
    owner = [k for k, fan in enumerate(fans) for _ in fan[2:]]
    faces = np.array(triangles, np.int64).reshape(-1, 3, 2)
    has_uvs = len(faces) > 0 and bool(np.all((faces[..., 1] >= 0) & (faces[..., 1] < len(uvs))))
    face_parts, part_names = name_parts([[chosen[k] for k in owner] for chosen in names.values()])
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


def obj_text(
    name: str,
    positions: np.ndarray,
    faces: np.ndarray,
    *,
    uvs: np.ndarray | None = None,
    uv_faces: np.ndarray | None = None,
) -> str:
    """Return the text of an OBJ file; nine digits keep float32 positions [m] exactly.

    `uv_faces` has the row of `uvs`, shape [uvs, 2], for each corner, shape [faces, 3].
    """
    lines = [f"o {name}", *(f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in np.asarray(positions, np.float64))]
    if uvs is not None and uv_faces is not None:
        lines += [f"vt {u:.9g} {v:.9g}" for u, v in np.asarray(uvs, np.float64)]
        corners = zip((np.asarray(faces) + 1).tolist(), (np.asarray(uv_faces) + 1).tolist(), strict=True)
        lines += ["f " + " ".join(f"{v}/{t}" for v, t in zip(*corner, strict=True)) for corner in corners]
    else:
        lines += [f"f {a} {b} {c}" for a, b, c in (np.asarray(faces) + 1).tolist()]
    return "\n".join(lines) + "\n"


@writer("frames", [".obj"])
def write_obj_frames(folder: Path, meshes: Sequence[AnimatedMesh], timestep: float) -> None:
    """Write an OBJ file a frame."""
    mesh = meshes[0]
    uvs = uv_faces = None
    if mesh.corner_uvs is not None:
        corners = np.asarray(mesh.corner_uvs, np.float64).reshape(-1, 2)
        uvs, inverse = np.unique(corners, axis=0, return_inverse=True)
        uv_faces = inverse.reshape(-1, 3)

    def content(positions: np.ndarray) -> bytes:
        return obj_text(mesh.name, positions, mesh.faces, uvs=uvs, uv_faces=uv_faces).encode()

    write_frames(folder, mesh, ".obj", content)
