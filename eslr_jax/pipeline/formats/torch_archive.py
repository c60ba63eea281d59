"""Read PyTorch's checkpoints as data, without PyTorch: nothing that a file names is imported or called.

An archive is a zip file with a pickle of the tree, and the numbers of every tensor beside it.

Source: PyTorch 2, torch/serialization.py and torch/_utils.py.
"""

from __future__ import annotations

import math
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from eslr_jax.errors import AssetError
from eslr_jax.files.parsing import parsing
from eslr_jax.pipeline.formats.pickle import make_stub, unpickle

_FLOATS = {"FloatStorage": "f4", "DoubleStorage": "f8", "HalfStorage": "f2"}
_INTEGERS = {"LongStorage": "i8", "IntStorage": "i4", "ShortStorage": "i2", "CharStorage": "i1"}
_STORAGES = {**_FLOATS, **_INTEGERS, "ByteStorage": "u1", "BoolStorage": "?"}


def read_torch(path: str | Path, *, content: str, max_bytes: int = 4 << 30) -> Any:
    """Read a file that `torch.save` wrote (PyTorch 1.6 or later) and that unpacks to at most `max_bytes`.

    Returns:
        dict, list, tuple, str, numbers and None, with NumPy arrays in the place of tensors and parameters.

    Raises:
        AssetError: The file is missing, damaged or too large, or it holds anything else.
    """
    with parsing(
        path, content, max_bytes=max_bytes, form=" as a PyTorch archive", remedy="save it again"
    ) as file:
        if not zipfile.is_zipfile(file):
            raise AssetError(
                f"{content} file {path} is no archive of PyTorch 1.6 or later, or it is truncated; "
                "load and save it with a newer PyTorch"
            )
        with zipfile.ZipFile(file) as archive:
            if sum(member.file_size for member in archive.infolist()) > max_bytes:
                raise ValueError(f"it unpacks to more than {max_bytes} bytes")
            trees = [name for name in archive.namelist() if name.endswith("/data.pkl")]
            if len(trees) != 1:
                raise ValueError("it has no data.pkl")
            storages = {make_stub(_refuse): np.dtype(code) for code in _STORAGES.values()}
            stubs = dict(zip((f"torch.{name}" for name in _STORAGES), storages, strict=True))
            find = _storage_finder(archive, trees[0].removesuffix("data.pkl"), storages)
            return unpickle(archive.read(trees[0]), stubs=_TENSORS | stubs, find_persistent=find)


def _refuse(stub: Any, plain: Any) -> Any:
    """Refuse a class of storages in the place of a value."""
    raise ValueError("it holds a storage that is no tensor's")


def _storage_finder(
    archive: zipfile.ZipFile, root: str, dtypes: Mapping[type, np.dtype[Any]]
) -> Callable[[Any], Any]:
    """Return the function from a persistent id to the stub of a storage in a folder of the open file."""
    order = f"{root}byteorder"
    is_big = order in archive.namelist() and archive.read(order) == b"big"

    def find(pid: Any) -> Any:
        kind, storage, key, _device, count = pid
        if kind != "storage" or storage not in dtypes or not isinstance(key, str):
            raise ValueError("it refers to something else than a storage")
        dtype = dtypes[storage].newbyteorder(">" if is_big else "<")

        def read(_stub: Any, _plain: Any) -> np.ndarray:
            raw = archive.read(f"{root}data/{key}")
            if count * dtype.itemsize != len(raw):
                raise ValueError(f"storage {key[:20]} has another size")
            return np.frombuffer(raw, dtype).astype(dtype.newbyteorder("="))

        return make_stub(read)()

    return find


def _tensor(stub: Any, plain: Callable[[Any], Any]) -> np.ndarray:
    """Convert _rebuild_tensor_v2(storage, offset, shape, strides, ...)."""
    storage, offset, shape, strides = stub.arguments[:4]
    values, shape, strides = plain(storage), plain(shape), plain(strides)
    sizes = (offset, *shape, *strides)
    if not isinstance(values, np.ndarray) or not all(type(size) is int and size >= 0 for size in sizes):
        raise ValueError("a tensor has an impossible header")
    last = offset + sum((size - 1) * stride for size, stride in zip(shape, strides, strict=True))
    if math.prod(shape) and (math.prod(shape) > len(values) or last >= len(values)):
        raise ValueError(f"a tensor of shape {shape} has other data")
    if not math.prod(shape):
        return np.zeros(shape, values.dtype)
    steps = [stride * values.itemsize for stride in strides]
    return np.lib.stride_tricks.as_strided(values[offset:], shape, steps).copy()


_TENSORS = {
    "torch._utils._rebuild_tensor_v2": make_stub(_tensor),
    "torch._utils._rebuild_parameter": make_stub(lambda stub, plain: plain(stub.arguments[0])),
    "torch.Size": make_stub(lambda stub, plain: tuple(plain(stub.arguments[0]))),
}
