"""Small whole files of every format, for tests that break them, each with its reader."""

from __future__ import annotations

import io
import pickle
import tempfile
from functools import partial
from pathlib import Path

import numpy as np
import trimesh
from broken import read, reader_of
from foreign_files import (
    SMPL_PARENTS,
    animate,
    write_amass,
    write_bvh,
    write_character,
    write_hood,
    write_vto,
)

from eslr_jax import load_body
from eslr_jax.pipeline.assets.motions import read_joint_map
from eslr_jax.pipeline.formats.animated import AnimatedMesh
from eslr_jax.pipeline.formats.bundled import read_motion_archive
from eslr_jax.pipeline.formats.garment import (
    GarmentFile,
    read_garment_npz,
    read_garment_source,
    write_garment_npz,
)
from eslr_jax.pipeline.formats.mesh_sequence import read_mesh_sequence
from eslr_jax.pipeline.formats.trajectory import TrajectoryFile, read_trajectory, write_trajectory
from eslr_jax.pipeline.rigs.sequence import pose_sequence

POSITIONS = np.array([[0, 0, 0], [0.5, 0, 0], [0.5, 0.5, 0.25], [0, 0.5, 0.125], [0.25, 0.75, 0]])
FACES = np.array([[0, 1, 2], [2, 3, 0], [3, 2, 4]])


def read_as_garment(path: Path) -> None:
    """Read a user's garment as far as its arrays are checked."""
    from eslr_jax.mesh.validate import check_arrays

    source = read_garment_source(path)
    check_arrays(source.positions, source.faces, name=path.name)


def whole_garment(kind: str, path: Path) -> None:
    """Write a whole file of a kind in `GARMENTS`."""
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
        with path.open("wb") as stream:  # whatever its suffix
            np.savez(stream, positions=POSITIONS, faces=FACES)
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


GARMENTS = {
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


def small_motion():
    rng = np.random.default_rng(0)
    names = ("Hips", "Spine", "Head", "LeftUpLeg", "LeftLeg", "LeftFoot", "RightUpLeg", "LeftArm", "RightArm")
    turned = np.tile(np.eye(3), (3, 9, 1, 1))
    return animate(names, (-1, 0, 1, 0, 3, 4, 0, 1, 1), rng.normal(size=(9, 3)), turned, np.zeros((3, 3)))


def small_model():
    rng = np.random.default_rng(0)
    return {
        "v_template": rng.uniform(0, 1.5, (30, 3)),
        "f": rng.permutation(30).reshape(-1, 3),
        "weights": rng.dirichlet(np.ones(24), 30),
        "J_regressor": rng.dirichlet(np.ones(30), 24),
        "kintree_table": np.array([SMPL_PARENTS, np.arange(24)]),
        "shapedirs": rng.normal(size=(30, 3, 10)),
        "posedirs": rng.normal(size=(30, 3, 207)),
    }


def content(write, *arguments, suffix=".bin", **options):
    """The bytes that a writer writes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"a{suffix}"
        write(path, *arguments, **options)
        return path.read_bytes()


def arrays_of(data):
    with np.load(io.BytesIO(data), allow_pickle=False) as archive:
        return dict(archive)


def character():
    motion = small_motion()
    rng = np.random.default_rng(0)
    return content(
        write_character, motion.skeleton, rng.uniform(0, 1, (9, 3)),
        np.arange(9).reshape(3, 3)[:, ::-1],  # so that they point outside
        np.tile([0.5, 0.5, 0, 0], (9, 1)), np.tile([0, 1, 2, 3], (9, 1)),
        motion=(motion.rotations, motion.positions),
    )  # fmt: skip


POSES = np.random.default_rng(1).normal(0.0, 0.3, (3, 24, 3))
PELVIS = np.zeros((3, 3))
amass = partial(content, write_amass, POSES, PELVIS, 30.0, suffix=".npz")
GRID = np.random.default_rng(2).uniform(0, 1, (3, 12, 3))
GRID_FACES = np.arange(12).reshape(4, 3)
BYTES = {
    "bvh": (lambda: content(write_bvh, small_motion()), ".bvh", reader_of("motion")),
    "smpl pkl": (lambda: pickle.dumps(small_model(), protocol=2), ".pkl", load_body),
    "hood pkl": (lambda: content(write_hood, POSES, PELVIS), ".pkl", reader_of("motion")),
    "vto pkl": (lambda: content(write_vto, POSES, PELVIS), ".pkl", reader_of("motion")),
    "glb": (character, ".glb", lambda p: (load_body(p), read("motion", p))),
    "joint map": (lambda: b'{"LeftArm": "left_shoulder", "Head": ""}', ".json", read_joint_map),
    "amass bytes": (amass, ".npz", reader_of("motion")),
}
for _kind, _read in GARMENTS.items():
    BYTES[f"garment {_kind}"] = (
        lambda kind=_kind: content(lambda path: whole_garment(kind, path)), f".{_kind.rpartition('.')[2]}", _read
    )  # fmt: skip
ACCLAIM = {
    ".asf": b":units\nangle deg\n:root\norder TX TY TZ RX RY RZ\naxis XYZ\nposition 0 0 0\norientation 0 0 0\n"
    b":bonedata\nbegin\nname spine\ndirection 0 1 0\nlength 2\naxis 0 0 20 XYZ\ndof rx rz\nend\n"
    b":hierarchy\nbegin\nroot spine\nend\n",
    ".amc": b":DEGREES\n1\nroot 0 1 0 0 20 0\nspine 10 20\n2\nroot 0 1 0 0 30 0\nspine 20 -20\n",
}
ARRAYS = {
    "smpl npz": (small_model, load_body),
    "amass": (lambda: arrays_of(amass()), reader_of("motion")),
    "mesh sequence": (
        lambda: {"positions": GRID, "faces": GRID_FACES, "fps": np.array(30.0)},
        lambda p: pose_sequence(read_mesh_sequence(p)),
    ),
    "motion archive": (
        lambda: {"joint_names": np.array(["a", "b"]), "c/rotations": np.zeros((4, 2, 3)),
                 "c/translations": np.zeros((4, 3)), "c/fps": np.array(30.0)},
        read_motion_archive,
    ),
    "body": (
        lambda: {
            "rest_positions": GRID[0], "shape_directions": np.zeros((12, 3, 2)),
            "joint_rest_positions": GRID[0][:2], "joint_shape_directions": np.zeros((2, 3, 2)),
            "parents": np.array([-1, 0]),
            "joint_names": np.array(["a", "b"]), "skin_weights": np.full((12, 2), 0.5),
            "skin_indices": np.tile([0, 1], (12, 1)), "faces": GRID_FACES, "obstacle_faces": np.ones(4, bool),
        },
        reader_of("body"),
    ),
    "garment": (lambda: {"positions": POSITIONS, "faces": FACES}, read_as_garment),
    "fitted garment": (
        lambda: arrays_of(content(lambda path: whole_garment("fitted.npz", path))), read_garment_npz,
    ),
    "trajectory": (
        lambda: arrays_of(content(write_trajectory, TrajectoryFile(
            GRID, GRID, GRID_FACES, 0.1, body=AnimatedMesh("body", GRID, GRID_FACES, rest_positions=GRID[0]),
            friction_loads=GRID[..., 0],
        ), suffix=".npz")),
        read_trajectory,
    ),
}  # fmt: skip
