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

from eslr_jax.files.atomic import atomic_write
from eslr_jax.pipeline.formats import animated
from eslr_jax.pipeline.formats.palette import Color, srgb_to_linear
from eslr_jax.pipeline.formats.registry import writer

TOLERANCE = 5e-4  # [m] by which a vertex may be out of place
_SMALL = 0.06  # [m]; 16 bits resolve a shape of this size to a micrometre
_NORMAL_TOLERANCE = 0.02  # root mean square by which normals, of length one, may be off
_INFLUENCES_PER_SET = 4  # glTF stores skin weights in sets of four
_COMPONENT_TYPES = {
    np.dtype(np.float32): gltf.FLOAT,
    np.dtype(np.int16): gltf.SHORT,
    np.dtype(np.uint8): gltf.UNSIGNED_BYTE,
    np.dtype(np.uint16): gltf.UNSIGNED_SHORT,
    np.dtype(np.uint32): gltf.UNSIGNED_INT,
}


@writer("scene", [".glb"])
def write_animated_glb(path: str | Path, meshes: Sequence[animated.AnimatedMesh], timestep: float) -> None:
    """Write meshes with their animation as one GLB file, atomically; frame k is at k times the timestep [s]."""
    builder = _Builder()
    for mesh in meshes:
        _add_mesh(builder, mesh, timestep)
    content = builder.to_bytes()
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)


