"""Read meshes from Wavefront OBJ, and write one file a frame."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from eslr_jax.errors import MeshError
from eslr_jax.files.parsing import read_lines
from eslr_jax.pipeline.formats.animated import AnimatedMesh, write_frames
from eslr_jax.pipeline.formats.mesh import MeshFile, cut_polygons, name_parts
from eslr_jax.pipeline.formats.registry import reader, writer

_COMMENT = re.compile(r"(?:^|\s)#.*")  # behind a name, which may hold a #


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
    corners = np.array([corner for polygon in polygons for corner in polygon], np.int64).reshape(-1, 2)
    sizes = [len(polygon) for polygon in polygons]
    triangles, owner, starts = cut_polygons(points, sizes, corners[:, 0], None if like is None else like.cuts)
    if (folded := np.flatnonzero(starts < 0)).size:
        raise MeshError(
            f"{path}, line {lines[folded[0]]}: a face that crosses itself, or is too concave to be cut; "
            "triangulate the mesh"
        )
    faces = corners[triangles]
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
