"""Every reader of bodies, motions and runs, fed with damaged files: a named error or a value, nothing else.

Byte formats lose, gain and swap bytes; archives get arrays of other shapes and types; glTF gets other values
in its tables. While a file is read nothing may be opened for writing, no process started, and no class of a
pickle found; and it has to be over in ten seconds with less than a gigabyte.
"""

import io
import json
import os
import pickle
import resource
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from formats import SMPL_PARENTS, write_amass, write_bvh, write_character, write_hood, write_vto
from garment_bytes import READERS, whole_file
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from eslr_jax.assets.motions import read_joint_map
from eslr_jax.body.motion import Motion
from eslr_jax.body.rig import make_body, make_motion
from eslr_jax.body.sequence import pose_sequence
from eslr_jax.errors import EslrError
from eslr_jax.io.asf import read_amc
from eslr_jax.io.body import read_body
from eslr_jax.io.bvh import read_bvh
from eslr_jax.io.gltf_rig import read_gltf_body, read_gltf_motion
from eslr_jax.io.mesh_sequence import read_mesh_sequence
from eslr_jax.io.motion import read_motion_archive
from eslr_jax.io.npz import write_arrays
from eslr_jax.io.skeleton import Skeleton, SkeletonMotion, chain_positions
from eslr_jax.io.smpl import read_amass, read_smpl_body, read_smpl_pickle
from eslr_jax.io.trajectory import BodyTrack, TrajectoryFile, read_trajectory, write_trajectory

MAX_SECONDS = 10.0
MAX_MEMORY = 1 << 30  # [bytes] that the process may grow by
QUICK = settings(
    max_examples=10, deadline=None, database=None, derandomize=True, suppress_health_check=list(HealthCheck)
)
THOROUGH = settings(
    QUICK, max_examples=200, derandomize=False
)  # ten readers of bytes and arrays: 2,000 and more

watched = {"is_on": False, "seen": []}


def watch(event, arguments):
    """Note what a reader must not do."""
    if not watched["is_on"]:
        return
    is_write = event == "open" and isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_RDWR)
    forbidden = ("os.system", "os.exec", "os.posix_spawn", "subprocess.Popen", "socket.connect", "os.remove")
    if is_write or event in forbidden:
        watched["seen"].append((event, str(arguments)[:200]))


sys.addaudithook(watch)


def check(read, path):
    """Read a damaged file: it may succeed or fail with a named error of one line."""
    before = sorted(os.listdir(path.parent))
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    started = time.monotonic()
    watched.update(is_on=True, seen=[])
    text = ""
    try:
        read(path)
    except EslrError as error:
        text = str(error)
    finally:
        watched["is_on"] = False
    assert "\n" not in text
    assert len(text) < 1000
    assert not watched["seen"]
    assert time.monotonic() - started < MAX_SECONDS
    assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory) * 1024 < MAX_MEMORY
    assert sorted(os.listdir(path.parent)) == before


# ---------------------------------------------------------------- ways to damage a file

EDITS = st.lists(
    st.tuples(
        st.sampled_from(["flip", "set", "insert", "delete", "repeat", "cut"]),
        st.floats(0, 1, exclude_max=True),
        st.one_of(
            st.binary(min_size=1, max_size=8),
            st.sampled_from(
                [b"\xff\xff\xff\x7f", b"\xff" * 8, b"-1", b"1e999", b"nan", b"999999999", b"}", b"\x00" * 4]
            ),
        ),
    ),
    min_size=1,
    max_size=5,
)


def damage(data, edits):
    for kind, share, payload in edits:
        at = int(share * len(data))
        if kind == "flip":
            data = data[:at] + bytes(b ^ payload[0] for b in data[at : at + 1]) + data[at + 1 :]
        elif kind == "set":
            data = data[:at] + payload + data[at + len(payload) :]
        elif kind == "insert":
            data = data[:at] + payload + data[at:]
        elif kind == "delete":
            data = data[:at] + data[at + 4 * len(payload) :]
        elif kind == "repeat":
            data = data[: at + 64] + data[at:]
        else:
            data = data[:at]
    return data


ARRAY_EDITS = st.lists(
    st.tuples(
        st.integers(0, 50),
        st.sampled_from(
            ["drop", "nan", "huge", "minus", "empty", "scalar", "flat", "axis", "turn", "text", "bool", "int8",
             "half", "complex", "longer", "one"]
        ),
    ),
    min_size=1,
    max_size=3,
)  # fmt: skip


def cast(values, dtype):
    return np.nan_to_num(values).astype(dtype) if values.dtype.kind in "fiub" else values


