"""Read a mesh that moves and keeps its faces, or stands still: from npz, a folder of meshes, glTF or Alembic."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np

from eslr_jax.errors import AssetError, MeshError, MotionError
from eslr_jax.files.npz import read_arrays
from eslr_jax.files.parsing import split_name
from eslr_jax.pipeline.formats.animated import check_moving
from eslr_jax.pipeline.formats.mesh import read_mesh_file
from eslr_jax.pipeline.formats.registry import find_reader, reader, suffixes_of
from eslr_jax.pose.skeleton import MAX_FRAMES

MAX_POINTS = 1 << 28  # frames times vertices: six gigabytes of float64
DEFAULT_FPS = 30.0  # [1/s], where the files tell no frame rate
# Names of positions in an archive, first match; the last is HOOD's.
POSITION_KEYS = ("rest_positions", "positions", "vertices", "verts")


@dataclasses.dataclass(frozen=True)
class MeshSequence:
    """A triangle mesh that moves."""

    name: str
    positions: np.ndarray  # [frames, vertices, 3] [m], float64
    faces: np.ndarray  # [faces, 3]
    fps: float
    mesh: str = ""  # its name in a file that holds several

    def __post_init__(self) -> None:
        """Raise a MeshError unless this is a finite moving mesh, a MotionError at an impossible frame rate."""
        check_moving(self.positions, self.faces, what=self.name, remedy="export it again")
        if not (np.isfinite(self.fps) and 1.0 <= self.fps <= 1000.0):
            raise MotionError(f"{self.name}: {self.fps} frames per second; expected 1 to 1000")


def read_mesh_sequence(path: str | Path, *, fps: float | None = None) -> MeshSequence:
    """Read a mesh in motion, in metres with Y up.

    Args:
        path: Path of a folder of OBJ or PLY files, which are taken in the order of the numbers in their names; or
            of an .npz with `faces` and positions [frames, vertices, 3], named rest_positions, positions, vertices
            or verts, and optionally `fps` or `timestep`; or of a .glb or .gltf with a mesh that shapes (morph
            targets) move, or of an .abc, `FILE#MESH` where there are several; or of one OBJ, PLY or STL file.
        fps: Frame rate [1/s]; by default the file's own, or 30.

    Raises:
        AssetError: The path or one of its files can't be read, or several meshes move.
        MeshError: The faces change, or the arrays form no mesh.
        MotionError: The frame rate is impossible.
    """
    sequences = read_mesh_sequences(path, fps=fps)
    if len(sequences) != 1:
        known = ", ".join(sequence.mesh for sequence in sequences)
        raise AssetError(
            f"{path}: {len(sequences)} meshes move, not one; it has {known}; name one, as in "
            f"{Path(split_name(path)[0]).name}#NAME"
        )
    return sequences[0]


def read_mesh_sequences(path: str | Path, *, fps: float | None = None) -> list[MeshSequence]:
    """Read all meshes in motion of a file: one, or those of a glTF or Alembic file, over the same frames.

    Arguments and errors are those of `read_mesh_sequence`.
    """
    if Path(path).is_dir():
        return [_read_folder(Path(path), DEFAULT_FPS if fps is None else fps)]
    file, mesh = split_name(path)
    return find_reader("mesh sequence", file)(file, mesh, fps)


@reader("mesh sequence", [".obj", ".ply", ".stl"])
def read_still_mesh(path: Path, _mesh: str = "", fps: float | None = None) -> list[MeshSequence]:
    """Read a mesh of a single frame."""
    mesh = read_mesh_file(path)
    return [MeshSequence(path.name, mesh.positions[None], mesh.faces, DEFAULT_FPS if fps is None else fps)]


def is_mesh_sequence(path: str | Path) -> bool:
    """Tell whether a path is a folder or a file of positions over time, and not a rigged body."""
    suffix = Path(path).suffix.lower()
    if suffix == ".npz":
        arrays = read_arrays(path, content="body", names=POSITION_KEYS)
        return any(array.ndim == 3 for array in arrays.values())
    moves, is_rig = (suffix in suffixes_of(kind) for kind in ("mesh sequence", "body"))
    return Path(path).is_dir() or (moves and not is_rig)


def _read_folder(folder: Path, fps: float) -> MeshSequence:
    """Read one mesh file per frame, in a format that writes as many."""
    known = suffixes_of("frames")
    files = sorted(
        (file for file in folder.iterdir() if file.suffix.lower() in known and file.is_file()),
        key=lambda file: [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", file.name)],
    )
    if not files:
        raise AssetError(f"folder {folder} holds no {' or '.join(known)} files; give one a frame")
    if len({file.suffix.lower() for file in files}) > 1:
        raise AssetError(f"folder {folder} holds both {' and '.join(known)} files; keep one kind")
    if len(files) > MAX_FRAMES:
        raise AssetError(f"folder {folder} holds {len(files)} files; {MAX_FRAMES} at most are read")
    frames, first = [], None
    for file in files:
        mesh = read_mesh_file(file, like=first)
        points, first = mesh.positions, first or mesh
        if points.shape != first.positions.shape or not np.array_equal(mesh.faces, first.faces):
            raise MeshError(
                f"{file} has {len(points)} vertices and {len(mesh.faces)} faces that differ from those of "
                f"{files[0].name}; a sequence keeps its topology"
            )
        frames.append(points)
        if len(frames) * len(points) > MAX_POINTS:
            raise AssetError(f"folder {folder} holds more than {MAX_POINTS} points; reduce the mesh")
    return MeshSequence(folder.name, np.stack(frames), mesh.faces, fps)
