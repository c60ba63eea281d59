"""Skinned characters and animations of FBX files, with the extra `fbx`."""

from __future__ import annotations

import importlib.util
import io
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from eslr_jax.errors import AssetError, MissingExtraError, MotionError
from eslr_jax.io.parsing import parsing
from eslr_jax.io.skeleton import (
    MAX_POSES,
    RiggedMesh,
    Skeleton,
    SkeletonMotion,
    nearest_rotations,
    order_joints,
    unique_names,
)

TIMEOUT = 60.0  # [s] for the reader's process


def fbx_clip_names(path: str | Path) -> tuple[str, ...]:
    """Return the names of a file's animations."""
    with parsing(path, "motion") as file:
        return tuple(str(name) for name in _read(file, "")["clips"])


def read_fbx_body(path: str | Path, meshes: Sequence[str] = ()) -> RiggedMesh:
    """Read a skinned character in its bind pose.

    Args:
        path: .fbx file, text or binary; its unit and axes are converted.
        meshes: Names of the meshes that make up the body; all skinned ones if empty.

    Raises:
        AssetError: The file is missing, damaged, has no skinned mesh, or not the meshes that are named.
        MissingExtraError: The extra is not installed.
    """
    with parsing(path, "body") as file:
        arrays = _read(file, "")
        names = [str(name) for name in arrays["mesh_names"]]
        if not names:
            raise AssetError(f"{path} has no skinned mesh; export the mesh with its skeleton")
        unknown = [name for name in meshes if name not in names]
        if unknown:
            raise AssetError(f"{path} has no skinned mesh {unknown[0]!r}; it has {', '.join(names)}")
        kept = [index for index, name in enumerate(names) if not meshes or name in meshes]
        skeleton, nodes, _ = _skeleton(file, arrays)
        return _mesh(file, arrays, kept, skeleton, nodes)


def read_fbx_motion(path: str | Path, clip: str = "") -> SkeletonMotion:
    """Read an animation of a skeleton, at the file's frame rate.

    Args:
        path: .fbx file.
        clip: Name of the animation stack; not needed where there is one.

    Raises:
        AssetError: The file is missing, damaged, or has no joints.
        MotionError: It has no such animation.
        MissingExtraError: The extra is not installed.
    """
    with parsing(path, "motion") as file:
        arrays = _read(file, clip)
        clips = [str(name) for name in arrays["clips"]]
        if not clips:
            raise MotionError(f"{path} has no animation; export the character with one")
        if not clip and len(clips) > 1:
            raise MotionError(f"{path} holds {len(clips)} clips; name one, as in {path}#{clips[0]}")
        if clip and clip not in clips:
            raise MotionError(f"{path} has no clip {clip!r}; it has {', '.join(clips)}")
        if "motion" not in arrays:
            raise MotionError(
                f"{path}: its animation of {int(arrays['too_long'])} frames is too long; cut it"
            )
        skeleton, nodes, rest_frames = _skeleton(file, arrays)
        world = arrays["motion"][:, nodes]
        since_rest = world @ np.linalg.inv(rest_frames)
        return SkeletonMotion(
            str(arrays["clip"]),
            skeleton,
            nearest_rotations(since_rest[..., :3, :3]),
            world[..., :3, 3],
            float(arrays["fps"]),
        )


def _read(path: Path, clip: str) -> dict[str, np.ndarray]:
    """Run the reader in a process of its own and return its arrays."""
    if importlib.util.find_spec("ufbx") is None:
        raise MissingExtraError(
            f'{path}: FBX needs the extra fbx: pip install "eslr-jax[fbx]", or export the file as glTF'
        )
    command = [sys.executable, "-m", "eslr_jax.io.fbx_worker", str(path.resolve()), clip, str(MAX_POSES)]
    try:
        result = subprocess.run(command, capture_output=True, timeout=TIMEOUT, check=False)
    except subprocess.TimeoutExpired:
        raise AssetError(f"{path} is not read within {TIMEOUT:g} s; export it as glTF") from None
    if result.returncode != 0:
        lines = result.stderr.decode(errors="replace").strip().splitlines()
        reason = lines[-1][:200] if result.returncode == 1 and lines else "the reader broke down"
        raise AssetError(f"{path} can't be read as FBX ({reason}); export it again, or as glTF")
    with np.load(io.BytesIO(result.stdout), allow_pickle=False) as archive:
        return dict(archive)


def _skeleton(path: Path, arrays: Mapping[str, np.ndarray]) -> tuple[Skeleton, np.ndarray, np.ndarray]:
    """Return the joints at rest, their nodes, and their rest frames [joints, 4, 4]."""
    bound = {
        int(node): frame for node, frame in zip(arrays["bound_nodes"], arrays["bound_frames"], strict=True)
    }
    joints = [node for node in range(len(arrays["names"])) if arrays["is_bone"][node] or node in bound]
    place = {node: joint for joint, node in enumerate(joints)}
    parents = []
    for node in joints:
        above = int(arrays["parents"][node])
        while above >= 0 and above not in place:
            above = int(arrays["parents"][above])
        parents.append(place.get(above, -1))
    if not joints:
        raise AssetError(f"{path} has no joints; export the character with its skeleton")
    names = unique_names([str(arrays["names"][node]) for node in joints])
    order, new_parents = order_joints(names, parents, what=str(path))
    nodes = np.array([joints[joint] for joint in order])
    frames = np.stack([bound.get(int(node), arrays["world"][node]) for node in nodes])
    if not np.isfinite(frames).all() or (np.abs(np.linalg.det(frames[:, :3, :3])) < 1e-12).any():
        raise AssetError(f"{path} has a joint without size; export it again")
    return (
        Skeleton(tuple(names[joint] for joint in order), tuple(new_parents), frames[:, :3, 3]),
        nodes,
        frames,
    )


def _mesh(
    path: Path, arrays: Mapping[str, np.ndarray], kept: list[int], skeleton: Skeleton, nodes: np.ndarray
) -> RiggedMesh:
    """Return the meshes kept as one, with all their skin weights."""
    is_kept = np.isin(arrays["owner"], kept)
    number = np.cumsum(is_kept) - 1
    faces = arrays["faces"]
    faces = number[faces[is_kept[faces].all(axis=1)]]
    joint_of = {int(node): joint for joint, node in enumerate(nodes)}
    count = int(is_kept.sum())
    dense = np.zeros((count, len(skeleton)))
    rows = arrays["rows"].astype(np.int64)
    used = is_kept[rows]
    columns = np.array([joint_of[int(bone)] for bone in arrays["bones"][used]])
    np.add.at(dense, (number[rows[used]], columns), arrays["weights"][used])
    total = dense.sum(axis=1, keepdims=True)
    if (total <= 0).any():
        raise AssetError(f"{path}: vertex {int(np.argmin(total))} has no skin weights; bind it to a joint")
    dense /= total
    influences = max(1, int((dense > 0).sum(axis=1).max()))
    indices = np.argsort(-dense, axis=1, kind="stable")[:, :influences]
    return RiggedMesh(
        name=path.name,
        positions=arrays["positions"][is_kept],
        faces=faces,
        skin_weights=np.take_along_axis(dense, indices, axis=1),
        skin_indices=indices,
        skeleton=skeleton,
    )
