"""A skinned mesh in a glTF document: skin weights, joints as nodes, and their motion."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import pygltflib as gltf
from scipy.spatial.transform import Rotation

from eslr_jax.errors import MeshError, MotionError
from eslr_jax.io.gltf_builder import GlbBuilder, append, check_mesh, vertex_normals

DEFAULT_BODY_COLOR = (0.80, 0.64, 0.55, 1.0)  # sRGB
_RIGID_TOLERANCE = 1e-3  # entries of R^T R - I that float32 forward kinematics may reach
_NEGLIGIBLE_WEIGHT = 1e-6  # skin weight that moves a vertex by less than float32 rounding over a body's size
_INFLUENCES_PER_SET = 4  # glTF stores skin weights in sets of four


@dataclasses.dataclass(frozen=True)
class SkinnedMesh:
    """A triangle mesh moved by joints: posed = sum_j weight_j (R_j rest + t_j)."""

    rest_positions: np.ndarray  # [vertices, 3], [m]
    faces: np.ndarray  # [faces, 3]
    skin_weights: np.ndarray  # [vertices, influences], rows sum to one
    skin_indices: np.ndarray  # [vertices, influences]
    joint_transforms: (
        np.ndarray
    )  # [frames, joints, 3, 4], rest point -> posed point; rotations and translations [m]
    joint_rest_positions: np.ndarray | None = (
        None  # [joints, 3], [m]: where bones are drawn; None puts them at the origin
    )
    parents: Sequence[int] | None = None  # -1 is a root; None makes every joint a root
    joint_names: Sequence[str] | None = None
    name: str = "body"
    color: tuple[float, float, float, float] = DEFAULT_BODY_COLOR  # sRGB and opacity


def add_skinned_mesh(builder: GlbBuilder, body: SkinnedMesh, timestep: float) -> None:
    """Add a mesh, its joints and their animation."""
    rest = np.asarray(body.rest_positions, np.float32)
    faces = np.asarray(body.faces)
    check_mesh(body.name, rest, faces)
    attributes = gltf.Attributes(
        POSITION=builder.add_points(rest),
        NORMAL=builder.add_accessor(vertex_normals(rest, faces), gltf.VEC3, target=gltf.ARRAY_BUFFER),
    )
    _add_influences(builder, attributes, body)
    primitive = gltf.Primitive(
        attributes=attributes,
        indices=builder.add_indices(faces, len(rest)),
        material=builder.add_material(body.name, body.color),
    )
    mesh = append(builder.document.meshes, gltf.Mesh(name=body.name, primitives=[primitive]))
    skin = _add_skin(builder, body, timestep)
    builder.add_node(gltf.Node(name=body.name, mesh=mesh, skin=skin))


def _add_influences(builder: GlbBuilder, attributes: gltf.Attributes, body: SkinnedMesh) -> None:
    """Add skin weights, largest first, in as many sets of four as it takes to keep them all."""
    weights, indices = np.asarray(body.skin_weights, np.float64), np.asarray(body.skin_indices)
    num_vertices, num_joints = len(body.rest_positions), body.joint_transforms.shape[1]
    if weights.shape != indices.shape or weights.ndim != 2 or len(weights) != num_vertices:
        raise MeshError(
            f"mesh {body.name} has skin weights {weights.shape} and skin indices {indices.shape}; "
            f"both must be [{num_vertices}, influences]"
        )
    if indices.min() < 0 or indices.max() >= num_joints:
        raise MeshError(f"mesh {body.name} has a skin weight for joint {indices.max()} of {num_joints}")
    if weights.min() < 0 or not np.allclose(weights.sum(1), 1, atol=1e-3):
        raise MeshError(
            f"mesh {body.name} has skin weights that are negative or don't sum to one; normalise them first"
        )
    order = np.argsort(-weights, axis=1, kind="stable")
    weights, indices = np.take_along_axis(weights, order, 1), np.take_along_axis(indices, order, 1)
    num_used = max(1, int((weights > _NEGLIGIBLE_WEIGHT).any(0).sum()))
    num_sets = -(-num_used // _INFLUENCES_PER_SET)
    padding = max(0, num_sets * _INFLUENCES_PER_SET - weights.shape[1])
    weights = np.pad(weights, ((0, 0), (0, padding)))[:, : num_sets * _INFLUENCES_PER_SET]
    indices = np.where(weights > 0, np.pad(indices, ((0, 0), (0, padding)))[:, : weights.shape[1]], 0)
    weights /= weights.sum(1, keepdims=True)
    dtype = np.uint8 if num_joints <= np.iinfo(np.uint8).max else np.uint16
    for number in range(num_sets):
        part = slice(number * _INFLUENCES_PER_SET, (number + 1) * _INFLUENCES_PER_SET)
        for name, values in (
            ("JOINTS", indices[:, part].astype(dtype)),
            ("WEIGHTS", weights[:, part].astype(np.float32)),
        ):
            accessor = builder.add_accessor(values, gltf.VEC4, target=gltf.ARRAY_BUFFER)
            setattr(attributes, f"{name}_{number}", accessor)


def _add_skin(builder: GlbBuilder, body: SkinnedMesh, timestep: float) -> int:
    """Add one animated node per joint under a common root, and return the skin that binds them."""
    transforms = np.asarray(body.joint_transforms, np.float64)
    num_frames, num_joints = transforms.shape[:2]
    offsets = np.zeros((num_joints, 3))
    if body.joint_rest_positions is not None:
        offsets = np.asarray(body.joint_rest_positions, np.float64)
    parents = [-1] * num_joints if body.parents is None else list(body.parents)
    names = body.joint_names or [f"joint {joint}" for joint in range(num_joints)]
    if len(names) != num_joints:
        raise MotionError(
            f"{body.name} has {len(names)} joint names for {num_joints} joints; they must agree"
        )
    rotations, translations = _local_motion(body.name, transforms, offsets, parents)
    nodes = _add_joint_nodes(builder, names, parents, rotations[0], translations[0])
    roots = [node for node, parent in zip(nodes, parents, strict=True) if parent < 0]
    armature = builder.add_node(gltf.Node(name=f"{body.name} joints", children=roots))
    if num_frames > 1:
        times = builder.add_times(num_frames, timestep)
        for joint, node in enumerate(nodes):
            rotation = builder.add_accessor(rotations[:, joint], gltf.VEC4)
            builder.add_channel(node, "rotation", times, rotation)
            translation = builder.add_accessor(translations[:, joint], gltf.VEC3)
            builder.add_channel(node, "translation", times, translation)
    bind = np.tile(np.eye(4, dtype=np.float32), (num_joints, 1, 1))
    bind[:, 3, :3] = -offsets  # column-major: the last row in memory is the translation
    inverse_bind = builder.add_accessor(bind.reshape(num_joints, 16), gltf.MAT4)
    skin = gltf.Skin(name=body.name, joints=nodes, skeleton=armature, inverseBindMatrices=inverse_bind)
    return append(builder.document.skins, skin)


def _add_joint_nodes(
    builder: GlbBuilder,
    names: Sequence[str],
    parents: Sequence[int],
    rotations: np.ndarray,
    translations: np.ndarray,
) -> list[int]:
    """Add one node per joint, posed as in the first frame and linked to its children."""
    first = len(builder.document.nodes)
    for joint, name in enumerate(names):
        node = gltf.Node(
            name=name,
            rotation=rotations[joint].tolist(),
            translation=translations[joint].tolist(),
            children=[first + child for child, parent in enumerate(parents) if parent == joint],
        )
        builder.add_node(node, is_root=False)
    return list(range(first, first + len(names)))


def _local_motion(
    name: str, transforms: np.ndarray, offsets: np.ndarray, parents: Sequence[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Split joint transforms into each joint's rotation and translation in its parent's frame.

    Args:
        name: The mesh, for messages.
        transforms: Rest point -> posed point, shape [frames, joints, 3, 4].
        offsets: Joint rest positions [m], shape [joints, 3].
        parents: Parent per joint, -1 for a root.

    Returns:
        Quaternions (x, y, z, w) [frames, joints, 4] and translations [m] [frames, joints, 3], float32.

    Raises:
        MotionError: If a transform is not finite or no rotation with translation, or parents don't fit.
    """
    if (
        transforms.shape[2:] != (3, 4)
        or offsets.shape != (transforms.shape[1], 3)
        or len(parents) != transforms.shape[1]
    ):
        raise MotionError(
            f"{name} has joint transforms of shape {transforms.shape} for {len(offsets)} rest positions and "
            f"{len(parents)} parents; they must agree as [frames, joints, 3, 4]"
        )
    matrices = transforms[..., :3]
    gram = np.einsum("tjab,tjac->tjbc", matrices, matrices)
    is_rigid = (np.abs(gram - np.eye(3)) < _RIGID_TOLERANCE).all((2, 3)) & (np.linalg.det(matrices) > 0)
    if not is_rigid.all() or not np.isfinite(transforms).all():
        frame, joint = np.argwhere(~(is_rigid & np.isfinite(transforms).all((2, 3))))[0]
        raise MotionError(
            f"{name} has a joint transform that is no rotation: frame {frame}, joint {joint}; use a mesh"
        )
    origins = np.einsum("tjab,jb->tja", matrices, offsets) + transforms[..., 3]
    rotations = np.empty((*transforms.shape[:2], 4))
    translations = np.empty((*transforms.shape[:2], 3))
    for joint, parent in enumerate(parents):
        local, shift = matrices[:, joint], origins[:, joint]
        if parent >= 0:
            local = np.einsum("tba,tbc->tac", matrices[:, parent], local)
            shift = np.einsum("tba,tb->ta", matrices[:, parent], shift - origins[:, parent])
        rotations[:, joint] = _continuous(Rotation.from_matrix(local).as_quat())
        translations[:, joint] = shift
    return rotations.astype(np.float32), translations.astype(np.float32)


def _continuous(quaternions: np.ndarray) -> np.ndarray:
    """Flip signs so that neighbours in time never take the long way round; shape [frames, 4]."""
    flips = np.einsum("ti,ti->t", quaternions[1:], quaternions[:-1]) < 0
    signs = np.concatenate([[1.0], np.where(np.cumsum(flips) % 2, -1.0, 1.0)])
    return quaternions * signs[:, None]
