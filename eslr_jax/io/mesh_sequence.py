"""Read a mesh that moves and keeps its faces: an npz archive, or a folder with one OBJ or PLY file per frame."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np

from eslr_jax.errors import AssetError, MeshError, MotionError
from eslr_jax.io.mesh import POSITION_KEYS, read_mesh
from eslr_jax.io.motion import read_number
from eslr_jax.io.npz import check_layout, read_arrays
from eslr_jax.io.skeleton import MAX_FRAMES

MAX_POINTS = 1 << 28  # frames times vertices: six gigabytes of float64
SUFFIXES = (".obj", ".ply")
DEFAULT_FPS = 30.0  # [1/s], where the files tell no frame rate
_POSITION_KEYS = (*POSITION_KEYS, "verts")  # the last is HOOD's


@dataclasses.dataclass(frozen=True)
class MeshSequence:
    """A triangle mesh that moves."""

    name: str
    positions: np.ndarray  # [frames, vertices, 3] [m], float64
    faces: np.ndarray  # [faces, 3]
    fps: float

    def __post_init__(self) -> None:
        """Check the arrays.

        Raises:
            MeshError: The arrays don't form a moving mesh, or a value is not finite.
            MotionError: The frame rate is impossible.
        """
        arrays = {"positions": self.positions, "faces": self.faces}
        layout = {"positions": ("f", "frames vertices 3"), "faces": ("iu", "faces 3", "vertices")}
        check_layout(arrays, layout, what=self.name, remedy="export it again", error=MeshError)
        if 0 in self.positions.shape or not len(self.faces):
            raise MeshError(f"{self.name} has no frames, vertices or faces; export it again")
        is_bad = ~np.isfinite(self.positions).all(axis=(1, 2))
        if is_bad.any():
            raise MeshError(f"{self.name}: frame {np.argmax(is_bad)} is not finite; cut or repair it")
        if not (np.isfinite(self.fps) and 1.0 <= self.fps <= 1000.0):
            raise MotionError(f"{self.name}: {self.fps} frames per second; expected 1 to 1000")


def read_mesh_sequence(path: str | Path, *, fps: float | None = None) -> MeshSequence:
    """Read a mesh in motion.

    Args:
        path: Path of a folder of OBJ or PLY files, which are taken in the order of the numbers in their names; or
            of an .npz with `faces` and positions [frames, vertices, 3], named rest_positions, positions, vertices
            or verts, and optionally `fps` or `timestep`.
        fps: Frame rate [1/s]; by default the archive's own, or 30.

    Returns:
        The mesh in motion; positions as in the files, which must be in metres with Y up.

    Raises:
        AssetError: The path or one of its files can't be read.
        MeshError: The faces change, or the arrays form no mesh.
        MotionError: The frame rate is impossible.
    """
    path = Path(path)
    if path.is_dir():
        return _read_folder(path, fps or DEFAULT_FPS)
    keys = (*_POSITION_KEYS, "faces", "fps", "timestep")
    arrays = read_arrays(path, content="mesh sequence", names=keys)
    key = next((key for key in _POSITION_KEYS if key in arrays), None)
    if key is None or "faces" not in arrays:
        raise AssetError(f"mesh sequence {path} lacks faces or {' or '.join(_POSITION_KEYS)}; add them")
    positions, faces = arrays[key], arrays["faces"]
    if positions.dtype.kind not in "fiu":
        raise MeshError(f"{path}: {key} of type {positions.dtype}; expected numbers")
    rate = fps
    if rate is None and "fps" in arrays:
        rate = read_number(arrays["fps"], f"{path}: fps")
    elif rate is None and "timestep" in arrays:
        step = read_number(arrays["timestep"], f"{path}: timestep")
        rate = 1.0 / step if step > 0 else 0.0
    return MeshSequence(path.name, positions.astype(np.float64), faces, DEFAULT_FPS if rate is None else rate)


def is_mesh_sequence(path: str | Path) -> bool:
    """Tell whether a path is a folder or an archive of positions over time, and not a rigged body."""
    path = Path(path)
    if path.is_dir():
        return True
    if path.suffix.lower() != ".npz":
        return False
    arrays = read_arrays(path, content="body", names=_POSITION_KEYS)
    return any(array.ndim == 3 for array in arrays.values())


def _read_folder(folder: Path, fps: float) -> MeshSequence:
    """Read one mesh file per frame."""
    files = sorted(
        (file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES and file.is_file()),
        key=lambda file: [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", file.name)],
    )
    if not files:
        raise AssetError(f"folder {folder} holds no {' or '.join(SUFFIXES)} files; give one a frame")
    if len({file.suffix.lower() for file in files}) > 1:
        raise AssetError(f"folder {folder} holds both {' and '.join(SUFFIXES)} files; keep one kind")
    if len(files) > MAX_FRAMES:
        raise AssetError(f"folder {folder} holds {len(files)} files; {MAX_FRAMES} at most are read")
    frames, faces = [], np.empty((0, 3), np.int64)
    for file in files:
        points, triangles = read_mesh(file)
        if not frames:
            faces = triangles
        elif points.shape != frames[0].shape or not np.array_equal(triangles, faces):
            raise MeshError(
                f"{file} has {len(points)} vertices and {len(triangles)} faces that differ from those of "
                f"{files[0].name}; a sequence keeps its topology"
            )
        frames.append(points)
        if len(frames) * len(points) > MAX_POINTS:
            raise AssetError(f"folder {folder} holds more than {MAX_POINTS} points; reduce the mesh")
    return MeshSequence(folder.name, np.stack(frames), faces, fps)


def frame_name(stem: str, frame: int, num_frames: int, suffix: str) -> str:
    """Return a file name; names sort alphabetically in the order of the frames."""
    digits = max(4, len(str(max(num_frames - 1, 0))))
    return f"{stem}_{frame:0{digits}d}{suffix}"


def obj_text(
    name: str,
    positions: np.ndarray,
    faces: np.ndarray,
    *,
    uvs: np.ndarray | None = None,
    uv_faces: np.ndarray | None = None,
) -> str:
    """Return the text of an OBJ file; nine digits keep float32 positions exactly.

    Args:
        name: Name of the object.
        positions: Vertex positions [m], shape [vertices, 3].
        faces: Triangles, shape [faces, 3].
        uvs: Texture coordinates, shape [uvs, 2].
        uv_faces: Row of `uvs` for each corner, shape [faces, 3].
    """
    lines = [f"o {name}", *(f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in np.asarray(positions, np.float64))]
    if uvs is not None and uv_faces is not None:
        lines += [f"vt {u:.9g} {v:.9g}" for u, v in np.asarray(uvs, np.float64)]
        corners = zip((np.asarray(faces) + 1).tolist(), (np.asarray(uv_faces) + 1).tolist(), strict=True)
        lines += ["f " + " ".join(f"{v}/{t}" for v, t in zip(*corner, strict=True)) for corner in corners]
    else:
        lines += [f"f {a} {b} {c}" for a, b, c in (np.asarray(faces) + 1).tolist()]
    return "\n".join(lines) + "\n"
