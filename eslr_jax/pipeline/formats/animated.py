"""Meshes that move, and the joints that move them, as the formats of other programs want them.

Checked; one texture coordinate a vertex; few shapes; local motions of joints, and what these leave of a motion.
"""

from __future__ import annotations

import dataclasses
import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import scipy.sparse
from scipy.spatial.transform import Rotation

from eslr_jax.errors import AssetError, EslrError, MeshError, MotionError
from eslr_jax.files.atomic import atomic_write, ensure_output_dir
from eslr_jax.files.npz import check_layout
from eslr_jax.mesh import topology
from eslr_jax.pipeline.formats.palette import GARMENT_COLORS, Color

_RIGID_TOLERANCE = 1e-3  # entries of R^T R - I that forward kinematics in float32 may reach
_FLAT = 0.05  # determinant of blended rotations below which a vertex can't be moved in every direction
# A skin weight that moves a vertex by less than float32 resolves over a body's size.
_NEGLIGIBLE_WEIGHT = 1e-6
MESH_LAYOUT = {  # of an AnimatedMesh and its Skin
    "positions": ("f", "frames vertices 3"),
    "faces": ("iu", "faces 3", "vertices"),
    "corner_uvs": ("f", "faces 3 2"),
    "velocities": ("f", "frames vertices 3"),
    "rest_positions": ("f", "vertices 3"),
    "joint_transforms": ("f", "frames joints 3 4"),
    "joint_rest_positions": ("f", "joints 3"),
    "parents": ("iu", "joints"),
    "joint_names": ("U", "joints"),
    "skin_weights": ("f", "vertices influences"),
    "skin_indices": ("iu", "vertices influences", "joints"),
}


@dataclasses.dataclass(frozen=True)
class Skin:
    """Joints that move, and how a mesh is bound to them: posed = sum_j weight_j (R_j rest + t_j)."""

    skin_weights: np.ndarray  # [vertices, influences], rows sum to one
    skin_indices: np.ndarray  # [vertices, influences]
    joint_transforms: np.ndarray  # [frames, joints, 3, 4], rest point -> posed point [m]
    joint_rest_positions: np.ndarray  # [joints, 3] [m]
    parents: Sequence[int]  # -1 is a root
    joint_names: Sequence[str]


@dataclasses.dataclass(frozen=True)
class AnimatedMesh:
    """A triangle mesh that moves."""

    name: str
    positions: np.ndarray  # [frames, vertices, 3] [m]
    faces: np.ndarray  # [faces, 3]
    color: Color = GARMENT_COLORS[0]
    corner_uvs: np.ndarray | None = None  # texture coordinates of each face's corners, v up [faces, 3, 2]
    velocities: np.ndarray | None = None  # [frames, vertices, 3] [m/s]
    rest_positions: np.ndarray | None = None  # [vertices, 3] [m], what `skin` moves
    skin: Skin | None = None  # joints that move it, exactly or nearly
    # Which faces a part has [faces].
    parts: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)


def check_moving(
    positions: np.ndarray,
    faces: np.ndarray,
    *,
    what: str,
    remedy: str,
    not_finite: type[EslrError] = MeshError,
) -> None:
    """Raise a MeshError, or `not_finite`, unless arrays are a mesh over time; see `check_layout`."""
    arrays = {"positions": positions, "faces": faces}
    check_layout(arrays, MESH_LAYOUT, what=what, remedy=remedy, error=MeshError)
    if 0 in positions.shape or not len(faces):
        raise MeshError(f"{what} has no frames, vertices or faces; {remedy}")
    is_finite = np.isfinite(positions).all((1, 2))
    if not is_finite.all():
        raise not_finite(f"{what} is not finite in frame {np.argmin(is_finite)}; {remedy}")


