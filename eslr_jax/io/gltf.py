"""Animated meshes as one binary glTF 2.0 file (GLB) that Blender and web viewers open.

Axes: glTF is right-handed, Y up, in metres and seconds, and so are we; nothing is converted here.
(Blender turns the scene to Z up when it imports.)

A free-form mesh, such as a garment, becomes morph targets: frame 0 is the mesh itself, every later frame
a target, and the weights animation blends linearly from one frame to the next. A skinned body becomes a
real skin: its rest mesh, one node per joint, and their rotations and translations over time; such a file
hardly grows with the number of frames.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pygltflib as gltf

from eslr_jax.errors import MeshError, MotionError
from eslr_jax.io.atomic import atomic_write
from eslr_jax.io.gltf_builder import GlbBuilder, append, check_mesh, split_seams, vertex_normals
from eslr_jax.io.gltf_skin import SkinnedMesh, add_skinned_mesh

DEFAULT_CLOTH_COLOR = (0.20, 0.42, 0.62, 1.0)  # sRGB


@dataclasses.dataclass(frozen=True)
class AnimatedMesh:
    """A triangle mesh whose vertices move freely."""

    name: str
    positions: np.ndarray  # [frames, vertices, 3], [m]
    faces: np.ndarray  # [faces, 3]
    color: tuple[float, float, float, float] = DEFAULT_CLOTH_COLOR  # sRGB and opacity
    corner_uvs: np.ndarray | None = None  # texture coordinates of every face's corners, v up [faces, 3, 2]


def write_animated_glb(
    path: str | Path,
    meshes: Sequence[AnimatedMesh],
    timestep: float,
    *,
    skinned_body: SkinnedMesh | None = None,
    has_normals: bool = True,
) -> None:
    """Write meshes with their animation as one GLB file, atomically.

    Args:
        path: The file, `*.glb`.
        meshes: Free-form meshes, each written as morph targets; 24 bytes per vertex and frame.
        timestep: Time between frames [s]; frame k is at k * timestep.
        skinned_body: A body written as joints and skin weights.
        has_normals: Store normals per frame for smooth shading; without them files halve and look faceted.

    Raises:
        MeshError: If a mesh is empty, not finite, or its faces, weights and positions disagree.
        MotionError: If the meshes have different numbers of frames, or a joint transform is not rigid.
        AssetError: If the file can't be written.
    """
    _check_frames(meshes, skinned_body, timestep)
    builder = GlbBuilder()
    for mesh in meshes:
        _add_morphing_mesh(builder, mesh, timestep, has_normals)
    if skinned_body is not None:
        add_skinned_mesh(builder, skinned_body, timestep)
    content = builder.to_bytes()
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)


def _check_frames(meshes: Sequence[AnimatedMesh], body: SkinnedMesh | None, timestep: float) -> None:
    """Raise unless everything to be written has the same frames."""
    if not np.isfinite(timestep) or timestep <= 0:
        raise MotionError(f"timestep is {timestep} s; it must be positive")
    frames = {mesh.name: len(mesh.positions) for mesh in meshes}
    if body is not None:
        frames[body.name] = len(body.joint_transforms)
    if not frames:
        raise MeshError("no mesh to write; give at least one")
    if len(set(frames.values())) > 1 or 0 in frames.values():
        raise MotionError(f"meshes need the same positive number of frames, these have {frames}")


def _add_morphing_mesh(builder: GlbBuilder, mesh: AnimatedMesh, timestep: float, has_normals: bool) -> None:
    """Add a mesh whose frame 0 is the base and whose later frames are morph targets."""
    positions = np.asarray(mesh.positions, np.float32)
    faces = np.asarray(mesh.faces)
    if positions.ndim != 3:
        raise MeshError(
            f"mesh {mesh.name} has positions of shape {positions.shape}; it needs [frames, vertices, 3]"
        )
    check_mesh(mesh.name, positions, faces)
    if mesh.corner_uvs is not None and np.shape(mesh.corner_uvs) != (len(faces), 3, 2):
        raise MeshError(
            f"mesh {mesh.name} has texture coordinates {np.shape(mesh.corner_uvs)} for {len(faces)} faces; "
            "they must be [faces, 3, 2]"
        )
    split, vertices, uvs = split_seams(faces, positions.shape[1], mesh.corner_uvs)
    base, targets = _frame_attributes(builder, positions, faces, vertices, has_normals)
    if uvs is not None:
        flipped = np.ascontiguousarray(uvs * [1, -1] + [0, 1], np.float32)  # glTF counts v from the top
        base.TEXCOORD_0 = builder.add_accessor(flipped, gltf.VEC2, target=gltf.ARRAY_BUFFER)
    primitive = gltf.Primitive(
        attributes=base,
        indices=builder.add_indices(split, len(vertices)),
        material=builder.add_material(mesh.name, mesh.color),
        targets=targets,
    )
    num_targets = len(targets)
    index = append(
        builder.document.meshes,
        gltf.Mesh(
            name=mesh.name,
            primitives=[primitive],
            weights=[0.0] * num_targets,
            extras={"targetNames": [f"frame {frame}" for frame in range(1, num_targets + 1)]},
        ),
    )
    node = builder.add_node(gltf.Node(name=mesh.name, mesh=index))
    if num_targets:
        # Key frame k switches target k - 1 fully on and all others off; between keys the blend is linear.
        weights = np.eye(num_targets + 1, num_targets, k=-1, dtype=np.float32)
        values = builder.add_accessor(weights.reshape(-1), gltf.SCALAR)
        builder.add_channel(node, "weights", builder.add_times(num_targets + 1, timestep), values)


def _frame_attributes(
    builder: GlbBuilder, positions: np.ndarray, faces: np.ndarray, vertices: np.ndarray, has_normals: bool
) -> tuple[gltf.Attributes, list[gltf.Attributes]]:
    """Add the vertex data of every frame: the base attributes, then differences from them."""
    normals = [vertex_normals(frame, faces)[vertices] for frame in positions] if has_normals else []
    positions = positions[:, vertices]
    base = gltf.Attributes(POSITION=builder.add_points(positions[0]))
    if has_normals:
        base.NORMAL = builder.add_accessor(normals[0], gltf.VEC3, target=gltf.ARRAY_BUFFER)
    targets = []
    for frame in range(1, len(positions)):
        target = gltf.Attributes(POSITION=builder.add_points(positions[frame] - positions[0]))
        if has_normals:
            difference = normals[frame] - normals[0]
            target.NORMAL = builder.add_accessor(difference, gltf.VEC3, target=gltf.ARRAY_BUFFER)
        targets.append(target)
    return base, targets