def damage_arrays(arrays, edits):
    arrays = dict(arrays)
    for number, kind in edits:
        key = sorted(arrays)[number % len(arrays)]
        value = np.asarray(arrays[key])
        with np.errstate(all="ignore"):
            if kind == "drop" and len(arrays) > 1:
                del arrays[key]
                continue
            changed = {
                "nan": lambda v: np.full(v.shape, np.nan),
                "huge": lambda v: np.full(v.shape, 2**31 - 1),
                "minus": lambda v: np.full(v.shape, -1),
                "empty": lambda v: v[:0] if v.ndim else v,
                "scalar": lambda v: v.ravel()[0] if v.size else v,
                "flat": np.ravel,
                "axis": lambda v: v[None],
                "turn": np.transpose,
                "text": lambda v: v.astype(str),
                "bool": lambda v: cast(v, bool),
                "int8": lambda v: cast(v, np.int8),
                "half": lambda v: cast(v, np.float16),
                "complex": lambda v: cast(v, complex),
                "longer": lambda v: np.concatenate([v, v]) if v.ndim else v,
                "one": lambda v: v[:1] if v.ndim else v,
            }.get(kind, np.copy)(value)
        arrays[key] = changed
    return arrays


JSON_EDITS = st.lists(
    st.tuples(
        st.integers(0, 10_000),
        st.sampled_from(
            [None, -1, 0, 1, 7, 10**12, 1e308, float("nan"), "x", [], {}, [0], True, "data:,", "../x"]
        ),
    ),
    min_size=1,
    max_size=4,
)


def damage_tables(tables, edits):
    tables = json.loads(json.dumps(tables))
    for number, value in edits:
        places = []

        def visit(node, places=places):
            for key in node if isinstance(node, dict) else range(len(node)):
                places.append((node, key))
                if isinstance(node[key], dict | list):
                    visit(node[key])

        visit(tables)
        if places:
            node, key = places[number % len(places)]
            node[key] = value
    return tables


# ---------------------------------------------------------------- whole files to damage


def small_motion():
    rng = np.random.default_rng(0)
    names = ("Hips", "Spine", "Head", "LeftUpLeg", "LeftLeg", "LeftFoot", "RightUpLeg", "LeftArm", "RightArm")
    skeleton = Skeleton(names, (-1, 0, 1, 0, 3, 4, 0, 1, 1), rng.normal(size=(9, 3)))
    turned = np.tile(np.eye(3), (3, 9, 1, 1))
    return SkeletonMotion("a", skeleton, turned, chain_positions(turned, np.zeros((3, 3)), skeleton), 30.0)


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
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"a{suffix}"
        write(path, *arguments, **options)
        return path.read_bytes()


def arrays_of(data):
    with np.load(io.BytesIO(data), allow_pickle=False) as archive:
        return dict(archive)


def garment_bytes(kind):
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        return whole_file(kind, Path(folder))


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
GRID = np.random.default_rng(2).uniform(0, 1, (3, 12, 3))
FACES = np.arange(12).reshape(4, 3)
BYTES = {
    "bvh": (lambda: content(write_bvh, small_motion()), ".bvh", read_bvh),
    "smpl pkl": (
        lambda: pickle.dumps(small_model(), protocol=2),
        ".pkl",
        lambda p: make_body(read_smpl_body(p)),
    ),
    "hood pkl": (lambda: content(write_hood, POSES, PELVIS), ".pkl", read_smpl_pickle),
    "vto pkl": (lambda: content(write_vto, POSES, PELVIS), ".pkl", read_smpl_pickle),
    "glb": (character, ".glb", lambda p: (make_body(read_gltf_body(p)), read_gltf_motion(p))),
    "joint map": (lambda: b'{"LeftArm": "left_shoulder", "Head": ""}', ".json", read_joint_map),
    "amass bytes": (lambda: content(write_amass, POSES, PELVIS, 30.0, suffix=".npz"), ".npz", read_amass),
}
for _kind, _read in READERS.items():
    BYTES[f"garment {_kind}"] = (
        lambda kind=_kind: garment_bytes(kind), f".{_kind.rpartition('.')[2]}", _read
    )  # fmt: skip
