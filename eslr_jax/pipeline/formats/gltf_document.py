"""Read the parts of a glTF 2.0 file: JSON tables, arrays, triangles, nodes in world space, key frames.

Tables stay plain dicts whose values are checked where they are used: a damaged file ends in a named error.
pygltflib, which writes our files, does not read them: it drops the weights of nodes, takes cut files for whole
ones, and needs nine seconds for six thousand accessors.

Source: Khronos, glTF 2.0 specification.
"""

from __future__ import annotations

import base64
import json
import struct
import urllib.parse
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from eslr_jax.errors import AssetError
from eslr_jax.pose.skeleton import MAX_FRAMES, whole_rate

_MAGIC, _JSON, _BIN = 0x46546C67, 0x4E4F534A, 0x004E4942
_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
TRIANGLES = 4  # mode of a primitive
MOVES = ("translation", "rotation", "scale")  # what animations change of a node
_UNEVEN = 0.05  # of the usual step between keys, by which steps may differ from its multiples
_HUGE = 1e9  # no node of a scene is moved as far, and float32 holds its cube
_MAX_BLANK = 1 << 22  # elements of an accessor that has no data behind it
_READ_EXTENSIONS = {  # that change nothing here, or are read
    "KHR_mesh_quantization", "KHR_materials_unlit", "KHR_texture_transform", "KHR_materials_specular",
    "KHR_materials_emissive_strength", "KHR_materials_ior", "KHR_lights_punctual", "KHR_texture_basisu",
    "EXT_texture_webp", "VRM", "VRMC_vrm", "KHR_materials_pbrSpecularGlossiness",
}  # fmt: skip