def check_meshes(meshes: Sequence[AnimatedMesh], timestep: float) -> None:
    """Raise a MeshError or a MotionError unless meshes can be written as one scene with this timestep [s]."""
    if not np.isfinite(timestep) or timestep <= 0:
        raise MotionError(f"timestep is {timestep} s; it must be positive")
    if not meshes:
        raise MeshError("no mesh to write; give at least one")
    for mesh in meshes:
        what, remedy = f"mesh {mesh.name}", "simulate it again"
        values = vars(mesh) | ({} if mesh.skin is None else vars(mesh.skin))
        arrays = {key: np.asarray(values[key]) for key in MESH_LAYOUT if values.get(key) is not None}
        check_layout(arrays, MESH_LAYOUT, what=what, remedy=remedy, error=MeshError)
        check_moving(arrays["positions"], arrays["faces"], what=what, remedy=remedy)
        if mesh.skin is None:
            continue
        if mesh.rest_positions is None:
            raise MeshError(f"{what} has a skin and no rest positions; give both")
        weights, transforms = arrays["skin_weights"], arrays["joint_transforms"]
        if weights.min() < 0 or not np.allclose(weights.sum(1), 1, atol=1e-3):
            raise MeshError(
                f"{what} has skin weights that are negative or don't sum to one; normalise them first"
            )
        matrices = transforms[..., :3]
        gram = np.einsum("tjab,tjac->tjbc", matrices, matrices)
        is_rigid = (np.abs(gram - np.eye(3)) < _RIGID_TOLERANCE).all((2, 3)) & (np.linalg.det(matrices) > 0)
        is_rigid &= np.isfinite(transforms).all((2, 3))
        if not is_rigid.all():
            frame, joint = np.argwhere(~is_rigid)[0]
            raise MotionError(
                f"{what}: joint {joint} is not rotated rigidly in frame {frame}; leave out its skin"
            )
    frames = {mesh.name: len(mesh.positions) for mesh in meshes}
    if len(set(frames.values())) > 1:
        raise MotionError(f"meshes need the same number of frames, these have {frames}")


def identifiers(names: Sequence[str]) -> list[str]:
    """Return distinct names of letters, digits and underscores, as the scenes of other programs want them."""
    result: list[str] = []
    for name in names:
        base = "".join(letter if letter.isascii() and letter.isalnum() else "_" for letter in name) or "mesh"
        base = f"_{base}" if base[0].isdigit() else base
        number, unique = 1, base
        while unique in result:
            number += 1
            unique = f"{base}_{number}"
        result.append(unique)
    return result


