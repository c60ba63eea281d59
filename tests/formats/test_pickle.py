"""Pickles as data: what the restricted reader accepts, and that it runs nothing."""

import collections
import os
import pickle
import struct
from functools import partial

import numpy as np
import pytest
from broken import refuses

from eslr_jax import AssetError
from eslr_jax.pipeline.formats.pickle import read_pickle


def dump(tmp_path, value, protocol=pickle.DEFAULT_PROTOCOL):
    path = tmp_path / "content.pkl"
    path.write_bytes(value if isinstance(value, bytes) else pickle.dumps(value, protocol=protocol))
    return path


@pytest.mark.parametrize("protocol", range(6))
def test_arrays_and_containers_come_back(tmp_path, protocol):
    value = collections.OrderedDict(
        rest_pos=np.arange(12, dtype=np.float32).reshape(4, 3),
        turned=np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        big_endian=np.arange(3, dtype=">i4"),
        empty=np.zeros((0, 3), np.int64),
        names=np.array(["a", "bc"]),
        scalar=np.float64(2.5),
        flags=np.array([True, False]),
        nested=[{"center": np.array([1, 2])}, (1, None, "x", b"\xff", b"", -3.5)],
        same=np.ones(2),
    )
    value["again"] = value["same"]
    loaded = read_pickle(dump(tmp_path, value, protocol), content="test")
    assert list(loaded) == list(value)
    for key in ("rest_pos", "turned", "big_endian", "empty", "names", "scalar", "flags", "same"):
        np.testing.assert_array_equal(loaded[key], value[key])
        assert np.asarray(loaded[key]).dtype == np.asarray(value[key]).dtype.newbyteorder("=")
    np.testing.assert_array_equal(loaded["nested"][0]["center"], [1, 2])
    assert loaded["nested"][1] == value["nested"][1]
    assert loaded["again"] is loaded["same"]


class Hostile:
    def __init__(self, function, *arguments):
        self.call = (function, arguments)

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize("protocol", range(6))
@pytest.mark.parametrize("function", [os.system, eval, exec, getattr, __import__], ids=lambda f: f.__name__)
def test_hostile_pickles_run_nothing(tmp_path, protocol, function):
    trace = tmp_path / "ran"
    hostile = Hostile(function, f"touch {trace}" if function is os.system else f"open({str(trace)!r}, 'w')")
    path = dump(tmp_path, {"rest_pos": hostile}, protocol)
    with pytest.raises(AssetError, match=r"content.pkl can't be read as a pickle \(it names .*not data\)"):
        read_pickle(path, content="garment")
    assert not trace.exists()


def test_builds_aimed_at_the_reader_itself_leave_it_as_it_was(tmp_path):
    # GLOBAL numpy.ndarray, then BUILD with (None, {"arguments": 1}): sets attributes of a naive stand-in class.
    attack = b"\x80\x02cnumpy\nndarray\nN}X\x09\x00\x00\x00argumentsK\x01s\x86b."
    with pytest.raises(AssetError, match="can't be read"):
        read_pickle(dump(tmp_path, attack), content="t")
    test_arrays_and_containers_come_back(tmp_path, 2)


def broken():
    good = pickle.dumps({"rest_pos": np.zeros((2, 3))}, protocol=2)
    yield "empty", b""
    yield "text", b"garment"
    yield "truncated", good[: len(good) // 2]
    yield "memo bomb", b"\x80\x02}r\xff\xff\xff\x7f."
    yield "huge text", b"\x80\x04\x8d" + struct.pack("<Q", 1 << 62) + b"x."
    yield "wrong size", good.replace(b"K\x02K\x03\x86", b"K\x02K\x09\x86")
    yield "object", pickle.dumps({"a": np.array([{}, None], object)})
    yield "set", pickle.dumps({1, 2})
    yield "persistent", b"\x80\x02K\x01Q."
    yield "extension", b"\x80\x02\x82\x01."
    yield "deep", b"\x80\x02" + b"]" * 100_000 + b"a" * 99_999 + b"."
    yield "itself", b"\x80\x02]q\x00h\x00a."


@pytest.mark.parametrize(
    ("name", "content"), list(broken()), ids=lambda value: value if isinstance(value, str) else ""
)
def test_broken_pickles_are_named_in_one_line(tmp_path, name, content):
    path = dump(tmp_path, content)
    refuses(partial(read_pickle, content="test"), path, "test file ", "content.pkl can't be read as a pickle")


def test_missing_folder_and_large_files_are_named(tmp_path):
    read = partial(read_pickle, content="test", max_bytes=3)
    refuses(read, tmp_path / "none.pkl", "doesn't exist")
    refuses(read, tmp_path, "is a folder")
    refuses(read, dump(tmp_path, [1, 2]), "larger than 3 bytes")
