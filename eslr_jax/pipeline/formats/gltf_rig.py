"""Read skinned characters with their animations, and meshes, from glTF 2.0 files (.gltf, .glb, .vrm).

Meshes are of a scene at rest, or moved by morph targets (shape keys) and nodes. The rest pose of a character is
the bind pose. The inverse bind matrices of a skin tell it in the mesh's own space. Exporters disagree on how that
space lies in the world: see `_bind_space`.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from eslr_jax.errors import AssetError, MotionError
from eslr_jax.files.parsing import parsing
from eslr_jax.pipeline.formats.bundled import pick_clip
from eslr_jax.pipeline.formats.gltf_document import MOVES, TRIANGLES, GltfDocument, sample_keys
from eslr_jax.pipeline.formats.mesh import MeshFile, join_meshes, name_parts, shared_vertices, stack_tables
from eslr_jax.pipeline.formats.mesh_sequence import MAX_POINTS, MeshSequence
from eslr_jax.pipeline.formats.registry import reader
from eslr_jax.pose.skeleton import (
    MAX_POSES,
    RiggedMesh,
    Skeleton,
    SkeletonMotion,
    nearest_rotations,
    order_joints,
    unique_names,
)

GLTF_SUFFIXES = (".glb", ".gltf", ".vrm")
_SCALE_TOLERANCE = 0.01  # by which a bind space may differ in size from the posed skin
_SAME_SPACE = 1e-4  # relative difference of joints that show the bind pose, in float32


@dataclasses.dataclass
class _Joints:
    """The joints of all skins of a file at rest, in world space."""

    nodes: list[int]
    rest_frames: np.ndarray  # [joints, 4, 4]
    skeleton: Skeleton
    spaces: dict[int, np.ndarray]  # skin -> matrix from its mesh space to the world
    world: np.ndarray  # from every node to the world, as the file has them posed [nodes, 4, 4]


def gltf_clip_names(path: str | Path) -> tuple[str, ...]:
    """Return the names of a file's animations."""
    with parsing(path, "motion") as file:
        return _clip_names(GltfDocument(file))


@reader("body", GLTF_SUFFIXES)
def read_gltf_body(path: Path, meshes: str = "") -> RiggedMesh:
    """Read a skinned character in its bind pose, in world axes, with the vertices of the file.

    It has the shape that the file's weights of morph targets give it. `meshes` names the meshes, or their nodes,
    that make up the body, as in "Skin,Hat"; "" is all that are skinned, or hang on a joint.
    """
    document = GltfDocument(path)
    joints = read_joints(document)
    carriers: dict[int, int | None] = {-1: None}  # the joint that a node hangs on
    for node in document.order:
        is_joint = node in joints.nodes
        carriers[node] = joints.nodes.index(node) if is_joint else carriers[document.parents[node]]
    found = {}  # nodes of the body, and the names they go by
    for index, node in enumerate(document.items("nodes")):
        if "mesh" in node and ("skin" in node or carriers[index] is not None):
            entries = (node, document.item("meshes", node["mesh"]))
            found[index] = [str(entry["name"]) for entry in entries if entry.get("name")] or [f"mesh{index}"]
    wanted = set(filter(None, meshes.split(",")))
    if unknown := sorted(wanted.difference(*found.values())):
        known = ", ".join(names[0] for names in found.values())
        raise AssetError(f"{path} has no mesh {unknown[0]!r} on its skeleton; it has {known}")
    nodes = [node for node, names in found.items() if not wanted or wanted & set(names)]
    parts = [part for node in nodes for part in _read_node(document, joints, node, carriers[node])]
    if not parts:
        raise AssetError(f"{path} has a skin, but no triangles bound to it; export the mesh with its skin")
    positions, faces, weights, indices = zip(*parts, strict=True)
    return RiggedMesh(
        path.name,
        *join_meshes(positions, faces),
        skin_weights=stack_tables(weights),
        skin_indices=stack_tables(indices),
        skeleton=joints.skeleton,
    )