def split_seams(
    faces: np.ndarray, num_vertices: int, corner_uvs: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Give each vertex one texture coordinate by splitting the vertices on seams, if there are `corner_uvs`.

    Returns:
        Faces; the old vertex of each new one, where old vertices come first and in order; and texture coordinates
        [vertices, 2], zero for vertices without a face.
    """
    if corner_uvs is None:
        return faces, np.arange(num_vertices), None
    corners = faces.reshape(-1)
    values = np.asarray(corner_uvs, np.float32).reshape(-1, 2)
    keys = np.concatenate([corners[:, None].astype(np.float64), values.astype(np.float64)], axis=1)
    _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)  # as they come in the file
    owner = corners[first[order]]
    is_extra = np.ones(len(owner), bool)
    is_extra[np.unique(owner, return_index=True)[1]] = False  # the first coordinate of each vertex
    place = np.where(is_extra, num_vertices - 1 + np.cumsum(is_extra), owner)
    uvs = np.zeros((num_vertices + np.sum(is_extra), 2), np.float32)
    uvs[place] = values[first[order]]
    split = place[np.argsort(order)[inverse.ravel()]].reshape(-1, 3)
    return split, np.concatenate([np.arange(num_vertices), owner[is_extra]]), uvs


def vertex_normals(positions: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return `topology.vertex_normals` as files have them.

    Returns:
        Unit normals, shape [vertices, 3], float32; (0, 1, 0) where a vertex has no face.
    """
    normals = topology.vertex_normals(positions.astype(np.float64), faces)
    return np.where(normals.any(axis=1, keepdims=True), normals, [0.0, 1.0, 0.0]).astype(np.float32)


def principal_shapes(offsets: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Find few shapes whose weighted sums are the offsets of every frame (principal component analysis).

    A shape is `basis.T @ offsets`, and `basis[t]` holds its weight in frame t. Other values per frame, such as
    normals, may be projected on the same basis. No vertex is off by more than the tolerance [m] in any frame.

    Returns:
        Basis [frames, shapes] with orthonormal columns, and the shapes [shapes, vertices, 3] [m].
    """
    table = np.asarray(offsets, np.float64).reshape(len(offsets), -1)
    values, vectors = np.linalg.eigh(table @ table.T)
    values, basis = np.maximum(values[::-1], 0.0), vectors[:, ::-1]
    # No vertex errs less than the mean square of the shapes left out: begin there, and add until the worst fits.
    left = np.append(np.cumsum(values[::-1])[::-1], 0.0) / (table.size / 3)
    count = int(np.argmax(left <= tolerance**2))
    while True:
        shapes = basis[:, :count].T @ table
        away = np.linalg.norm((table - basis[:, :count] @ shapes).reshape(-1, 3), axis=1).max()
        if away <= tolerance or count >= len(table):
            return basis[:, :count], shapes.reshape(count, *np.shape(offsets)[1:])
        count = min(len(table), count + max(1, count // 8))


def influences(skin: Skin) -> tuple[np.ndarray, np.ndarray]:
    """Return skin weights that matter, largest first, and their joints, both [vertices, influences]."""
    weights, indices = np.asarray(skin.skin_weights, np.float64), np.asarray(skin.skin_indices)
    order = np.argsort(-weights, axis=1, kind="stable")
    weights, indices = np.take_along_axis(weights, order, 1), np.take_along_axis(indices, order, 1)
    used = max(1, int((weights > _NEGLIGIBLE_WEIGHT).any(0).sum()))
    weights, indices = weights[:, :used], indices[:, :used]
    return weights / weights.sum(1, keepdims=True), np.where(weights > 0, indices, 0)


def local_motion(skin: Skin) -> tuple[np.ndarray, np.ndarray]:
    """Split joint transforms into rotations and translations relative to each joint's parent.

    Returns:
        Quaternions (x, y, z, w), shape [frames, joints, 4], which never take the long way round from one frame to
        the next, and translations [m], shape [frames, joints, 3]. At rest no joint is rotated.
    """
    transforms = np.asarray(skin.joint_transforms, np.float64)
    matrices, rest = transforms[..., :3], np.asarray(skin.joint_rest_positions, np.float64)
    origins = np.einsum("tjab,jb->tja", matrices, rest) + transforms[..., 3]
    rotations, translations = np.empty((*transforms.shape[:2], 4)), np.empty((*transforms.shape[:2], 3))
    for joint, parent in enumerate(skin.parents):
        local, shift = matrices[:, joint], origins[:, joint]
        if parent >= 0:
            local = np.einsum("tba,tbc->tac", matrices[:, parent], local)
            shift = np.einsum("tba,tb->ta", matrices[:, parent], shift - origins[:, parent])
        quaternions = Rotation.from_matrix(local).as_quat()
        flips = np.einsum("ti,ti->t", quaternions[1:], quaternions[:-1]) < 0
        signs = np.concatenate([[1.0], np.where(np.cumsum(flips) % 2, -1.0, 1.0)])
        rotations[:, joint], translations[:, joint] = quaternions * signs[:, None], shift
    return rotations.astype(np.float32), translations.astype(np.float32)


def corrections(mesh: AnimatedMesh, skin: Skin, tolerance: float) -> np.ndarray | None:
    """Return what to add to a mesh's vertices at rest so that the joints of its skin move them to their places.

    That is offsets [m], shape [frames, vertices, 3], float32; None where the joints alone keep the tolerance [m].
    """
    rest, positions = (np.asarray(part, np.float32) for part in (mesh.rest_positions, mesh.positions))
    weights, indices = influences(skin)
    rows = np.repeat(np.arange(len(rest)), weights.shape[1])
    blend = scipy.sparse.csr_array((weights.ravel(), (rows, indices.ravel())), (len(rest), len(skin.parents)))
    transforms = np.asarray(skin.joint_transforms, np.float64).reshape(len(positions), -1, 12)

    def blended(frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Return each vertex's matrix, and what the joints leave of its way."""
        matrices = (blend @ transforms[frame]).reshape(-1, 3, 4)
        moved = np.einsum("vab,vb->va", matrices[..., :3], rest) + matrices[..., 3]
        return matrices[..., :3], positions[frame] - moved

    frames = range(len(positions))
    if all(np.linalg.norm(blended(frame)[1], axis=1).max() <= tolerance for frame in frames):
        return None
    result = np.zeros(np.shape(positions), np.float32)
    for frame in frames:
        matrices, away = blended(frame)
        # Where opposite rotations cancel, no offset helps: a blend of rotations near zero counts as the identity.
        is_flat = np.abs(np.linalg.det(matrices)) < _FLAT
        matrices[is_flat] = np.eye(3)
        result[frame] = np.linalg.solve(matrices, away[..., None])[..., 0]
    return result


def write_frames(
    folder: str | Path, mesh: AnimatedMesh, suffix: str, content: Callable[[np.ndarray], bytes]
) -> None:
    """Write one file per frame into a new folder, which appears when it is complete.

    Names sort alphabetically in the order of the frames. `content` makes the bytes of a file of a frame's
    positions, [vertices, 3] in float32.
    """
    target = Path(folder)
    if target.is_file() or (target.is_dir() and any(target.iterdir())):
        raise AssetError(f"{target} exists already; name a new folder for the sequence")
    digits = max(4, len(str(len(mesh.positions) - 1)))
    with tempfile.TemporaryDirectory(prefix=".new-", dir=ensure_output_dir(target.parent)) as name:
        parts = ensure_output_dir(Path(name) / target.name)
        try:
            for frame, positions in enumerate(np.asarray(mesh.positions, np.float32)):
                with atomic_write(parts / f"{mesh.name}_{frame:0{digits}d}{suffix}") as temporary:
                    temporary.write_bytes(content(positions))
            if target.is_dir():
                target.rmdir()
            os.replace(parts, target)
        except OSError as error:
            raise AssetError(f"can't write {target}: {error.strerror}; choose another folder") from error
