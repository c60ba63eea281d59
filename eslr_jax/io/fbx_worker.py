"""Read an FBX file with ufbx and write what it holds to stdout as an npz archive.

Run by `io.fbx` in a process of its own, which frees nothing and doesn't wind down: the binding, a young
release, crashes where its objects are freed.

Usage: python -m eslr_jax.io.fbx_worker FILE CLIP MAX_POSES. An empty CLIP is the first.
"""

from __future__ import annotations

import contextlib
import gc
import io
import os
import sys
from typing import Any

import numpy as np
import ufbx
from scipy.spatial.transform import Rotation

_KEPT: list[Any] = []  # objects of the binding, out of the reach of the collector
MAX_MEMORY = 6 << 30  # [bytes] of address space; a damaged file may ask for more


def main(path: str, clip: str, max_poses: int) -> None:
    """Write the arrays of a file to stdout."""
    with contextlib.suppress(ImportError, ValueError, OSError):  # Windows has no such limits
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (MAX_MEMORY, MAX_MEMORY))
    axes = ufbx.CoordinateAxes(
        ufbx.CoordinateAxis.POSITIVE_X, ufbx.CoordinateAxis.POSITIVE_Y, ufbx.CoordinateAxis.POSITIVE_Z
    )
    scene = ufbx.load_file(path, target_axes=axes, target_unit_meters=1.0)
    nodes = list(scene.nodes)
    _KEPT.append((scene, nodes))
    place = {node.typed_id: index for index, node in enumerate(nodes)}
    parents = [place[node.parent.typed_id] if node.parent is not None else -1 for node in nodes]
    arrays = {
        "names": np.array([node.name for node in nodes]),
        "parents": np.array(parents, np.int64),
        "world": np.stack([_matrix(node.node_to_world) for node in nodes]),
        "is_bone": np.array([node.bone is not None for node in nodes]),
        **_animation(scene, nodes, parents, clip, max_poses),
        **_meshes(scene, nodes, place),
    }
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    sys.stdout.buffer.write(stream.getvalue())


def _matrix(value: Any) -> np.ndarray:
    """Return an affine matrix of ufbx as [4, 4]."""
    result = np.eye(4)
    for column, vector in enumerate((value.c0, value.c1, value.c2, value.c3)):
        result[:3, column] = (vector.x, vector.y, vector.z)
    return result


def _meshes(scene: Any, nodes: list[Any], place: dict[int, int]) -> dict[str, np.ndarray]:
    """Return the skinned meshes as one, in the pose they are bound in, and the joints' rest frames."""
    parts: dict[str, list[np.ndarray]] = {
        key: [] for key in ("positions", "faces", "rows", "bones", "weights", "owner")
    }
    bound: dict[int, np.ndarray] = {}
    count = 0
    names = []
    for mesh in scene.meshes:
        _KEPT.append(mesh)
        if not len(mesh.skin_deformers) or not mesh.num_vertices:
            continue
        clusters = list(mesh.skin_deformers[0].clusters)
        _KEPT.append(clusters)
        if not clusters:
            continue
        space = _matrix(clusters[0].bind_to_world) @ _matrix(clusters[0].geometry_to_bone)
        points = np.array(mesh.vertices, np.float64).reshape(-1, 3)
        parts["positions"].append(points @ space[:3, :3].T + space[:3, 3])
        corners = np.array(list(mesh.vertex_indices), np.int64)
        for face in mesh.faces:
            ring = corners[face.index_begin : face.index_begin + face.num_indices]
            fan = [(ring[0], ring[i], ring[i + 1]) for i in range(1, len(ring) - 1)]
            parts["faces"].append(np.array(fan, np.int64).reshape(-1, 3) + count)
        for cluster in clusters:
            bone = place[cluster.bone_node.typed_id]
            bound.setdefault(bone, _matrix(cluster.bind_to_world))
            rows = np.array(list(cluster.vertices), np.int64)
            parts["rows"].append(rows + count)
            parts["bones"].append(np.full(len(rows), bone))
            parts["weights"].append(np.array(list(cluster.weights), np.float64))
        parts["owner"].append(np.full(len(points), len(names)))
        names.append(mesh.name or next((node.name for node in nodes if node.mesh is mesh), "") or "mesh")
        count += len(points)
    arrays = {key: np.concatenate(values) if values else np.zeros(0) for key, values in parts.items()}
    arrays["mesh_names"] = np.array(names)
    arrays["bound_nodes"] = np.array(list(bound), np.int64)
    arrays["bound_frames"] = np.stack(list(bound.values())) if bound else np.zeros((0, 4, 4))
    return arrays


def _animation(
    scene: Any, nodes: list[Any], parents: list[int], clip: str, max_poses: int
) -> dict[str, np.ndarray]:
    """Return the world matrices of all nodes over time, at the scene's frame rate."""
    stacks = list(scene.anim_stacks)
    _KEPT.append(stacks)
    names = [stack.name for stack in stacks]
    arrays = {"clips": np.array(names)}
    chosen = names.index(clip) if clip in names else 0
    if not stacks or (clip and clip not in names):
        return arrays
    stack, fps = stacks[chosen], float(scene.settings.frames_per_second) or 30.0
    fps = min(max(fps, 1.0), 1000.0)
    frames = int((stack.time_end - stack.time_begin) * fps + 1e-3) + 1
    if not 0 < frames * len(nodes) <= max_poses:
        return arrays | {"too_long": np.array(frames)}
    motion = np.tile(np.eye(4), (frames, len(nodes), 1, 1))
    anim = stack.anim
    _KEPT.append(anim)
    for index, node in enumerate(nodes):  # ufbx lists parents before children
        values = [
            ufbx.evaluate_transform(anim, node, stack.time_begin + frame / fps) for frame in range(frames)
        ]
        turned = Rotation.from_quat(
            [(v.rotation.x, v.rotation.y, v.rotation.z, v.rotation.w) for v in values]
        )
        scale = np.array([(v.scale.x, v.scale.y, v.scale.z) for v in values])
        motion[:, index, :3, :3] = turned.as_matrix() * scale[:, None, :]
        motion[:, index, :3, 3] = [(v.translation.x, v.translation.y, v.translation.z) for v in values]
        if parents[index] >= 0:
            motion[:, index] = motion[:, parents[index]] @ motion[:, index]
    return arrays | {"motion": motion, "fps": np.array(fps), "clip": np.array(names[chosen])}


if __name__ == "__main__":
    gc.disable()
    code = 0
    try:
        main(sys.argv[1], sys.argv[2], int(sys.argv[3]))
    except Exception as error:
        code = 1
        print(f"{type(error).__name__}: {error}".splitlines()[0], file=sys.stderr)
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
