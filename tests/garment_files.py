"""Garments as modelling programs and scanners write them, made from the bundled ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from eslr_jax.pipeline.assets.catalog import find_asset
from eslr_jax.pipeline.formats.garment import GarmentFile, read_garment_npz
from eslr_jax.pipeline.formats.mesh import MeshFile

TO_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # Y up facing Z -> Z up facing -Y


def bundled(name: str) -> GarmentFile:
    return read_garment_npz(find_asset("garment", name))


def stored(positions: np.ndarray, faces: np.ndarray, **fields) -> GarmentFile:
    """Return a garment that one joint carries."""
    one = np.ones((len(positions), 1))
    skin = {"skin_weights": one, "skin_indices": np.zeros_like(one, int), "is_pinned": one[:, 0] > 1}
    return GarmentFile(positions, faces, **skin | fields)


def source(positions: np.ndarray, faces: np.ndarray, **fields) -> MeshFile:
    return MeshFile(positions, faces, name="test", **fields)


def cut_apart(positions: np.ndarray, faces: np.ndarray, is_moved: np.ndarray, shift) -> tuple:
    """Return a mesh whose chosen faces have vertices of their own, moved by a shift [m]."""
    parts = [np.unique(faces[chosen], return_inverse=True) for chosen in (~is_moved, is_moved)]
    (kept, first), (moved, second) = ((used, local.reshape(-1, 3)) for used, local in parts)
    return np.concatenate([positions[kept], positions[moved] + shift]), np.concatenate(
        [first, second + len(kept)]
    )


def dent(garment: GarmentFile, body, depth: float) -> tuple[np.ndarray, int]:
    """Press a hand-sized piece of chest into the body to a depth [m]; return positions and vertices inside."""
    from eslr_jax.pipeline.dressing.clearance import body_heights
    from eslr_jax.pipeline.dressing.postures import rest_posture

    positions = garment.rest_positions.copy()
    heights, normals = body_heights(positions, rest_posture(body))
    front = positions[:, 2] > 0.1
    center = positions[front][
        np.argmin(np.abs(positions[front][:, 0]) + np.abs(positions[front][:, 1] - 0.5))
    ]
    near = np.linalg.norm(positions - center, axis=1) < 0.07
    positions[near] -= (heights[near] + depth)[:, None] * normals[near]
    return positions, int(near.sum())


def scanned_tshirt(path: Path, body) -> Path:
    """Write a T-shirt as a scanner's program exports it.

    An OBJ in centimetres, Z up, standing on the floor, with texture seams along the sides and around the sleeves
    (every panel has its own vertices there), a loose vertex, and 5 mm of penetration on the chest.
    """
    shirt = bundled("tshirt_1k")
    positions, _ = dent(shirt, body, 0.005)
    floor = float(np.asarray(body.rest_positions)[:, 1].min())
    written = (positions - [0.0, floor, 0.0]) @ TO_Z_UP.T * 100.0
    centers = positions[shirt.faces].mean(axis=1)
    panel = np.where(centers[:, 0] > 0.2, 2, np.where(centers[:, 0] < -0.2, 3, centers[:, 2] > 0.03)).astype(
        int
    )
    lines = ["# scan", "mtllib shirt.mtl", "v 0 0 0"]
    corner_of, uvs = {}, []
    for face, part in zip(shirt.faces, panel, strict=True):
        for vertex in face.tolist():
            if (vertex, part) not in corner_of:
                corner_of[vertex, part] = len(corner_of) + 2
                x, y, z = written[vertex]
                lines.append(f"v {x:.5f} {y:.5f} {z:.5f}")
                uvs.append(f"vt {0.25 * part + x / 1000 + 0.1:.5f} {z / 300:.5f}")
    lines += uvs
    names = ("back", "front", "left_sleeve", "right_sleeve")
    for part in range(4):
        lines.append(f"usemtl {names[part]}")
        for face in shirt.faces[panel == part].tolist():
            corners = [corner_of[vertex, part] for vertex in face]
            lines.append("f " + " ".join(f"{corner}/{corner - 1}" for corner in corners))
    path.write_text("\n".join(lines) + "\n")
    return path
