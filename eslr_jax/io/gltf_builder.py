"""Build a binary glTF 2.0 document: accessors, materials, nodes and animation channels."""

from __future__ import annotations

import numpy as np
import pygltflib as gltf

from eslr_jax.io.palette import Color, srgb_to_linear

_COMPONENT_TYPES = {
    np.dtype(np.float32): gltf.FLOAT,
    np.dtype(np.int16): gltf.SHORT,
    np.dtype(np.uint8): gltf.UNSIGNED_BYTE,
    np.dtype(np.uint16): gltf.UNSIGNED_SHORT,
    np.dtype(np.uint32): gltf.UNSIGNED_INT,
}


class GlbBuilder:
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
        return append(self.document.accessors, accessor)

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
        accessor.min = rounded[:, :3].min(axis=0).tolist()
        accessor.max = rounded[:, :3].max(axis=0).tolist()
        self.document.bufferViews[accessor.bufferView].byteStride = rounded.itemsize * rounded.shape[1]
        self.document.extensionsUsed = self.document.extensionsRequired = ["KHR_mesh_quantization"]
        return index

    def add_zeros(self, num_vertices: int) -> int:
        """Add vectors of zeros, which take no room."""
        accessor = gltf.Accessor(componentType=gltf.FLOAT, count=num_vertices, type=gltf.VEC3)
        return append(self.document.accessors, accessor)

    def add_vertices(self, values: np.ndarray, kind: str) -> int:
        """Add other values per vertex, such as normals."""
        return self.add_accessor(values, kind, target=gltf.ARRAY_BUFFER)

    def add_indices(self, faces: np.ndarray, num_vertices: int) -> int:
        """Add the triangles, in the smallest type that can't be taken for a primitive restart."""
        dtype = np.uint16 if num_vertices < np.iinfo(np.uint16).max else np.uint32
        return self.add_accessor(
            faces.reshape(-1).astype(dtype), gltf.SCALAR, target=gltf.ELEMENT_ARRAY_BUFFER
        )

    def add_material(self, name: str, color: Color) -> int:
        """Append a rough two-sided material and return its index."""
        linear = [float(value) for value in srgb_to_linear(color)]
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
        return append(self.document.materials, material)

    def add_node(self, node: gltf.Node, *, is_root: bool = True) -> int:
        """Append a node, to the scene too when it is a root, and return its index."""
        index = append(self.document.nodes, node)
        if is_root:
            self._scene_nodes.append(index)
        return index

    def add_channel(self, node: int, path: str, times: int, values: int) -> None:
        """Animate one property of a node, linear between key frames."""
        sampler = gltf.AnimationSampler(input=times, output=values, interpolation=gltf.ANIM_LINEAR)
        index = append(self.animation.samplers, sampler)
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


def append(items: list, item: object) -> int:
    """Append and return the new item's index."""
    items.append(item)
    return len(items) - 1
