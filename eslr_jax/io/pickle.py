"""Pickles of other projects, read as data: nothing that a file names is imported or called.

Every global of the pickle is replaced by an inert class of this module. What comes out is made of dict, list,
tuple, str, bytes, int, float, bool, None, NumPy arrays of numbers and SciPy sparse arrays; anything else is
refused.
"""

from __future__ import annotations

import io
import math
import pickle
import pickletools
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse

from eslr_jax.io.parsing import parsing

_DTYPE_KINDS = "biufcSUO"
_PLAIN = (str, bytes, int, float, complex, bool, type(None))


class _Node:
    """What a pickle names: remembers its arguments and its state.

    `__setstate__` is a plain method, so that a BUILD aimed at the class itself fails for want of an instance
    instead of setting attributes of the class.
    """

    __slots__ = ("arguments", "state")

    def __new__(cls, *arguments: Any) -> Any:
        node = object.__new__(cls)
        node.arguments = arguments
        node.state = None
        return node

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Dtype(_Node):
    """numpy.dtype(name, align, copy), state (version, byte order, ...)."""

    def resolve(self) -> np.dtype[Any]:
        """Return a dtype of plain numbers or text."""
        order = self.state[1] if isinstance(self.state, tuple) and len(self.state) > 1 else "="
        name = _text(self.arguments[0])
        dtype = np.dtype(name)
        if dtype.kind not in _DTYPE_KINDS or dtype.names is not None or dtype.subdtype is not None:
            raise ValueError(f"arrays of {name[:20]!r} are not read")
        return dtype.newbyteorder(_text(order)) if _text(order) in ("<", ">") else dtype


class _Array(_Node):
    """numpy.ndarray from _reconstruct, state (version, shape, dtype, is_fortran, data)."""


class _Reconstruct(_Node):
    """numpy.core.multiarray._reconstruct(type, shape, kind): an empty array that gets its state later."""

    def __new__(cls, *arguments: Any) -> Any:
        return _Array()


class _FromBuffer(_Node):
    """numpy.core.numeric._frombuffer(data, dtype, shape, order), of protocol 5."""


class _Scalar(_Node):
    """numpy.core.multiarray.scalar(dtype, data)."""


class _CompressedColumns(_Node):
    """scipy.sparse.csc_matrix, state: its attributes."""


class _CompressedRows(_Node):
    """scipy.sparse.csr_matrix, state: its attributes."""


class _Chumpy(_Node):
    """chumpy.ch.Ch: an array in the attribute x."""


class _ChumpySelect(_Node):
    """chumpy.reordering.Select: entries idxs of the array a, in a preferred shape."""


class _Object(_Node):
    """The builtin object, which _reconstructor names as a base."""


class _Reconstructor(_Node):
    """copyreg._reconstructor(class, base, state), of protocols 0 and 1."""

    def __new__(cls, *arguments: Any) -> Any:
        if not arguments or not (isinstance(arguments[0], type) and issubclass(arguments[0], _Node)):
            raise pickle.UnpicklingError("it rebuilds an object of an unknown class")
        return arguments[0]()


class _Encode(_Node):
    """_codecs.encode(text, "latin1"): how protocol 2 writes bytes."""

    def __new__(cls, *arguments: Any) -> Any:
        return _bytes(arguments[0])


class _NoBytes(_Node):
    """bytes(): how protocol 2 writes empty bytes."""

    def __new__(cls, *arguments: Any) -> Any:
        return b""


_KNOWN: dict[tuple[str, str], type] = {
    ("copy_reg", "_reconstructor"): _Reconstructor,
    ("copyreg", "_reconstructor"): _Reconstructor,
    ("__builtin__", "object"): _Object,
    ("builtins", "object"): _Object,
    ("__builtin__", "bytes"): _NoBytes,
    ("builtins", "bytes"): _NoBytes,
    ("_codecs", "encode"): _Encode,
    ("collections", "OrderedDict"): dict,
    ("numpy", "ndarray"): _Array,
    ("numpy", "dtype"): _Dtype,
    ("chumpy.ch", "Ch"): _Chumpy,
    ("chumpy.reordering", "Select"): _ChumpySelect,
}
for _core in ("numpy.core", "numpy._core"):  # renamed in NumPy 2
    _KNOWN[f"{_core}.multiarray", "_reconstruct"] = _Reconstruct
    _KNOWN[f"{_core}.multiarray", "scalar"] = _Scalar
    _KNOWN[f"{_core}.numeric", "_frombuffer"] = _FromBuffer
for _kind, _class in (("csc", _CompressedColumns), ("csr", _CompressedRows)):
    for _module in (f"scipy.sparse.{_kind}", f"scipy.sparse._{_kind}"):  # renamed in SciPy 1.8
        for _name in (f"{_kind}_matrix", f"{_kind}_array"):
            _KNOWN[_module, _name] = _class


class _Unpickler(pickle.Unpickler):
    """Finds nothing but the inert classes."""

    def find_class(self, module_name: str, global_name: str) -> Any:
        if (module_name, global_name) not in _KNOWN:
            raise pickle.UnpicklingError(f"it names {module_name[:60]}.{global_name[:60]}, which is not data")
        return _KNOWN[module_name, global_name]


def read_pickle(path: str | Path, *, content: str, max_bytes: int = 4 << 30) -> Any:
    """Read a pickle of plain containers, numbers and arrays, without importing or calling what it names.

    Pickles of Python 2 are read too; their text and bytes both arrive as str.

    Args:
        path: The file.
        content: What the file should be, for messages, e.g. "garment".
        max_bytes: Largest file accepted [bytes].

    Returns:
        dict, list, tuple, str, bytes, numbers, None, arrays, and sparse arrays (`csc_array`, `csr_array`; their
        shape is the file's claim: check it before making one dense). `chumpy` objects become arrays.

    Raises:
        AssetError: The file is missing, damaged, too large, or holds anything else.
    """
    with parsing(path, content, max_bytes=max_bytes, form=" as a pickle", remedy="write it again") as file:
        data = file.read_bytes()
        _check_memo(data)
        return _Resolver().resolve(_Unpickler(io.BytesIO(data), encoding="latin1").load())