ACCLAIM = {
    ".asf": b":units\nangle deg\n:root\norder TX TY TZ RX RY RZ\naxis XYZ\nposition 0 0 0\norientation 0 0 0\n"
    b":bonedata\nbegin\nname spine\ndirection 0 1 0\nlength 2\naxis 0 0 20 XYZ\ndof rx rz\nend\n"
    b":hierarchy\nbegin\nroot spine\nend\n",
    ".amc": b":DEGREES\n1\nroot 0 1 0 0 20 0\nspine 10 20\n2\nroot 0 1 0 0 30 0\nspine 20 -20\n",
}
ARRAYS = {
    "smpl npz": (small_model, lambda p: make_body(read_smpl_body(p))),
    "amass": (lambda: arrays_of(content(write_amass, POSES, PELVIS, 30.0, suffix=".npz")), read_amass),
    "mesh sequence": (
        lambda: {"positions": GRID, "faces": FACES, "fps": np.array(30.0)},
        lambda p: pose_sequence(read_mesh_sequence(p)),
    ),
    "motion archive": (
        lambda: {"joint_names": np.array(["a", "b"]), "c/rotations": np.zeros((4, 2, 3)),
                 "c/translations": np.zeros((4, 3)), "c/fps": np.array(30.0)},
        lambda p: [Motion(name, *clip) for name, clip in read_motion_archive(p).items()],
    ),
    "body": (
        lambda: {
            "rest_positions": GRID[0], "shape_directions": np.zeros((12, 3, 2)),
            "joint_rest_positions": GRID[0][:2], "joint_shape_directions": np.zeros((2, 3, 2)),
            "parents": np.array([-1, 0]),
            "joint_names": np.array(["a", "b"]), "skin_weights": np.full((12, 2), 0.5),
            "skin_indices": np.tile([0, 1], (12, 1)), "faces": FACES, "obstacle_faces": np.ones(4, bool),
        },
        read_body,
    ),
    "trajectory": (
        lambda: arrays_of(content(write_trajectory, TrajectoryFile(
            GRID, GRID, FACES, 0.1, body=BodyTrack(GRID, FACES, GRID[0], FACES[:2], np.arange(3)),
            friction_loads=GRID[..., 0],
        ), suffix=".npz")),
        read_trajectory,
    ),
}  # fmt: skip


def fuzz_bytes(kind, folder, options):
    make, suffix, read = BYTES[kind]
    good = make()
    path = folder / f"file{suffix}"
    path.write_bytes(good)
    read(path)  # what is damaged was whole

    @options
    @given(EDITS)
    def attempt(edits):
        path.write_bytes(damage(good, edits))
        check(read, path)

    attempt()


def fuzz_arrays(kind, folder, options):
    make, read = ARRAYS[kind]
    good, path = make(), folder / "file.npz"
    write_arrays(path, good)
    read(path)

    @options
    @given(ARRAY_EDITS)
    def attempt(edits):
        with path.open("wb") as stream:
            np.savez(stream, **damage_arrays(good, edits))
        check(read, path)

    attempt()


def fuzz_tables(folder, options):
    data = character()
    length = int.from_bytes(data[12:16], "little")
    tables, blob = json.loads(data[20 : 20 + length]), data[28 + length :]
    path = folder / "file.glb"
    read = BYTES["glb"][2]

    @options
    @given(JSON_EDITS)
    def attempt(edits):
        text = json.dumps(damage_tables(tables, edits)).encode()
        chunks = len(text).to_bytes(4, "little") + b"JSON" + text
        chunks += len(blob).to_bytes(4, "little") + b"BIN\0" + blob
        path.write_bytes(
            b"glTF" + (2).to_bytes(4, "little") + (12 + len(chunks)).to_bytes(4, "little") + chunks
        )
        check(read, path)

    attempt()


@pytest.mark.parametrize("kind", BYTES)
def test_damaged_bytes(tmp_path, kind):
    fuzz_bytes(kind, tmp_path, QUICK)


@pytest.mark.parametrize("suffix", ACCLAIM)
def test_damaged_acclaim(tmp_path, suffix):
    for kind, good in ACCLAIM.items():
        (tmp_path / f"file{kind}").write_bytes(good)
    assert read_amc(tmp_path / "file.amc").positions.shape == (2, 2, 3)

    @QUICK
    @given(EDITS)
    def attempt(edits):
        (tmp_path / f"file{suffix}").write_bytes(damage(ACCLAIM[suffix], edits))
        check(read_amc, tmp_path / "file.amc")

    attempt()


@pytest.mark.parametrize("kind", ARRAYS)
def test_damaged_arrays(tmp_path, kind):
    fuzz_arrays(kind, tmp_path, QUICK)


def test_damaged_tables(tmp_path):
    fuzz_tables(tmp_path, QUICK)


@pytest.mark.slow
def test_two_thousand_damaged_files(tmp_path):
    runs = [(fuzz_bytes, kind) for kind in BYTES] + [(fuzz_arrays, kind) for kind in ARRAYS]
    for number, (fuzz, kind) in enumerate(runs):
        folder = tmp_path / str(number)
        folder.mkdir()
        fuzz(kind, folder, THOROUGH)
    (tmp_path / "tables").mkdir()
    fuzz_tables(tmp_path / "tables", THOROUGH)


def test_a_damaged_motion_moves_the_body_or_is_refused(tmp_path, body):
    good = small_motion()
    path = tmp_path / "file.bvh"
    write_bvh(path, good)
    text = path.read_bytes()
    for at in range(0, len(text), 97):
        path.write_bytes(damage(text, [("set", at / len(text), b"9")]))
        check(lambda file: make_motion(read_bvh(file), body, up="auto"), path)