@reader("motion", GLTF_SUFFIXES)
def read_gltf_motion(path: Path, clip: str = "") -> SkeletonMotion:
    """Read an animation of a character's joints, at the rate of its densest keys; "" names the only one."""
    document = GltfDocument(path)
    names = _clip_names(document)
    if not names:
        raise MotionError(f"{path} has no animation; export the character with one")
    index = names.index(pick_clip(path, names, clip))
    joints = read_joints(document)
    keys = document.key_frames(document.items("animations")[index])
    if not keys:
        raise MotionError(f"{path}: animation {names[index]!r} moves no node; choose another")
    times, fps = document.sample_times([key[3] for key in keys])
    if len(times) * len(document.parents) > MAX_POSES:
        raise MotionError(f"{path}: {len(times)} frames of {len(document.parents)} nodes; cut the clip")
    animated = {
        (node, what): sample_keys(what, kind, at, values, times) for node, what, kind, at, values in keys
    }
    world = document.world_matrices(animated, len(times))[:, joints.nodes]
    since_rest = world @ np.linalg.inv(joints.rest_frames)
    return SkeletonMotion(
        names[index], joints.skeleton, nearest_rotations(since_rest[..., :3, :3]), world[..., :3, 3], fps
    )


def _clip_names(document: GltfDocument) -> tuple[str, ...]:
    """Return the names of the animations; those without a name are numbered."""
    entries = document.items("animations")
    return tuple(unique_names([str(entry.get("name") or f"clip{i}") for i, entry in enumerate(entries)]))


def read_joints(document: GltfDocument) -> _Joints:
    """Collect the joints of all skins at rest."""
    skins = document.items("skins")
    if not skins:
        raise AssetError(f"{document.path} has no skin; give a character that is bound to a skeleton")
    world = document.world_matrices({}, 1)[0]
    skinned = [node.get("skin") for node in document.items("nodes")]
    frames: dict[int, np.ndarray] = {}
    spaces: dict[int, np.ndarray] = {}
    for number, skin in enumerate(skins):
        nodes = skin.get("joints", [])
        if not isinstance(nodes, list) or not nodes or len(set(map(str, nodes))) != len(nodes):
            raise document.fail(f"has skin {number} without joints, or with one twice")
        for node in nodes:
            document.item("nodes", node)
        bind = np.tile(np.eye(4), (len(nodes), 1, 1))
        if "inverseBindMatrices" in skin:
            values = document.array(skin["inverseBindMatrices"])
            if values.shape[1:] != (16,) or len(values) < len(nodes):
                raise document.fail(
                    f"has skin {number} with {len(values)} bind matrices for {len(nodes)} joints"
                )
            bind = values[: len(nodes)].reshape(-1, 4, 4).swapaxes(1, 2)
        if not np.isfinite(bind).all() or (np.abs(np.linalg.det(bind)) < 1e-12).any():
            raise document.fail(f"has skin {number} with a bind matrix that can't be inverted")
        user = skinned.index(number) if number in skinned else None
        spaces[number] = _bind_space(document, world, nodes, bind, user)
        rest = spaces[number] @ np.linalg.inv(bind)
        for node, frame in zip(nodes, rest, strict=True):
            frames.setdefault(node, frame)
    nodes = list(frames)
    place = {node: joint for joint, node in enumerate(nodes)}
    parents = []
    for node in nodes:
        above = document.parents[node]
        while above >= 0 and above not in place:
            above = document.parents[above]
        parents.append(place.get(above, -1))
    names = unique_names([str(document.item("nodes", node).get("name") or f"joint{node}") for node in nodes])
    order, new_parents = order_joints(names, parents, what=str(document.path))
    nodes = [nodes[joint] for joint in order]
    rest_frames = np.stack([frames[node] for node in nodes])
    skeleton = Skeleton(tuple(names[joint] for joint in order), tuple(new_parents), rest_frames[:, :3, 3])
    return _Joints(nodes, rest_frames, skeleton, spaces, world)


def _bind_space(
    document: GltfDocument, world: np.ndarray, nodes: list[int], bind: np.ndarray, user: int | None
) -> np.ndarray:
    """Return the matrix that takes a skin's mesh space to the world in the bind pose.

    In the pose of the nodes, joint j takes the mesh space to the world by G_j B_j. If the nodes are in the bind
    pose, these matrices agree and are the answer. Otherwise the answer is the matrix of the mesh's node or of the
    skeleton's parent, whichever has the right size and is nearer to the joints; else that of the first joint.
    """
    posed = world[nodes] @ bind
    size = np.cbrt(abs(np.linalg.det(posed[0, :3, :3])))
    if np.abs(posed - posed[0])[:, :3, :3].max() <= _SAME_SPACE * size:
        return posed[0]
    top = min(nodes, key=document.order.index)
    candidates = [np.eye(4) if document.parents[top] < 0 else world[document.parents[top]]]
    if user is not None:
        candidates.append(world[user])
    best, least = posed[0], np.inf
    for candidate in candidates:
        own = np.cbrt(abs(np.linalg.det(candidate[:3, :3])))
        away = np.abs(posed - candidate)[:, :3, :3].mean()
        if abs(own - size) <= _SCALE_TOLERANCE * size and away < least:
            best, least = candidate, away
    return best


