"""Read a mesh that moves and keeps its faces: an npz archive, a folder of meshes, or shapes of a glTF file."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np

from eslr_jax.errors import AssetError, MeshError, MotionError
from eslr_jax.io.gltf_document import MOVES, GltfDocument, sample_keys
from eslr_jax.io.mesh import POSITION_KEYS, read_mesh_file, shared_vertices
from eslr_jax.io.motion import read_number
from eslr_jax.io.npz import check_layout, read_arrays
from eslr_jax.io.parsing import parsing, split_name
from eslr_jax.io.skeleton import MAX_FRAMES, whole_rate

MAX_POINTS = 1 << 28  # frames times vertices: six gigabytes of float64
SUFFIXES = (".obj", ".ply")
GLTF_SUFFIXES = (".glb", ".gltf")
DEFAULT_FPS = 30.0  # [1/s], where the files tell no frame rate
_POSITION_KEYS = (*POSITION_KEYS, "verts")  # the last is HOOD's


@dataclasses.dataclass(frozen=True)
class MeshSequence:
    """A triangle mesh that moves."""

    name: str
    positions: np.ndarray  # [frames, vertices, 3] [m], float64
    faces: np.ndarray  # [faces, 3]
    fps: float
    mesh: str = ""  # its name in a file that holds several

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
            or verts, and optionally `fps` or `timestep`; or of a .glb or .gltf with a mesh that shapes (morph
            targets) move, `FILE#MESH` where there are several.
        fps: Frame rate [1/s]; by default the file's own, or 30.

    Returns:
        The mesh in motion; positions as in the files, which must be in metres with Y up.

    Raises:
        AssetError: The path or one of its files can't be read, or several meshes move.
        MeshError: The faces change, or the arrays form no mesh.
        MotionError: The frame rate is impossible.
    """
    sequences = read_mesh_sequences(path, fps=fps)
    if len(sequences) != 1:
        known = ", ".join(sequence.mesh for sequence in sequences)
        raise AssetError(
            f"{path}: {len(sequences)} meshes are moved by shapes, not one; it has {known}; name one, as in "
            f"{Path(split_name(path)[0]).name}#NAME"
        )
    return sequences[0]


def read_mesh_sequences(path: str | Path, *, fps: float | None = None) -> list[MeshSequence]:
    """Read all meshes in motion of a file: one, or those that shapes move in a glTF file, over the same frames.

    Arguments and errors are those of `read_mesh_sequence`.
    """
    file, mesh = split_name(path)
    if Path(file).suffix.lower() in GLTF_SUFFIXES:
        return _read_gltf(Path(file), mesh, fps)
    path = Path(path)
    return [
        _read_folder(path, DEFAULT_FPS if fps is None else fps) if path.is_dir() else _read_archive(path, fps)
    ]


def _read_archive(path: Path, fps: float | None) -> MeshSequence:
    """Read an npz file."""
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
        rate = whole_rate(1.0 / step) if step > 0 else 0.0
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
    frames, faces, first = [], np.empty((0, 3), np.int64), None
    for file in files:
        mesh = read_mesh_file(file, like=first)
        points, triangles = mesh.positions, mesh.faces
        if first is None:
            first, faces = mesh, triangles
        elif points.shape != frames[0].shape or not np.array_equal(triangles, faces):
            raise MeshError(
                f"{file} has {len(points)} vertices and {len(triangles)} faces that differ from those of "
                f"{files[0].name}; a sequence keeps its topology"
            )
        frames.append(points)
        if len(frames) * len(points) > MAX_POINTS:
            raise AssetError(f"folder {folder} holds more than {MAX_POINTS} points; reduce the mesh")
    return MeshSequence(folder.name, np.stack(frames), faces, fps)


def _read_gltf(path: Path, name: str, fps: float | None) -> list[MeshSequence]:
    """Read the meshes that morph targets and nodes move, all or those of a name."""
    with parsing(path, "mesh sequence") as file:
        document = GltfDocument(file)
        animations = document.items("animations")
        shapes = {key[0]: key for entry in animations for key in document.key_frames(entry, ("weights",))}
        nodes = {node: document.item("nodes", node) for node in shapes}
        found = {
            node: str(entry.get("name") or document.item("meshes", entry.get("mesh")).get("name"))
            for node, entry in nodes.items()
            if "skin" not in entry  # a body
        }
        chosen = [node for node, known in found.items() if name in ("", known)]
        if not chosen:
            known = ", ".join(found.values()) or "none"
            raise AssetError(
                f"{path}: no mesh{name and f' named {name!r}'} is moved by shapes; it has {known}; export the "
                "garment with its shape keys"
            )
        _check_one_clip(document, chosen)
        at, rate = document.sample_times([shapes[node][3] for node in chosen], fps)
        moves = [key for entry in animations for key in document.key_frames(entry)]
        moved = {
            (node, path): sample_keys(path, how, keys, at_keys, at)
            for node, path, how, keys, at_keys in moves
        }
        world = document.world_matrices(moved, len(at))
        sequences = []
        for node in chosen:
            _, _, kind, times, values = shapes[node]
            weights = sample_keys("weights", kind, times, values, at)
            positions, faces = _moved_by_shapes(document, nodes[node]["mesh"], weights, world[:, node])
            label = path.name if len(found) == 1 else f"{path.name}#{found[node]}"
            sequences.append(MeshSequence(label, positions, faces, rate, found[node]))
        return sequences


def _check_one_clip(document: GltfDocument, nodes: list[int]) -> None:
    """Raise an AssetError if several animations give a mesh, or what carries it, the same values.

    Animations of other nodes, such as a character's, may be as many as they like.
    """
    carriers = set()
    for node in nodes:
        while node >= 0 and node not in carriers:
            carriers.add(node)
            node = document.parents[node]
    clips = [
        {key[:2] for key in document.key_frames(entry, (*MOVES, "weights")) if key[0] in carriers}
        for entry in document.items("animations")
    ]
    clips = [keyed for keyed in clips if keyed]
    if sum(map(len, clips)) > len(set().union(*clips)):
        raise AssetError(f"{document.path} holds {len(clips)} clips; export one")


def _moved_by_shapes(
    document: GltfDocument, index: int, weights: np.ndarray, world: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return positions [m] and faces of a mesh; vertices that were split at seams become one again.

    Args:
        document: Its file.
        index: Its number.
        weights: Of its shapes, shape [frames, shapes].
        world: From its own space to the world's, shape [frames, 4, 4].
    """
    shapes, faces = _read_shapes(document, index)
    if weights.shape[1] != len(shapes) - 1 or len(weights) * shapes.shape[1] > MAX_POINTS:
        raise document.fail(f"has {weights.shape[1]} weights for {len(shapes) - 1} shapes of a mesh")
    kept, place = shared_vertices(shapes.swapaxes(0, 1))
    local = shapes[0, kept] + np.tensordot(weights, shapes[1:, kept], axes=1)
    return np.einsum("fij,fvj->fvi", world[:, :3, :3], local) + world[:, None, :3, 3], place[faces]


def _read_shapes(document: GltfDocument, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a mesh and the offsets of its shapes, [1 + shapes, vertices, 3], and its faces."""
    parts, faces, count = [], [], 0
    for primitive in document.item("meshes", index).get("primitives", []):
        points, triangles = document.triangles(primitive)
        offsets = [document.offsets(target, points.shape) for target in primitive.get("targets", [])]
        parts.append(np.stack([points, *offsets]))
        faces.append(triangles + count)
        count += len(points)
    return np.concatenate(parts, axis=1), np.concatenate(faces)


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