class GltfDocument:
    """The tables of a .gltf or .glb file."""

    def __init__(self, path: Path) -> None:
        """Read the tables; buffers are read when they are needed."""
        self.path = path
        data = path.read_bytes()
        self._blob: bytes | None = None
        if data[:4] == struct.pack("<I", _MAGIC):
            version, _ = struct.unpack_from("<II", data, 4)  # of a GLB: a JSON chunk, and a binary one
            if version != 2:
                raise self.fail(f"is glTF {version}, not 2")
            chunks: dict[int, bytes] = {}
            offset = 12
            while offset + 8 <= len(data):
                length, kind = struct.unpack_from("<II", data, offset)
                chunk = data[offset + 8 : offset + 8 + length]
                if len(chunk) < length:
                    raise self.fail("is truncated")
                chunks.setdefault(kind, chunk)
                offset += 8 + length
            self._blob = chunks.get(_BIN)
            data = chunks.get(_JSON, b"")
        self.tables: dict[str, Any] = json.loads(data.decode("utf-8-sig"))
        if not isinstance(self.tables, dict) or not str(
            _table(self.tables.get("asset")).get("version")
        ).startswith("2"):
            raise self.fail("is no glTF 2.0")
        needed = set(map(str, self.tables.get("extensionsRequired", []))) - _READ_EXTENSIONS
        if needed:
            raise AssetError(
                f"{path} needs {', '.join(sorted(needed))}, which is not read; export it without compression"
            )

    def fail(self, cause: str) -> AssetError:
        """Return an error about this file."""
        return AssetError(f"{self.path} {cause}; export it again")

    def item(self, table: str, index: Any) -> dict[str, Any]:
        """Return an entry of a table; raise AssetError if there is none of this index."""
        entries = self.tables.get(table, [])
        if type(index) is not int or not isinstance(entries, list) or not 0 <= index < len(entries):
            raise self.fail(f"names {table} {str(index)[:20]}, which it doesn't have")
        return _table(entries[index])

    def items(self, table: str) -> list[dict[str, Any]]:
        """Return all entries of a table; none if the file lacks it."""
        entries = self.tables.get(table, [])
        return [_table(entry) for entry in entries] if isinstance(entries, list) else []

    @cached_property
    def _buffers(self) -> list[bytes]:
        return [self._buffer(index, table.get("uri")) for index, table in enumerate(self.items("buffers"))]

    def _buffer(self, index: int, uri: Any) -> bytes:
        """Return the bytes of a buffer: the GLB's own, a data URI, or a file beside this one."""
        if uri is None:
            if self._blob is None:
                raise self.fail(f"has no data for buffer {index}")
            return self._blob
        if str(uri).startswith("data:"):
            return base64.b64decode(str(uri).partition(",")[2], validate=True)
        name = urllib.parse.unquote(str(uri))
        folder = self.path.parent.resolve()
        file = (folder / name).resolve()
        if "://" in name or not file.is_relative_to(folder):
            raise self.fail(f"refers to {name[:80]!r}, which is not beside it")
        if not file.is_file():
            cause = f"{self.path} refers to {name[:80]!r}, which is not there"
            raise AssetError(f"{cause}; keep the files together")
        return file.read_bytes()

    def array(self, index: Any) -> np.ndarray:
        """Return an accessor's values as float64, [count, components], or [count] for scalars.

        Integers of a normalised accessor are divided by their largest value.
        """
        accessor = self.item("accessors", index)
        dtype, width = _TYPES.get(accessor.get("componentType", 0)), _WIDTHS.get(accessor.get("type", ""))
        count = accessor.get("count")
        if dtype is None or width is None or type(count) is not int or count < 1:
            raise self.fail(f"has an impossible accessor {index}")
        values = self._values(accessor, np.dtype(dtype), width, count)
        if "sparse" in accessor:
            values = self._overwrite(values, _table(accessor["sparse"]), width)
        result = values.astype(np.float64)
        if accessor.get("normalized") and values.dtype.kind in "iu":
            result = np.maximum(result / np.iinfo(values.dtype).max, -1.0)
        return result[:, 0] if width == 1 else result

    def triangles(self, primitive: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
        """Return the positions [vertices, 3] and triangles [faces, 3] of a mesh primitive."""
        if primitive.get("mode", TRIANGLES) != TRIANGLES:
            raise self.fail("has a mesh of strips or lines, not triangles")
        points = self.array(_table(primitive.get("attributes")).get("POSITION"))
        if points.shape[1:] != (3,):
            raise self.fail("has positions that are no points")
        faces = self.array(primitive["indices"]) if "indices" in primitive else np.arange(len(points))
        if faces.ndim != 1 or len(faces) % 3 or faces.max() >= len(points):
            raise self.fail("has faces that are no triangles of its vertices")
        return points, faces.reshape(-1, 3).astype(np.int64)

    def offsets(self, target: Any, shape: tuple[int, ...]) -> np.ndarray:
        """Return by how much a morph target moves the positions of a primitive, which have this shape."""
        index = _table(target).get("POSITION")  # a target may change only normals
        offsets = np.zeros(shape) if index is None else self.array(index)
        if offsets.shape != shape:
            raise self.fail(f"has a shape of {len(offsets)} vertices for a mesh of {shape[0]}")
        return offsets

    def shaped_triangles(
        self, node: dict[str, Any], primitive: dict[str, Any]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return `triangles` of a node's primitive, moved by its morph targets as much as their weights say."""
        points, faces = self.triangles(primitive)
        targets = primitive.get("targets") or []
        weights = node.get("weights") or self.item("meshes", node["mesh"]).get("weights")
        if not targets or not weights:
            return points, faces
        amounts = np.array(weights, np.float64)
        if amounts.shape != (len(targets),) or not np.isfinite(amounts).all():
            raise self.fail(f"has impossible weights of the {len(targets)} shapes of a mesh")
        for number in np.flatnonzero(amounts):
            points = points + amounts[number] * self.offsets(targets[number], points.shape)
        return points, faces

    def _values(self, view_of: dict[str, Any], dtype: np.dtype, width: int, count: int) -> np.ndarray:
        """Return the raw values of an accessor or of a sparse part, [count, width]."""
        if "bufferView" not in view_of:
            if count > _MAX_BLANK:
                raise self.fail(f"has {count} values without data")
            return np.zeros((count, width), dtype)
        view = self.item("bufferViews", view_of["bufferView"])
        index = view.get("buffer")
        if type(index) is not int or not 0 <= index < len(self._buffers):
            raise self.fail("has a view of no buffer")
        numbers = [view.get("byteOffset", 0), view_of.get("byteOffset", 0), view.get("byteStride", 0)]
        numbers.append(view.get("byteLength"))
        if not all(type(number) is int and number >= 0 for number in numbers):
            raise self.fail("has a view with impossible numbers")
        start, inner, stride, length = numbers
        size = width * dtype.itemsize
        stride = stride or size
        data = self._buffers[index][start : start + length]
        if stride < size or inner + stride * (count - 1) + size > len(data):
            raise self.fail(f"has {count} values in a view of {len(data)} bytes")
        return np.array(np.ndarray((count, width), dtype, data, inner, (stride, dtype.itemsize)))

    def _overwrite(self, values: np.ndarray, sparse: dict[str, Any], width: int) -> np.ndarray:
        """Return values overwritten by those of a sparse accessor."""
        count, places = sparse.get("count"), _table(sparse.get("indices"))
        dtype = np.dtype(_TYPES.get(places.get("componentType", 0), "<f4"))
        if dtype.kind == "u" and type(count) is int and 0 < count <= len(values):
            rows = self._values(places, dtype, 1, count)[:, 0]
            if rows.max() < len(values):
                values[rows] = self._values(_table(sparse.get("values")), values.dtype, width, count)
                return values
        raise self.fail("has an impossible sparse accessor")

    @cached_property
    def parents(self) -> list[int]:
        """Parent of every node, -1 for those of the scene."""
        nodes = self.items("nodes")
        parents = [-1] * len(nodes)
        for parent, node in enumerate(nodes):
            for child in node.get("children", []):
                if type(child) is not int or not 0 <= child < len(nodes) or parents[child] != -1:
                    raise self.fail(f"has a node with two parents or none ({str(child)[:20]})")
                parents[child] = parent
        return parents

    @cached_property
    def order(self) -> list[int]:
        """All nodes, parents before children."""
        children: dict[int, list[int]] = {}
        for node, parent in enumerate(self.parents):
            children.setdefault(parent, []).append(node)
        order = list(children.get(-1, []))
        for node in order:
            order += children.get(node, [])
        if len(order) != len(self.parents):
            raise self.fail("has nodes in a cycle")
        return order

    def _local_transform(self, node: dict[str, Any]) -> dict[str, np.ndarray]:
        """Return a node's translation [3], rotation (x, y, z, w) [4] and scale [3]; a matrix is taken apart."""

        def numbers(key: str, usual: list[int]) -> np.ndarray:
            array = np.array(node.get(key, usual), np.float64)
            if array.shape != (len(usual),) or not (np.abs(array) < _HUGE).all():
                raise self.fail("has a node that is moved by no numbers")
            return array

        if "matrix" not in node:
            rotation = numbers("rotation", [0, 0, 0, 1])
            if not rotation.any():
                raise self.fail("has a node with the rotation zero")
            shift, scale = numbers("translation", [0, 0, 0]), numbers("scale", [1, 1, 1])
            return {"translation": shift, "rotation": rotation, "scale": scale}
        matrix = numbers("matrix", [0] * 16).reshape(4, 4).T
        scale = np.linalg.norm(matrix[:3, :3], axis=0)
        if not (scale > 0).all():
            raise self.fail("has a node without size")
        if np.linalg.det(matrix[:3, :3]) < 0:
            scale[0] = -scale[0]
        rotation = Rotation.from_matrix(matrix[:3, :3] / scale).as_quat()
        return {"translation": matrix[:3, 3], "rotation": rotation, "scale": scale}

    def world_matrices(self, animated: dict[tuple[int, str], np.ndarray], num_frames: int) -> np.ndarray:
        """Return the matrix from every node to the world, [frames, nodes, 4, 4].

        `animated` has values by node and path, shape [frames, 3 or 4]; other nodes are at rest.
        """
        result = np.tile(np.eye(4), (num_frames, len(self.parents), 1, 1))
        nodes = self.items("nodes")
        for node in self.order:
            rest = self._local_transform(nodes[node])
            moved = {path: animated.get((node, path), value[None]) for path, value in rest.items()}
            turned = Rotation.from_quat(moved["rotation"]).as_matrix()
            result[:, node, :3, :3] = turned * moved["scale"][:, None, :]
            result[:, node, :3, 3] = moved["translation"]
            if self.parents[node] >= 0:
                result[:, node] = result[:, self.parents[node]] @ result[:, node]
        return result

    def key_frames(
        self, animation: dict[str, Any], paths: Sequence[str] = MOVES
    ) -> list[tuple[int, str, str, np.ndarray, np.ndarray]]:
        """Return (node, path, interpolation, times [s], values) of each channel that animates these paths."""
        samplers = animation.get("samplers", [])
        result = []
        for entry in animation.get("channels", []):
            channel = _table(entry)
            target, index = _table(channel.get("target")), channel.get("sampler")
            node, path = target.get("node"), target.get("path")
            if path not in paths or node is None:
                continue
            if type(index) is not int or not 0 <= index < len(samplers):
                raise self.fail("has an animation channel without a sampler")
            self.item("nodes", node)
            sampler = _table(samplers[index])
            kind = sampler.get("interpolation", "LINEAR")
            times, values = self.array(sampler.get("input")), self.array(sampler.get("output"))
            width, each = (4 if path == "rotation" else 3), (3 if kind == "CUBICSPLINE" else 1)
            if path == "weights" and values.ndim == 1 and len(values) % (each * len(times)) == 0:
                values = values.reshape(each * len(times), -1)  # one number a shape
                width = values.shape[1]
            fits = times.ndim == 1 and values.shape == (each * len(times), width)
            is_ascending = (
                np.isfinite(times).all() and np.isfinite(values).all() and (np.diff(times) > 0).all()
            )
            if kind not in ("LINEAR", "STEP", "CUBICSPLINE") or not fits or not is_ascending:
                raise self.fail(f"has an impossible animation of node {node}'s {path}")
            result.append((node, path, kind, times, values))
        return result

    def sample_times(self, inputs: list[np.ndarray], fps: float | None = None) -> tuple[np.ndarray, float]:
        """Return evenly spaced times over all keys [s], and their rate.

        The rate is by default that of the densest keys, whose times are rounded. Keys set by hand have none: they
        are sampled 30 times a second, or up to 120 times where two are nearer.
        """
        start, end = min(times[0] for times in inputs), max(times[-1] for times in inputs)
        steps = [np.diff(times) for times in inputs if len(times) > 1]
        measured = fps
        if fps is None:
            own = np.concatenate(steps) if steps else np.array([1 / 30])
            usual = min((float(np.median(each)) for each in steps), default=1 / 30)
            multiples = np.maximum(np.round(own / usual), 1.0)
            if np.any(np.abs(own / usual - multiples) > _UNEVEN):
                measured = float(np.clip(1.0 / own.min(), 30.0, 120.0))
            else:
                measured = float(np.clip(multiples.sum() / own.sum(), 1.0, 1000.0))
            fps = whole_rate(measured)
        count = np.floor((end - start) * measured + 1e-3) + 1
        if not count <= MAX_FRAMES:
            raise self.fail(f"has an animation of {end - start:.3g} s")
        return start + np.arange(int(count)) / fps, fps


def sample_keys(path: str, kind: str, times: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Sample key frames at given times [s]; before the first key and after the last one values are constant.

    `path` is "rotation" (quaternions x, y, z, w; by slerp where linear), "translation", "scale" or "weights".
    `kind` is "LINEAR", "STEP" or "CUBICSPLINE", whose values are [3 keys, components]: in-tangent, value and
    out-tangent of every key. Others are [keys, components], and the result is [samples, components].

    Source: glTF 2.0, appendix C.
    """
    if len(times) == 1:
        return np.repeat(values[values.shape[0] // 2][None], len(at), axis=0)
    at = np.clip(at, times[0], times[-1])
    if kind == "STEP":
        return values[np.searchsorted(times, at, side="right") - 1]
    if kind == "LINEAR" and path == "rotation":
        return Slerp(times, Rotation.from_quat(values))(at).as_quat()
    before = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(times) - 2)
    span = (times[before + 1] - times[before])[:, None]
    t = (at - times[before])[:, None] / span
    if kind == "LINEAR":
        return (1 - t) * values[before] + t * values[before + 1]
    knots = values.reshape(len(times), 3, -1)
    return (
        (2 * t**3 - 3 * t**2 + 1) * knots[before, 1]
        + span * (t**3 - 2 * t**2 + t) * knots[before, 2]
        + (3 * t**2 - 2 * t**3) * knots[before + 1, 1]
        + span * (t**3 - t**2) * knots[before + 1, 0]
    )


def _table(value: Any) -> dict[str, Any]:
    """Return a JSON object; an empty one for anything else."""
    return value if isinstance(value, dict) else {}
