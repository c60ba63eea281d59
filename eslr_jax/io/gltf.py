"""Write animated meshes as one binary glTF 2.0 file (GLB) that Blender and web viewers open.

glTF is right-handed, Y up, in metres and seconds, as this package is: nothing is converted.

A mesh with a skin becomes a skin: its rest mesh, one node per joint, and their rotations and translations over
time. What joints can't do, and all of the motion of a mesh without a skin, becomes morph targets: a few principal
shapes whose weights are animated. Each vertex is within 0.5 mm of its place in every frame. Shapes of less than
6 cm are stored in 16 bits (KHR_mesh_quantization); normals follow the largest shapes, to about a degree.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pygltflib as gltf

from eslr_jax.io.animated import (
    AnimatedMesh,
    Skin,
    check_meshes,
    corrections,
    influences,
    local_motion,
    principal_shapes,
    split_seams,
    vertex_normals,
)
from eslr_jax.io.atomic import atomic_write
from eslr_jax.io.gltf_builder import GlbBuilder, append
from eslr_jax.io.registry import writer

TOLERANCE = 5e-4  # [m] by which a vertex may be out of place
_SMALL = 0.06  # [m]; 16 bits resolve a shape of this size to a micrometre
_NORMAL_TOLERANCE = 0.02  # root mean square by which normals, of length one, may be off
_INFLUENCES_PER_SET = 4  # glTF stores skin weights in sets of four


@writer("scene", [".glb"])
def write_animated_glb(path: str | Path, meshes: Sequence[AnimatedMesh], timestep: float) -> None:
    """Write meshes with their animation as one GLB file, atomically.

    Args:
        path: Path of the file, `*.glb`.
        meshes: Meshes with the same number of frames.
        timestep: Time between frames [s]; frame k is at k * timestep.

    Raises:
        MeshError: A mesh is empty, not finite, or its parts disagree.
        MotionError: The numbers of frames differ, or a joint does not move rigidly.
        AssetError: The file can't be written.
    """
    check_meshes(meshes, timestep)
    builder = GlbBuilder()
    for mesh in meshes:
        _add_mesh(builder, mesh, timestep)
    content = builder.to_bytes()
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)


def _add_mesh(builder: GlbBuilder, mesh: AnimatedMesh, timestep: float) -> None:
    """Add a mesh with its skin, its morph targets and their animation."""
    positions, faces = np.asarray(mesh.positions, np.float32), np.asarray(mesh.faces)
    base, offsets = positions[0], positions - positions[0]
    if mesh.skin is not None:
        base = np.asarray(mesh.rest_positions, np.float32)
        needed = corrections(mesh.skin, base, positions, TOLERANCE)
        offsets = np.zeros((len(positions), 0, 3)) if needed is None else needed
    split, vertices, uvs = split_seams(faces, len(base), mesh.corner_uvs)
    attributes = gltf.Attributes(
        POSITION=builder.add_points(base[vertices]),
        NORMAL=builder.add_vertices(vertex_normals(base, faces)[vertices], gltf.VEC3),
    )
    if uvs is not None:
        flipped = uvs * [1, -1] + [0, 1]  # glTF counts v from the top
        attributes.TEXCOORD_0 = builder.add_vertices(flipped.astype(np.float32), gltf.VEC2)
    skin = None
    if mesh.skin is not None:
        _add_influences(builder, attributes, mesh.skin, vertices)
        skin = _add_skin(builder, mesh.name, mesh.skin, timestep)
    targets, weights = _add_targets(builder, base, offsets, faces, vertices)
    primitive = gltf.Primitive(
        attributes=attributes,
        indices=builder.add_indices(split, len(vertices)),
        material=builder.add_material(mesh.name, mesh.color),
        targets=targets,
    )
    names = {"targetNames": [f"shape {shape + 1}" for shape in range(len(targets))]}
    content = gltf.Mesh(
        name=mesh.name,
        primitives=[primitive],
        weights=[0.0] * len(targets),
        extras=names if targets else {},
    )
    index = append(builder.document.meshes, content)
    node = builder.add_node(gltf.Node(name=mesh.name, mesh=index, skin=skin))
    if targets:
        values = builder.add_accessor(weights.reshape(-1), gltf.SCALAR)
        builder.add_channel(node, "weights", builder.add_times(len(positions), timestep), values)


def _add_targets(
    builder: GlbBuilder, base: np.ndarray, offsets: np.ndarray, faces: np.ndarray, vertices: np.ndarray
) -> tuple[list[gltf.Attributes], np.ndarray]:
    """Add the principal shapes of offsets [frames, vertices, 3] and of the normals that go with them.

    Returns:
        The targets, and their weights [frames, targets], which are at most one: Blender's sliders end at ten.
    """
    if not offsets.size:
        return [], np.zeros((len(offsets), 0), np.float32)
    basis, shapes = principal_shapes(offsets, TOLERANCE)
    rest = vertex_normals(base, faces)
    normals = np.stack([vertex_normals(base + offset, faces) - rest for offset in offsets])
    turned = np.tensordot(basis, normals, axes=(0, 0))
    # The basis is orthonormal: what the first shapes leave of the normals is the sum of the others' squares.
    left = np.cumsum(np.sum(turned * turned, axis=(1, 2))[::-1])[::-1] / normals[..., 0].size
    num_turned = int(np.sum(left > _NORMAL_TOLERANCE**2))
    still = builder.add_zeros(len(vertices)) if num_turned < len(shapes) else None
    largest = np.abs(basis).max(0)
    targets = []
    for number, (shape, normal) in enumerate(zip(shapes, turned, strict=True)):
        size = float(np.abs(shape).max()) * largest[number]
        is_small = 0 < size < _SMALL
        largest[number] /= size if is_small else 1.0
        points = (largest[number] * shape).astype(np.float32)[vertices]
        targets.append(
            gltf.Attributes(
                POSITION=builder.add_small_points(points) if is_small else builder.add_points(points),
                NORMAL=still
                if number >= num_turned
                else builder.add_vertices((largest[number] * normal).astype(np.float32)[vertices], gltf.VEC3),
            )
        )
    return targets, (basis / largest).astype(np.float32)


def _add_influences(
    builder: GlbBuilder, attributes: gltf.Attributes, skin: Skin, vertices: np.ndarray
) -> None:
    """Add skin weights in as many sets of four as it takes to keep them all."""
    weights, indices = (array[vertices] for array in influences(skin))
    padding = ((0, 0), (0, -weights.shape[1] % _INFLUENCES_PER_SET))
    dtype = np.uint8 if len(skin.parents) <= np.iinfo(np.uint8).max else np.uint16
    for name, values in (
        ("JOINTS", np.pad(indices, padding).astype(dtype)),
        ("WEIGHTS", np.pad(weights, padding).astype(np.float32)),
    ):
        for number in range(values.shape[1] // _INFLUENCES_PER_SET):
            part = values[:, number * _INFLUENCES_PER_SET : (number + 1) * _INFLUENCES_PER_SET]
            setattr(attributes, f"{name}_{number}", builder.add_vertices(part, gltf.VEC4))


def _add_skin(builder: GlbBuilder, name: str, skin: Skin, timestep: float) -> int:
    """Add one animated node per joint under a common root, and return the skin that binds them."""
    rotations, translations = local_motion(skin)
    parents, first = list(skin.parents), len(builder.document.nodes)
    for joint, label in enumerate(skin.joint_names):
        node = gltf.Node(
            name=label,
            rotation=rotations[0, joint].tolist(),
            translation=translations[0, joint].tolist(),
            children=[first + child for child, parent in enumerate(parents) if parent == joint],
        )
        builder.add_node(node, is_root=False)
    nodes = list(range(first, first + len(parents)))
    roots = [node for node, parent in zip(nodes, parents, strict=True) if parent < 0]
    armature = builder.add_node(gltf.Node(name=f"{name} joints", children=roots))
    if len(rotations) > 1:
        times = builder.add_times(len(rotations), timestep)
        for joint, node in enumerate(nodes):
            for path, kind, values in (
                ("rotation", gltf.VEC4, rotations),
                ("translation", gltf.VEC3, translations),
            ):
                builder.add_channel(node, path, times, builder.add_accessor(values[:, joint], kind))
    bind = np.tile(np.eye(4, dtype=np.float32), (len(nodes), 1, 1))
    bind[:, 3, :3] = -np.asarray(skin.joint_rest_positions)  # column-major: this row is the translation
    inverse_bind = builder.add_accessor(bind.reshape(-1, 16), gltf.MAT4)
    content = gltf.Skin(name=name, joints=nodes, skeleton=armature, inverseBindMatrices=inverse_bind)
    return append(builder.document.skins, content)
