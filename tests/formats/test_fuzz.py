"""Every reader of bodies, motions and runs, fed with damaged files: a named error or a value, nothing else.

Byte formats lose, gain and swap bytes; archives get arrays of other shapes and types; glTF gets other values
in its tables. While a file is read nothing may be opened for writing, no process started, and no class of a
pickle found; and it has to be over in ten seconds with less than a gigabyte.
"""

import io
import json
import os
import resource
import sys
import time

import jax
import numpy as np
import pytest
from broken import pack, reader_of, tables_of
from foreign_files import write_bvh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from whole_files import ACCLAIM, ARRAYS, BYTES, character, small_motion

from eslr_jax import EslrError, load_motion

MAX_SECONDS = 10.0
MAX_MEMORY = 1 << 30  # [bytes] that the process may grow by
QUICK = settings(
    max_examples=10, deadline=None, database=None, derandomize=True, suppress_health_check=list(HealthCheck)
)
THOROUGH = settings(QUICK, max_examples=200, derandomize=False)

watched = {"is_on": False, "seen": []}


def watch(event, arguments):
    """Note what a reader must not do."""
    if not watched["is_on"]:
        return
    is_write = event == "open" and isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_RDWR)
    # On a busy machine what a reader compiles takes long enough for JAX to keep it.
    is_write = is_write and not str(arguments[0]).startswith(str(jax.config.jax_compilation_cache_dir))
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


def case(kind):
    """The strategy of edits, the function from edits to a damaged file, its suffix, and its reader."""
    if kind == "tables":
        tables, blob = tables_of(character())
        return JSON_EDITS, lambda edits: pack(damage_tables(tables, edits), blob), ".glb", BYTES["glb"][2]
    if kind in ARRAYS:
        make, read = ARRAYS[kind]
        good = make()
        return ARRAY_EDITS, lambda edits: archive(damage_arrays(good, edits)), ".npz", read
    if kind in ACCLAIM:
        read = lambda path: reader_of("motion")(path.with_suffix(".amc"))  # noqa: E731
        return EDITS, lambda edits: damage(ACCLAIM[kind], edits), kind, read
    make, suffix, read = BYTES[kind]
    good = make()
    return EDITS, lambda edits: damage(good, edits), suffix, read


def archive(arrays):
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


def fuzz(kind, folder, options):
    edits, damaged, suffix, read = case(kind)
    for beside, good in ACCLAIM.items():
        (folder / f"file{beside}").write_bytes(good)
    path = folder / f"file{suffix}"
    path.write_bytes(damaged([]))
    read(path)  # what is damaged was whole

    @options
    @given(edits)
    def attempt(chosen):
        path.write_bytes(damaged(chosen))
        check(read, path)

    attempt()


# A damaged file may be read with a warning: of its unit, or of a number of frames.
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")
KINDS = (*BYTES, *ARRAYS, *ACCLAIM, "tables")


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_files(tmp_path, kind):
    fuzz(kind, tmp_path, QUICK)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_thousands_of_damaged_files(tmp_path, kind):
    fuzz(kind, tmp_path, THOROUGH)


def test_a_damaged_motion_moves_the_body_or_is_refused(tmp_path, body):
    path = tmp_path / "file.bvh"
    write_bvh(path, small_motion())
    text = path.read_bytes()
    for at in range(0, len(text), 97):
        path.write_bytes(damage(text, [("set", at / len(text), b"9")]))
        check(lambda file: load_motion(file, body=body), path)
