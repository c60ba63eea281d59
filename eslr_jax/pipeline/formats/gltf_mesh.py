"""Read meshes from glTF 2.0: a scene at rest, and what morph targets (shape keys) and nodes move."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from eslr_jax.errors import AssetError
from eslr_jax.pipeline.formats.gltf_document import MOVES, TRIANGLES, GltfDocument, sample_keys
from eslr_jax.pipeline.formats.gltf_rig import read_joints
from eslr_jax.pipeline.formats.mesh import MeshFile, name_parts, shared_vertices
from eslr_jax.pipeline.formats.mesh_sequence import MAX_POINTS, MeshSequence
from eslr_jax.pipeline.formats.registry import reader


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
    positions, corners, uvs, names, materials, count = [], [], [], [], [], 0
    for index, node in enumerate(document.items("nodes")):
        mesh = document.item("meshes", node["mesh"]) if "mesh" in node else {}
        for primitive in mesh.get("primitives", []):
            if primitive.get("mode", TRIANGLES) < TRIANGLES:
                continue  # points and lines
            points, faces = document.shaped_triangles(node, primitive)
            space = spaces[node["skin"]] if "skin" in node else world[index]
            positions.append(points @ space[:3, :3].T + space[:3, 3])
            corners.append(faces + count)
            count += len(points)
            uv = primitive["attributes"].get("TEXCOORD_0")
            uvs.append(None if uv is None else document.array(uv) * [1, -1] + [0, 1])  # counted from the top
            material = document.items("materials")[primitive["material"]] if "material" in primitive else {}
            names += [str(mesh.get("name", f"mesh{node['mesh']}"))] * len(faces)
            materials += [str(material.get("name", ""))] * len(faces)
    if not positions:
        return MeshFile(np.empty((0, 3)), np.empty((0, 3), np.int64))
    known = [
        uv for uv, points in zip(uvs, positions, strict=True) if uv is not None and len(uv) == len(points)
    ]
    points, faces = np.concatenate(positions), np.concatenate(corners)
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
    parts, corners, count = [], [], 0
    for primitive in document.item("meshes", mesh).get("primitives", []):
        points, triangles = document.triangles(primitive)
        offsets = [document.offsets(target, points.shape) for target in primitive.get("targets", [])]
        parts.append(np.stack([points, *offsets]))
        corners.append(triangles + count)
        count += len(points)
    shapes = np.concatenate(parts, axis=1)  # the mesh, then the offsets of each shape
    if weights.shape[1] != len(shapes) - 1 or len(weights) * count > MAX_POINTS:
        raise document.fail(f"has {weights.shape[1]} weights for {len(shapes) - 1} shapes of a mesh")
    kept, place = shared_vertices(shapes.swapaxes(0, 1))
    local = shapes[0, kept] + np.tensordot(weights, shapes[1:, kept], axes=1)
    moved = np.einsum("fij,fvj->fvi", world[:, :3, :3], local) + world[:, None, :3, 3]
    return moved, place[np.concatenate(corners)]
