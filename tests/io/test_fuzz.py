"""Every reader of bodies, motions and runs, fed with damaged files: a named error or a value, nothing else.

Byte formats lose, gain and swap bytes; archives get arrays of other shapes and types; glTF gets other values
in its tables. While a file is read nothing may be opened for writing, no process started, and no class of a
pickle found; and it has to be over in ten seconds with less than a gigabyte.
"""

import json
import os
import resource
import sys
import time

import numpy as np
import pytest
from broken import pack, tables_of
from formats import write_bvh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from whole_files import ACCLAIM, ARRAYS, BYTES, character, small_motion

from eslr_jax.body.rig import make_motion
from eslr_jax.errors import EslrError
from eslr_jax.io.asf import read_amc
from eslr_jax.io.bvh import read_bvh
from eslr_jax.io.npz import write_arrays

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
    tables, blob = tables_of(character())
    path = folder / "file.glb"
    read = BYTES["glb"][2]

    @options
    @given(JSON_EDITS)
    def attempt(edits):
        path.write_bytes(pack(damage_tables(tables, edits), blob))
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
