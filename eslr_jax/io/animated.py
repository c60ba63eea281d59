"""Meshes that move, as scene formats want them: checked, one texture coordinate a vertex, few shapes."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from eslr_jax.errors import MeshError, MotionError
from eslr_jax.io.palette import GARMENT_COLORS, Color
from eslr_jax.io.skin import Skin, check_skin


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


def check_meshes(meshes: Sequence[AnimatedMesh], timestep: float) -> None:
    """Raise unless meshes can be written as one scene.

    Args:
        meshes: The meshes.
        timestep: Time between frames [s].

    Raises:
        MeshError: There is no mesh, or one is empty, not finite, or its parts disagree.
        MotionError: The timestep is not positive, frames differ in number, or joints don't move rigidly.
    """
    if not np.isfinite(timestep) or timestep <= 0:
        raise MotionError(f"timestep is {timestep} s; it must be positive")
    if not meshes:
        raise MeshError("no mesh to write; give at least one")
    for mesh in meshes:
        _check_mesh(mesh)
    frames = {mesh.name: len(mesh.positions) for mesh in meshes}
    frames |= {f"{mesh.name} joints": len(mesh.skin.joint_transforms) for mesh in meshes if mesh.skin}
    if len(set(frames.values())) > 1:
        raise MotionError(f"meshes need the same number of frames, these have {frames}")


def _check_mesh(mesh: AnimatedMesh) -> None:
    """Raise MeshError unless the arrays of a mesh are finite and fit each other."""
    points, faces = np.asarray(mesh.positions), np.asarray(mesh.faces)
    is_mesh = points.ndim == 3 and points.shape[2] == 3 and faces.ndim == 2 and faces.shape[1] == 3
    if not is_mesh or 0 in points.shape or not len(faces):
        raise MeshError(
            f"mesh {mesh.name} has positions {points.shape} and faces {faces.shape}; it needs "
            "[frames, vertices, 3] and [faces, 3]"
        )
    is_finite = np.isfinite(points).all((1, 2))
    if not is_finite.all():
        raise MeshError(f"mesh {mesh.name} is not finite in frame {np.argmin(is_finite)}; simulate it again")
    if faces.min() < 0 or faces.max() >= points.shape[1]:
        raise MeshError(f"mesh {mesh.name} has a face that names vertex {faces.max()} of {points.shape[1]}")
    for label, array, shape in (
        ("texture coordinates", mesh.corner_uvs, (len(faces), 3, 2)),
        ("velocities", mesh.velocities, points.shape),
        ("rest positions", mesh.rest_positions, points.shape[1:]),
    ):
        if array is not None and np.shape(array) != shape:
            raise MeshError(f"mesh {mesh.name} has {label} {np.shape(array)}; expected {shape}")
    if mesh.skin is not None:
        if mesh.rest_positions is None:
            raise MeshError(f"mesh {mesh.name} has a skin and no rest positions; give both")
        check_skin(mesh.name, mesh.skin, points.shape[1])


def split_seams(
    faces: np.ndarray, num_vertices: int, corner_uvs: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Give each vertex one texture coordinate by splitting the vertices on seams.

    Args:
        faces: Triangles, shape [faces, 3].
        num_vertices: Number of vertices.
        corner_uvs: Texture coordinate of every corner, shape [faces, 3, 2]; None splits nothing.

    Returns:
        Faces; the old vertex of each new one, where old vertices come first and in order; and texture coordinates
        [vertices, 2], zero for vertices without a face.
    """
    if corner_uvs is None:
        return faces, np.arange(num_vertices), None
    corners = faces.reshape(-1)
    values = np.asarray(corner_uvs, np.float32).reshape(-1, 2)
    keys = np.concatenate([corners[:, None].astype(np.float64), values.astype(np.float64)], axis=1)
    unique, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    owner = unique[:, 0].astype(np.int64)
    order = np.lexsort([first, owner])  # of each vertex the coordinate that comes first in the file
    is_first = np.ones(len(order), bool)
    is_first[1:] = owner[order][1:] != owner[order][:-1]
    place = np.empty(len(order), np.int64)
    place[order[is_first]] = owner[order[is_first]]
    extra = order[~is_first]
    extra = extra[np.argsort(first[extra], kind="stable")]
    place[extra] = num_vertices + np.arange(len(extra))
    uvs = np.zeros((num_vertices + len(extra), 2), np.float32)
    uvs[place] = unique[:, 1:]
    return place[inverse.ravel()].reshape(-1, 3), np.concatenate([np.arange(num_vertices), owner[extra]]), uvs


def vertex_normals(positions: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Average the area-weighted face normals around each vertex.

    Args:
        positions: Vertex positions [m], shape [vertices, 3].
        faces: Triangles, counter-clockwise seen from outside, shape [faces, 3].

    Returns:
        Unit normals, shape [vertices, 3], float32; (0, 1, 0) where a vertex has no face.
    """
    corners = positions[faces].astype(np.float64)
    face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    sums = np.stack(
        [
            np.bincount(faces.reshape(-1), np.repeat(face_normals[:, axis], 3), minlength=len(positions))
            for axis in range(3)
        ],
        axis=1,
    )
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    return np.where(lengths > 0, sums / np.where(lengths > 0, lengths, 1), [0.0, 1.0, 0.0]).astype(np.float32)


def principal_shapes(offsets: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Find few shapes whose weighted sums are the offsets of every frame (principal component analysis).

    A shape is `basis.T @ offsets`, and `basis[t]` holds its weight in frame t. Other values per frame, such as
    normals, may be projected on the same basis.

    Args:
        offsets: Offsets of the vertices [m], shape [frames, vertices, 3].
        tolerance: Largest error of any vertex in any frame [m].

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