def _check_memo(data: bytes) -> None:
    """Raise on a memo index beyond the number of opcodes: the reader would allocate a table of that size."""
    largest, count = 0, 0
    for opcode, argument, _ in pickletools.genops(data):
        count += 1
        if opcode.name.endswith("PUT") and isinstance(argument, int):
            largest = max(largest, argument)
    if largest > count:
        raise ValueError(f"memo index {largest} of {count} opcodes")


class _Resolver:
    """Turns nodes into arrays, each shared object once."""

    def __init__(self) -> None:
        self.done: dict[int, Any] = {}
        self.open: set[int] = set()

    def resolve(self, value: Any) -> Any:
        """Return plain data for whatever the unpickler built."""
        if type(value) in _PLAIN:
            return value
        key = id(value)
        if key in self.done:
            return self.done[key]
        if key in self.open:
            raise ValueError("it contains itself")
        self.open.add(key)
        result = self._convert(value)
        self.open.discard(key)
        self.done[key] = result
        return result

    def _convert(self, value: Any) -> Any:
        if type(value) is dict:
            return {self.resolve(key): self.resolve(item) for key, item in value.items()}
        if type(value) in (list, tuple):
            return type(value)(self.resolve(item) for item in value)
        if isinstance(value, _Dtype):
            return value.resolve()
        if isinstance(value, _Array):
            _, shape, dtype, is_fortran, data = value.state
            return self._array(data, dtype, shape, "F" if is_fortran else "C")
        if isinstance(value, _FromBuffer):
            data, dtype, shape, order = value.arguments
            return self._array(data, dtype, shape, _text(order))
        if isinstance(value, _Scalar):
            return self._array(value.arguments[1], value.arguments[0], (), "C")[()]
        if isinstance(value, _CompressedColumns | _CompressedRows):
            return self._sparse(value)
        if isinstance(value, _Chumpy):
            return np.asarray(self._attributes(value)["x"])
        if isinstance(value, _ChumpySelect):
            attributes = self._attributes(value)
            picked = np.ravel(attributes["a"])[np.asarray(attributes["idxs"], np.int64)]
            return picked.reshape(attributes.get("preferred_shape") or picked.shape)
        raise ValueError(f"it holds a {type(value).__name__.strip('_')}, which is not data")

    def _attributes(self, node: _Node) -> dict[str, Any]:
        """Return the attributes that an object was pickled with."""
        state = node.state
        if type(state) is tuple and len(state) == 2:  # attributes and slots
            state = {**(state[0] or {}), **(state[1] or {})}
        if type(state) is not dict:
            raise ValueError(f"a {type(node).__name__.strip('_')} has no attributes")
        # Only what is needed: chumpy keeps caches of foreign objects beside its values.
        kept = ("x", "a", "idxs", "preferred_shape", "_shape", "shape", "data", "indices", "indptr")
        return {name: self.resolve(state[name]) for name in kept if name in state}

    def _array(self, data: Any, dtype: Any, shape: Any, order: str) -> np.ndarray:
        """Return the array whose header and data agree."""
        if not isinstance(dtype, _Dtype):
            raise ValueError("an array has no dtype")
        kind = dtype.resolve()
        if type(shape) is not tuple or not all(type(size) is int and size >= 0 for size in shape):
            raise ValueError("an array has an impossible shape")
        if kind.kind == "O":
            return self._object_array(data, shape, order)
        raw = _bytes(data)
        if math.prod(shape) * kind.itemsize != len(raw):
            raise ValueError(f"an array of shape {shape} has {len(raw)} bytes")
        values = np.frombuffer(raw, kind) if kind.itemsize else np.zeros(0, kind)
        return values.reshape(shape, order="F" if order == "F" else "C").astype(kind.newbyteorder("="))

    def _object_array(self, data: Any, shape: tuple[int, ...], order: str) -> np.ndarray:
        """Return an array of Python objects, if they are numbers after all."""
        if type(data) is not list or math.prod(shape) != len(data):
            raise ValueError("an array of objects has no list of them")
        values = np.asarray([self.resolve(item) for item in data])
        if values.dtype.kind not in "biuf" or values.shape != (len(data),):
            raise ValueError("an array of objects does not hold numbers")
        return values.reshape(shape, order="F" if order == "F" else "C")

    def _sparse(self, node: _Node) -> scipy.sparse.csc_array | scipy.sparse.csr_array:
        """Return a sparse array whose indices were checked."""
        attributes = self._attributes(node)
        shape = attributes.get("_shape", attributes.get("shape"))
        parts = tuple(np.asarray(attributes[name]) for name in ("data", "indices", "indptr"))
        make = scipy.sparse.csc_array if isinstance(node, _CompressedColumns) else scipy.sparse.csr_array
        array = make(parts, shape=shape)
        array.check_format(full_check=True)
        return array


def _text(value: Any) -> str:
    """Return text, which Python 2 wrote as bytes."""
    if isinstance(value, bytes):
        return value.decode("latin1")
    if not isinstance(value, str):
        raise ValueError("text is missing")
    return value


def _bytes(value: Any) -> bytes:
    """Return bytes, which Python 2 wrote as text and protocol 5 as a bytearray."""
    if isinstance(value, str):
        return value.encode("latin1")
    if not isinstance(value, bytes | bytearray):
        raise ValueError("the data of an array is missing")
    return bytes(value)