def _add_mesh(builder: _Builder, mesh: animated.AnimatedMesh, timestep: float) -> None:
    """Add a mesh with its skin, its morph targets and their animation."""
    positions, faces = np.asarray(mesh.positions, np.float32), np.asarray(mesh.faces)
    base, offsets = positions[0], positions - positions[0]
    if mesh.skin is not None:
        base = np.asarray(mesh.rest_positions, np.float32)
        needed = animated.corrections(mesh, mesh.skin, TOLERANCE)
        offsets = np.zeros((len(positions), 0, 3)) if needed is None else needed
    split, vertices, uvs = animated.split_seams(faces, len(base), mesh.corner_uvs)
    attributes = gltf.Attributes(
        POSITION=builder.add_points(base[vertices]),
        NORMAL=builder.add_vertices(animated.vertex_normals(base, faces)[vertices], gltf.VEC3),
    )
    if uvs is not None:
        flipped = uvs * [1, -1] + [0, 1]  # glTF counts v from the top
        attributes.TEXCOORD_0 = builder.add_vertices(flipped.astype(np.float32), gltf.VEC2)
    skin = None
    if mesh.skin is not None:
        weights, indices = (array[vertices] for array in animated.influences(mesh.skin))
        padding = ((0, 0), (0, -weights.shape[1] % _INFLUENCES_PER_SET))
        dtype = np.uint8 if len(mesh.skin.parents) <= np.iinfo(np.uint8).max else np.uint16
        for name, values, kind in (("JOINTS", indices, dtype), ("WEIGHTS", weights, np.float32)):
            padded = np.pad(values, padding).astype(kind)
            for number, part in enumerate(np.split(padded, padded.shape[1] // _INFLUENCES_PER_SET, axis=1)):
                setattr(attributes, f"{name}_{number}", builder.add_vertices(part, gltf.VEC4))
        skin = _add_skin(builder, mesh.name, mesh.skin, timestep)
    targets, weights = _add_targets(builder, base, offsets, faces, vertices)
    # The smallest type that can't be taken for a primitive restart.
    corners = split.reshape(-1).astype(np.uint16 if len(vertices) < np.iinfo(np.uint16).max else np.uint32)
    primitive = gltf.Primitive(
        attributes=attributes,
        indices=builder.add_accessor(corners, gltf.SCALAR, target=gltf.ELEMENT_ARRAY_BUFFER),
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
    index = _append(builder.document.meshes, content)
    node = builder.add_node(gltf.Node(name=mesh.name, mesh=index, skin=skin))
    if targets:
        values = builder.add_accessor(weights.reshape(-1), gltf.SCALAR)
        builder.add_channel(node, "weights", builder.add_times(len(positions), timestep), values)


def _add_targets(
    builder: _Builder, base: np.ndarray, offsets: np.ndarray, faces: np.ndarray, vertices: np.ndarray
) -> tuple[list[gltf.Attributes], np.ndarray]:
    """Add the principal shapes of offsets [frames, vertices, 3] and of the normals that go with them.

    Return the targets, and weights [frames, targets] of at most one: Blender's sliders end at ten.
    """
    if not offsets.size:
        return [], np.zeros((len(offsets), 0), np.float32)
    basis, shapes = animated.principal_shapes(offsets, TOLERANCE)
    rest = animated.vertex_normals(base, faces)
    normals = np.stack([animated.vertex_normals(base + offset, faces) - rest for offset in offsets])
    turned = np.tensordot(basis, normals, axes=(0, 0))
    # The basis is orthonormal: what the first shapes leave of the normals is the sum of the others' squares.
    left = np.cumsum(np.sum(turned * turned, axis=(1, 2))[::-1])[::-1] / normals[..., 0].size
    num_turned = int(np.sum(left > _NORMAL_TOLERANCE**2))
    still = None
    if num_turned < len(shapes):  # zeros, which take no room
        zeros = gltf.Accessor(componentType=gltf.FLOAT, count=len(vertices), type=gltf.VEC3)
        still = _append(builder.document.accessors, zeros)
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


def _add_skin(builder: _Builder, name: str, skin: animated.Skin, timestep: float) -> int:
    """Add one animated node per joint under a common root, and return the skin that binds them."""
    rotations, translations = animated.local_motion(skin)
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
    return _append(builder.document.skins, content)


class _Builder:
    """Collects the tables of a glTF document and the bytes that they point into."""

    def __init__(self) -> None:
        self._scene_nodes: list[int] = []
        self.document = gltf.GLTF2(
            asset=gltf.Asset(version="2.0", generator="eslr_jax"),
            scene=0,
            scenes=[gltf.Scene(nodes=self._scene_nodes)],
        )
        self.animation = gltf.Animation(name="simulation")
        self._chunks: list[bytes] = []
        self._size = 0

    def add_accessor(
        self, array: np.ndarray, kind: str, *, target: int | None = None, has_bounds: bool = False
    ) -> int:
        """Append an array to the binary chunk and return the index of its accessor."""
        values = np.ascontiguousarray(array)
        payload = values.tobytes()
        payload += b"\0" * (-len(payload) % 4)  # every accessor starts at a multiple of its component size
        self.document.bufferViews.append(
            gltf.BufferView(buffer=0, byteOffset=self._size, byteLength=values.nbytes, target=target)
        )
        self._chunks.append(payload)
        self._size += len(payload)
        columns = values.reshape(len(values), -1)
        accessor = gltf.Accessor(
            bufferView=len(self.document.bufferViews) - 1,
            componentType=_COMPONENT_TYPES[values.dtype],
            count=len(values),
            type=kind,
            min=columns.min(0).tolist() if has_bounds else None,
            max=columns.max(0).tolist() if has_bounds else None,
        )
        return _append(self.document.accessors, accessor)

    def add_points(self, points: np.ndarray) -> int:
        """Add positions, or differences of positions, with the bounds that glTF asks of them."""
        return self.add_accessor(points, gltf.VEC3, target=gltf.ARRAY_BUFFER, has_bounds=True)

    def add_small_points(self, points: np.ndarray) -> int:
        """Add differences of positions between -1 and 1 as 16-bit integers: a third of the size."""
        steps = np.iinfo(np.int16).max
        rounded = np.zeros((len(points), 4), np.int16)  # vertices start at multiples of four bytes
        rounded[:, :3] = np.round(points * steps)
        index = self.add_vertices(rounded, gltf.VEC3)
        accessor = self.document.accessors[index]
        accessor.normalized = True
        accessor.min, accessor.max = (end(rounded[:, :3], axis=0).tolist() for end in (np.min, np.max))
        self.document.bufferViews[accessor.bufferView].byteStride = rounded.itemsize * rounded.shape[1]
        self.document.extensionsUsed = self.document.extensionsRequired = ["KHR_mesh_quantization"]
        return index

    def add_vertices(self, values: np.ndarray, kind: str) -> int:
        """Add other values per vertex, such as normals."""
        return self.add_accessor(values, kind, target=gltf.ARRAY_BUFFER)

    def add_material(self, name: str, color: Color) -> int:
        """Append a rough two-sided material and return its index."""
        linear = srgb_to_linear(color).tolist()
        surface = gltf.PbrMetallicRoughness(
            baseColorFactor=[*linear, 1.0], metallicFactor=0.0, roughnessFactor=0.9
        )
        material = gltf.Material(
            name=name,
            pbrMetallicRoughness=surface,
            doubleSided=True,
            alphaMode=gltf.OPAQUE,
            alphaCutoff=None,
        )
        return _append(self.document.materials, material)

    def add_node(self, node: gltf.Node, *, is_root: bool = True) -> int:
        """Append a node, to the scene too when it is a root, and return its index."""
        index = _append(self.document.nodes, node)
        if is_root:
            self._scene_nodes.append(index)
        return index

    def add_channel(self, node: int, path: str, times: int, values: int) -> None:
        """Animate one property of a node, linear between key frames."""
        sampler = gltf.AnimationSampler(input=times, output=values, interpolation=gltf.ANIM_LINEAR)
        index = _append(self.animation.samplers, sampler)
        target = gltf.AnimationChannelTarget(node=node, path=path)
        self.animation.channels.append(gltf.AnimationChannel(sampler=index, target=target))

    def add_times(self, num_frames: int, timestep: float) -> int:
        """Append the key frame times [s] and return their accessor."""
        times = np.arange(num_frames) * timestep
        return self.add_accessor(times.astype(np.float32), gltf.SCALAR, has_bounds=True)

    def to_bytes(self) -> bytes:
        """Assemble the file."""
        if self.animation.channels:
            self.document.animations = [self.animation]
        self.document.buffers = [gltf.Buffer(byteLength=self._size)]
        self.document.set_binary_blob(b"".join(self._chunks))
        return b"".join(self.document.save_to_bytes())


def _append(items: list, item: object) -> int:
    items.append(item)
    return len(items) - 1