def _read_node(
    document: GltfDocument, joints: _Joints, index: int, carrier: int | None
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """Return positions [m], faces, weights and joints of each primitive of a node with a skin, or on a joint."""
    node = document.item("nodes", index)
    if "skin" in node:
        skin, space = document.item("skins", node["skin"]), joints.spaces[node["skin"]]
        order = np.array([joints.nodes.index(joint) for joint in skin["joints"]])
    else:
        posed = joints.world[joints.nodes[carrier]]
        space = joints.rest_frames[carrier] @ np.linalg.inv(posed) @ joints.world[index]
    result = []
    for primitive in document.item("meshes", node["mesh"]).get("primitives", []):
        attributes = primitive.get("attributes", {})
        if "skin" in node and "JOINTS_0" not in attributes:
            continue
        points, faces = document.shaped_triangles(node, primitive)
        if np.linalg.det(space[:3, :3]) < 0:
            faces = faces[:, ::-1]
        world = points @ space[:3, :3].T + space[:3, 3]
        if "skin" not in node:
            result.append((world, faces, np.ones((len(points), 1)), np.full((len(points), 1), carrier)))
            continue
        weights, followed = [], []
        number = 0
        while f"JOINTS_{number}" in attributes:
            weights.append(document.array(attributes.get(f"WEIGHTS_{number}")))
            followed.append(document.array(attributes[f"JOINTS_{number}"]))
            if weights[-1].shape != (len(points), 4) or followed[-1].shape != (len(points), 4):
                raise document.fail("has skin weights that don't fit its vertices")
            number += 1
        weight, chosen = np.concatenate(weights, axis=1), np.concatenate(followed, axis=1)
        total = weight.sum(axis=1, keepdims=True)
        if not np.isfinite(weight).all() or (weight < 0).any() or (total <= 0).any():
            raise document.fail("has a vertex without skin weights")
        weights, local = weight / total, np.where(weight > 0, chosen, 0.0)
        if local.max() >= len(order):
            raise document.fail(f"has a skin weight for joint {int(local.max())} of {len(order)}")
        result.append((world, faces, weights, order[local.astype(np.int64)]))
    return result


# ---------------------------------------------------------------- meshes


@reader("mesh", [".glb", ".gltf"])
def read_glb(path: Path, _like: MeshFile | None = None) -> MeshFile:
    """Read all triangles of a glTF file into one mesh, in the scene's frame, and share split vertices.

    Morph targets count as much as their weights at rest say. A mesh with a skin is in its bind pose: glTF has
    the joints carry it, and its own node count for nothing.
    """
    document = GltfDocument(path)
    world = document.world_matrices({}, 1)[0]
    has_skin = any("skin" in node and "mesh" in node for node in document.items("nodes"))
    spaces = read_joints(document).spaces if has_skin else {}
    positions, corners, uvs, names, materials = [], [], [], [], []
    for index, node in enumerate(document.items("nodes")):
        mesh = document.item("meshes", node["mesh"]) if "mesh" in node else {}
        for primitive in mesh.get("primitives", []):
            if primitive.get("mode", TRIANGLES) < TRIANGLES:
                continue  # points and lines
            points, faces = document.shaped_triangles(node, primitive)
            space = spaces[node["skin"]] if "skin" in node else world[index]
            positions.append(points @ space[:3, :3].T + space[:3, 3])
            corners.append(faces)
            uv = primitive["attributes"].get("TEXCOORD_0")
            uvs.append(None if uv is None else document.array(uv) * [1, -1] + [0, 1])  # counted from the top
            material = document.items("materials")[primitive["material"]] if "material" in primitive else {}
            names += [str(mesh.get("name", f"mesh{node['mesh']}"))] * len(faces)
            materials += [str(material.get("name", ""))] * len(faces)
    if not positions:
        return MeshFile(np.empty((0, 3)), np.empty((0, 3), np.int64))
    pairs = zip(uvs, positions, strict=True)
    known = [uv for uv, points in pairs if uv is not None and len(uv) == len(points)]
    points, faces = join_meshes(positions, corners)
    kept, place = shared_vertices(points)
    face_parts, part_names = name_parts([names, materials])
    return MeshFile(
        points[kept],
        place[faces],
        corner_uvs=np.concatenate(known)[faces] if len(known) == len(uvs) else None,
        face_parts=face_parts,
        part_names=part_names,
        rows=place,
        is_metric=True,
    )


@reader("mesh sequence", [".glb", ".gltf"])
def read_gltf_sequences(path: Path, name: str = "", fps: float | None = None) -> list[MeshSequence]:
    """Read the meshes that morph targets and nodes move, all or those of a name."""
    document = GltfDocument(path)
    animations = document.items("animations")
    shapes = {key[0]: key for entry in animations for key in document.key_frames(entry, ("weights",))}
    nodes = {node: document.item("nodes", node) for node in shapes}
    found = {
        node: str(entry.get("name") or document.item("meshes", entry.get("mesh")).get("name"))
        for node, entry in nodes.items()
        if "skin" not in entry  # a body
    }
    chosen = [node for node, known in found.items() if name in ("", known)]
    if not chosen:
        known = ", ".join(found.values()) or "none"
        raise AssetError(
            f"{path}: no mesh{name and f' named {name!r}'} is moved by shapes; it has {known}; export the "
            "garment with its shape keys"
        )
    # Animations of other nodes, such as a character's, may be as many as they like.
    carriers = set()
    for node in chosen:
        while node >= 0 and node not in carriers:
            carriers.add(node)
            node = document.parents[node]
    clips = [
        {key[:2] for key in document.key_frames(entry, (*MOVES, "weights")) if key[0] in carriers}
        for entry in document.items("animations")
    ]
    clips = [keyed for keyed in clips if keyed]
    if sum(map(len, clips)) > len(set().union(*clips)):
        raise AssetError(f"{document.path} holds {len(clips)} clips; export one")
    at, rate = document.sample_times([shapes[node][3] for node in chosen], fps)
    moves = [key for entry in animations for key in document.key_frames(entry)]
    moved = {
        (node, path): sample_keys(path, how, keys, at_keys, at) for node, path, how, keys, at_keys in moves
    }
    world = document.world_matrices(moved, len(at))
    sequences = []
    for node in chosen:
        _, _, kind, times, values = shapes[node]
        weights = sample_keys("weights", kind, times, values, at)
        positions, faces = _moved_by_shapes(document, nodes[node]["mesh"], weights, world[:, node])
        label = path.name if len(found) == 1 else f"{path.name}#{found[node]}"
        sequences.append(MeshSequence(label, positions, faces, rate, found[node]))
    return sequences


def _moved_by_shapes(
    document: GltfDocument, mesh: int, weights: np.ndarray, world: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return positions [frames, vertices, 3] and faces of a mesh; vertices that were split at seams become one.

    `weights` are of its shapes, [frames, shapes]; `world` leads from its own space, [frames, 4, 4].
    """
    parts, corners = [], []
    for primitive in document.item("meshes", mesh).get("primitives", []):
        points, triangles = document.triangles(primitive)
        offsets = [document.offsets(target, points.shape) for target in primitive.get("targets", [])]
        parts.append(np.stack([points, *offsets], axis=1))
        corners.append(triangles)
    shapes, faces = join_meshes(parts, corners)  # of every vertex the place, then the offsets of each shape
    count, num_shapes = len(shapes), shapes.shape[1] - 1
    if weights.shape[1] != num_shapes or len(weights) * count > MAX_POINTS:
        raise document.fail(f"has {weights.shape[1]} weights for {num_shapes} shapes of a mesh")
    kept, place = shared_vertices(shapes)
    shapes = shapes[kept].swapaxes(0, 1)
    local = shapes[0] + np.tensordot(weights, shapes[1:], axes=1)
    moved = np.einsum("fij,fvj->fvi", world[:, :3, :3], local) + world[:, None, :3, 3]
    return moved, place[faces]
