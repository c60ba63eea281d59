"""PyTorch's archives as data, without PyTorch."""

from __future__ import annotations

import collections
import io
import pickle
import sys
import types
import zipfile
from functools import partial

import numpy as np
import pytest
from broken import refuses

from eslr_jax.pipeline.formats.torch_archive import read_torch

read = partial(read_torch, content="checkpoint")
STORAGES = {"f4": "FloatStorage", "f8": "DoubleStorage", "i8": "LongStorage", "b1": "BoolStorage"}


class Tensor:
    """A tensor as `torch.save` stores it: a piece of a storage."""

    def __init__(self, array, *, shape=None, strides=None, offset=0):
        self.array = np.ascontiguousarray(array)
        self.shape = self.array.shape if shape is None else shape
        items = tuple(step // self.array.itemsize for step in self.array.strides)
        self.strides, self.offset = items if strides is None else strides, offset

    def __reduce_ex__(self, protocol):
        rebuild = sys.modules["torch._utils"]._rebuild_tensor_v2
        pieces = (
            Storage(self.array),
            self.offset,
            self.shape,
            self.strides,
            False,
            collections.OrderedDict(),
        )
        return rebuild, pieces


class Storage:
    def __init__(self, array):
        self.array = array


def write_archive(path, content, *, order="<", damage=None):
    """Write what `torch.save` would: the pickle, and every storage beside it."""
    with FakeTorch():
        stream, storages = io.BytesIO(), []

        class Pickler(pickle.Pickler):
            def persistent_id(self, obj):
                if not isinstance(obj, Storage):
                    return None
                storages.append(obj.array)
                kind = getattr(sys.modules["torch"], STORAGES[obj.array.dtype.str[1:]])
                return "storage", kind, str(len(storages) - 1), "cpu", obj.array.size

        Pickler(stream, protocol=2).dump(content)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("model/data.pkl", stream.getvalue())
        archive.writestr("model/byteorder", "little" if order == "<" else "big")
        for k, array in enumerate(storages):
            raw = array.astype(array.dtype.newbyteorder(order)).tobytes()
            archive.writestr(f"model/data/{k}", raw[:-1] if damage == "storage" else raw)
    return path


class FakeTorch:
    """Modules with the names that PyTorch's pickles hold."""

    def __enter__(self):
        torch, utils = types.ModuleType("torch"), types.ModuleType("torch._utils")
        for name in STORAGES.values():
            setattr(torch, name, type(name, (), {"__module__": "torch", "__qualname__": name}))

        def _rebuild_tensor_v2():
            raise AssertionError("nothing that a file names is called")

        _rebuild_tensor_v2.__module__, _rebuild_tensor_v2.__qualname__ = "torch._utils", "_rebuild_tensor_v2"
        utils._rebuild_tensor_v2 = _rebuild_tensor_v2
        self.before = {name: sys.modules.get(name) for name in ("torch", "torch._utils")}
        sys.modules.update({"torch": torch, "torch._utils": utils})

    def __exit__(self, *_):
        for name, module in self.before.items():
            sys.modules.pop(name)
            if module is not None:
                sys.modules[name] = module


@pytest.mark.parametrize("order", "<>")
def test_tensors_and_containers_come_back(tmp_path, order):
    values = np.arange(12, dtype=np.float32)
    content = {
        "weights": collections.OrderedDict(a=Tensor(values.reshape(3, 4)), b=Tensor(np.float64([1.5]))),
        "turned": Tensor(values, shape=(4, 3), strides=(1, 4)),
        "piece": Tensor(values, shape=(2,), strides=(5,), offset=1),
        "empty": Tensor(values, shape=(0, 3), strides=(3, 1)),
        "scalar": Tensor(values, shape=(), strides=(), offset=7),
        "flags": Tensor(np.array([True, False])),
        "config": {"lr": 5e-5, "steps": [1, None, "x"]},
    }
    found = read(write_archive(tmp_path / "a.pth", content, order=order))
    np.testing.assert_array_equal(found["weights"]["a"], values.reshape(3, 4))
    assert found["weights"]["b"].dtype == np.float64
    assert found["weights"]["b"] == 1.5
    np.testing.assert_array_equal(found["turned"], values.reshape(3, 4).T)
    np.testing.assert_array_equal(found["piece"], [1, 6])
    assert found["empty"].shape == (0, 3)
    assert found["scalar"] == 7
    np.testing.assert_array_equal(found["flags"], [True, False])
    assert found["config"] == content["config"]


def bad_archives():
    values = np.zeros(4, np.float32)
    yield "shape", Tensor(values, shape=(5,), strides=(1,)), None
    yield "stride", Tensor(values, shape=(2,), strides=(4,)), None
    yield "repeats", Tensor(values, shape=(1 << 40,), strides=(0,)), None
    yield "negative", Tensor(values, shape=(-1,), strides=(1,)), None
    yield "storage", Tensor(values), "storage"
    yield "function", print, None
    yield "class", collections.Counter(), None


@pytest.mark.parametrize(("content", "damage"), [case[1:] for case in bad_archives()], ids=range(7))
def test_broken_archives_are_named_in_one_line(tmp_path, content, damage):
    path = write_archive(tmp_path / "a.pth", {"x": content}, damage=damage)
    refuses(read, path, "checkpoint file ", "a.pth can't be read as a PyTorch archive")


def test_files_that_are_no_archive_are_named(tmp_path):
    (tmp_path / "old.pth").write_bytes(pickle.dumps([1]))
    refuses(read, tmp_path / "old.pth", "no archive of PyTorch 1.6")
    with zipfile.ZipFile(tmp_path / "other.pth", "w") as archive:
        archive.writestr("a.txt", "x")
    refuses(read, tmp_path / "other.pth", "no data.pkl")
    path = write_archive(tmp_path / "a.pth", {"x": Tensor(np.zeros(100, np.float32))})
    refuses(partial(read, max_bytes=100), path, "larger than 100 bytes")
