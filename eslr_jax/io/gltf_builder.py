"""A binary glTF 2.0 document under construction: accessors, materials, nodes and animation channels."""

from __future__ import annotations

import numpy as np
import pygltflib as gltf

from eslr_jax.errors import MeshError
from eslr_jax.io.color import srgb_to_linear

_COMPONENT_TYPES = {
    np.dtype(np.float32): gltf.FLOAT,
    np.dtype(np.uint8): gltf.UNSIGNED_BYTE,
    np.dtype(np.uint16): gltf.UNSIGNED_SHORT,
    np.dtype(np.uint32): gltf.UNSIGNED_INT,
}


class GlbBuilder:
    """A glTF document under construction, with the binary chunk that its accessors point into."""

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

    def add_indices(self, faces: np.ndarray, num_vertices: int) -> int:
        """Add the triangles, in the smallest type that can't be taken for a primitive restart."""
        dtype = np.uint16 if num_vertices < np.iinfo(np.uint16).max else np.uint32
        return self.add_accessor(
            faces.reshape(-1).astype(dtype), gltf.SCALAR, target=gltf.ELEMENT_ARRAY_BUFFER
        )

    def add_material(self, name: str, color: tuple[float, float, float, float]) -> int:
        """Append a rough two-sided material and return its index."""
        linear = [float(value) for value in srgb_to_linear(color[:3])]
        surface = gltf.PbrMetallicRoughness(
            baseColorFactor=[*linear, float(color[3])], metallicFactor=0.0, roughnessFactor=0.9
        )
        material = gltf.Material(
            name=name,
            pbrMetallicRoughness=surface,
            doubleSided=True,
            alphaMode=gltf.OPAQUE if color[3] >= 1 else gltf.BLEND,
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


def check_mesh(name: str, positions: np.ndarray, faces: np.ndarray) -> None:
    """Raise MeshError unless positions [..., vertices, 3] and faces [faces, 3] form a mesh."""
    if (
        positions.shape[-1] != 3
        or positions.shape[-2] == 0
        or faces.ndim != 2
        or faces.shape[1:] != (3,)
        or not len(faces)
    ):
        raise MeshError(
            f"mesh {name} has positions of shape {positions.shape} and faces of shape {faces.shape}; "
            "it needs [..., vertices, 3] and [faces, 3]"
        )
    if not np.isfinite(positions).all():
        frame = int(np.argmin(np.isfinite(positions).reshape(len(positions), -1).all(1)))
        raise MeshError(
            f"mesh {name} has NaN or infinite positions, first at index {frame}; repair the simulation first"
        )
    if faces.min() < 0 or faces.max() >= positions.shape[-2]:
        raise MeshError(f"mesh {name} has a face that names vertex {faces.max()} of {positions.shape[-2]}")


def split_seams(
    faces: np.ndarray, num_vertices: int, corner_uvs: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Give each vertex one texture coordinate, by splitting those on seams.

    Args:
        faces: Triangles, shape [faces, 3].
        num_vertices: Number of vertices.
        corner_uvs: Texture coordinate of every corner, shape [faces, 3, 2]; None leaves the mesh as it is.

    Returns:
        Faces; the old vertex of every vertex, the old ones first and in their order; and texture coordinates
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
