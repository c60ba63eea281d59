"""Small whole files of every garment format, for tests that break them."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import trimesh

from eslr_jax.io.garment import GarmentFile, read_garment_npz, read_garment_source, write_garment_npz
from eslr_jax.io.trajectory import TrajectoryFile, read_trajectory, write_trajectory

POSITIONS = np.array([[0, 0, 0], [0.5, 0, 0], [0.5, 0.5, 0.25], [0, 0.5, 0.125], [0.25, 0.75, 0]])
FACES = np.array([[0, 1, 2], [2, 3, 0], [3, 2, 4]])


def read_as_garment(path: Path) -> None:
    """Read a user's garment as far as its arrays are checked."""
    from eslr_jax.geometry.validate import check_arrays

    source = read_garment_source(path)
    check_arrays(source.mesh.positions, source.mesh.faces, name=path.name)


def whole_file(kind: str, folder: Path) -> bytes:
    """Return the bytes of a whole file of a kind in `READERS`."""
    path = folder / f"whole.{kind.rpartition('.')[2]}"
    mesh = trimesh.Trimesh(POSITIONS, FACES, process=False)
    if kind == "obj":
        path.write_text(
            "o scarf\n" + "".join(f"v {x} {y} {z}\n" for x, y, z in POSITIONS)
            + "".join(f"vt {x} {y}\n" for x, y, _ in POSITIONS)
            + "usemtl a\nf 1/1 2/2 3/3\nusemtl b\nf 3/3 4/4 1/1\nf 4/4/4 3/3/3 5/5/5\n"
        )  # fmt: skip
    elif kind == "text.stl":
        path.write_text(trimesh.exchange.stl.export_stl_ascii(mesh))
    elif kind == "text.ply":
        path.write_bytes(trimesh.exchange.ply.export_ply(mesh, encoding="ascii"))
    elif kind in ("ply", "stl", "glb"):
        path.write_bytes(mesh.export(file_type=kind))
    elif kind == "npz":
        np.savez(path, positions=POSITIONS, faces=FACES)
    elif kind == "pkl":
        entry = {"rest_pos": POSITIONS, "faces": FACES, "node_type": np.array([[0], [0], [3], [0], [0]])}
        path.write_bytes(pickle.dumps({"scarf": entry}))
    elif kind == "fitted.npz":
        weights, indices = np.full((5, 2), 0.5), np.tile([1, 3], (5, 1))
        write_garment_npz(
            path,
            GarmentFile(
                POSITIONS, FACES, weights, indices, np.zeros(5, bool), POSITIONS, metadata={"name": "a"}
            ),
        )
    elif kind == "trajectory.npz":
        moving = np.stack([POSITIONS, POSITIONS])
        write_trajectory(path, TrajectoryFile(moving, moving, FACES, 0.1))
    return path.read_bytes()


READERS = {
    "obj": read_as_garment,
    "ply": read_as_garment,
    "text.ply": read_as_garment,
    "stl": read_as_garment,
    "text.stl": read_as_garment,
    "glb": read_as_garment,
    "npz": read_as_garment,
    "pkl": read_as_garment,
    "fitted.npz": read_garment_npz,
    "trajectory.npz": read_trajectory,
}
