"""Read pickles of other projects as data: nothing that a file names is imported or called.

A pickle may name only the globals in `_ALLOWED`. Each becomes an inert stub that keeps its arguments and its
state. Stubs turn into NumPy and SciPy arrays after all of their numbers were checked.
"""

from __future__ import annotations

import io
import math
import pickle
import pickletools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse

from eslr_jax.io.parsing import parsing

_PLAIN = (str, bytes, int, float, complex, bool, type(None))
_Plain = Callable[[Any], Any]  # turns what the unpickler built into plain data


class _Stub:
    """Stands for a global of the pickle; calling it or setting its state only stores the values.

    `__setstate__` is an instance method: a BUILD opcode aimed at the class itself fails, and changes nothing.
    """

    __slots__ = ("arguments", "state")
    convert: Any  # of a class for one global: the function from stub and `plain` to plain data

    def __new__(cls, *arguments: Any) -> Any:
        stub = object.__new__(cls)
        stub.arguments, stub.state = arguments, None
        return stub

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Reconstructor(_Stub):
    """copyreg._reconstructor(class, base, state): an object in protocols 0 and 1."""

    def __new__(cls, *arguments: Any) -> Any:
        if not arguments or not (isinstance(arguments[0], type) and issubclass(arguments[0], _Stub)):
            raise pickle.UnpicklingError("it rebuilds an object of an unknown class")
        return arguments[0]()


def _attributes(stub: _Stub, plain: _Plain, *names: str) -> dict[str, Any]:
    """Return those of the named attributes that an object was stored with."""
    state = stub.state
    if type(state) is tuple and len(state) == 2:  # attributes and slots
        state = {**(state[0] or {}), **(state[1] or {})}
    if type(state) is not dict:
        raise ValueError("an object has no attributes")
    return {name: plain(state[name]) for name in names if name in state}


def _bytes(stub: _Stub, plain: _Plain) -> bytes:
    """Convert _codecs.encode(text, "latin1") and bytes(), which protocol 2 writes for bytes."""
    return _text(stub.arguments[0]).encode("latin1") if stub.arguments else b""


def _dtype(stub: _Stub, plain: _Plain) -> np.dtype[Any]:
    """Convert numpy.dtype(name, align, copy) with the state (version, byte order, ...)."""
    order = _text(stub.state[1]) if isinstance(stub.state, tuple) and len(stub.state) > 1 else "="
    dtype = np.dtype(_text(stub.arguments[0]))
    if dtype.kind not in "biufcSUO" or dtype.names is not None or dtype.subdtype is not None:
        raise ValueError(f"arrays of {str(dtype)[:20]!r} are not read")
    return dtype.newbyteorder(order) if order in ("<", ">") else dtype


def _array(stub: _Stub, plain: _Plain) -> np.ndarray:
    """Convert numpy.ndarray with the state (version, shape, dtype, is_fortran, data)."""
    _, shape, dtype, is_fortran, data = stub.state
    return _values(data, plain(dtype), shape, "F" if is_fortran else "C", plain)


def _buffer(stub: _Stub, plain: _Plain) -> np.ndarray:
    """Convert numpy's _frombuffer(data, dtype, shape, order), of protocol 5."""
    data, dtype, shape, order = stub.arguments
    return _values(data, plain(dtype), shape, _text(order), plain)


def _scalar(stub: _Stub, plain: _Plain) -> Any:
    """Convert numpy's scalar(dtype, data)."""
    return _values(stub.arguments[1], plain(stub.arguments[0]), (), "C", plain)[()]


def _chumpy(stub: _Stub, plain: _Plain) -> np.ndarray:
    """Convert chumpy.ch.Ch, an array in the attribute `x`."""
    return np.asarray(_attributes(stub, plain, "x")["x"])


def _chumpy_select(stub: _Stub, plain: _Plain) -> np.ndarray:
    """Convert chumpy.reordering.Select: the entries `idxs` of the array `a`, in a preferred shape."""
    values = _attributes(stub, plain, "a", "idxs", "preferred_shape")
    picked = np.ravel(values["a"])[np.asarray(values["idxs"], np.int64)]
    return picked.reshape(values.get("preferred_shape") or picked.shape)


def _sparse(make: Any) -> Callable[[_Stub, _Plain], Any]:
    """Return the function that converts a compressed sparse matrix."""

    def convert(stub: _Stub, plain: _Plain) -> Any:
        values = _attributes(stub, plain, "_shape", "shape", "data", "indices", "indptr")
        parts = tuple(np.asarray(values[name]) for name in ("data", "indices", "indptr"))
        array = make(parts, shape=values.get("_shape", values.get("shape")))
        array.check_format(full_check=True)
        return array

    return convert


def _values(data: Any, dtype: Any, shape: Any, order: str, plain: _Plain) -> np.ndarray:
    """Return an array in native byte order whose header and data agree."""
    if not isinstance(dtype, np.dtype):
        raise ValueError("an array has no dtype")
    if type(shape) is not tuple or not all(type(size) is int and size >= 0 for size in shape):
        raise ValueError("an array has an impossible shape")
    if dtype.kind == "O":  # accepted where the objects are numbers
        values = np.asarray([plain(item) for item in data] if type(data) is list else None)
        if values.dtype.kind not in "biuf" or values.shape != (math.prod(shape),):
            raise ValueError("an array of objects does not hold numbers")
    else:
        raw = plain(data) if isinstance(data, _Stub) else data
        raw = raw.encode("latin1") if isinstance(raw, str) else raw  # Python 2 wrote text
        if not isinstance(raw, bytes | bytearray) or math.prod(shape) * dtype.itemsize != len(raw):
            raise ValueError(f"an array of shape {shape} has other data")
        values = np.frombuffer(raw, dtype) if dtype.itemsize else np.zeros(0, dtype)
        values = values.astype(dtype.newbyteorder("="))
    return values.reshape(shape, order="F" if order == "F" else "C")


def _text(value: Any) -> str:
    """Return text, which a pickle of Python 2 may hold as bytes."""
    if not isinstance(value, str | bytes):
        raise ValueError("text is missing")
    return value.decode("latin1") if isinstance(value, bytes) else value


def _stub(convert: Callable[[_Stub, _Plain], Any]) -> type:
    """Return a class of stubs for one global."""
    return type("_Stub", (_Stub,), {"__slots__": (), "convert": convert})


_ALLOWED: dict[str, type] = {
    "copyreg._reconstructor": _Reconstructor,
    "builtins.object": _Stub,  # the base that _reconstructor names
    "builtins.bytes": _stub(_bytes),
    "_codecs.encode": _stub(_bytes),
    "collections.OrderedDict": dict,
    "numpy.dtype": _stub(_dtype),
    "numpy.ndarray": _stub(_array),
    "numpy._core.multiarray._reconstruct": _stub(_array),  # an array that gets its state later
    "numpy._core.multiarray.scalar": _stub(_scalar),
    "numpy._core.numeric._frombuffer": _stub(_buffer),
    "scipy.sparse.csc.csc_matrix": _stub(_sparse(scipy.sparse.csc_array)),
    "scipy.sparse.csr.csr_matrix": _stub(_sparse(scipy.sparse.csr_array)),
    "chumpy.ch.Ch": _stub(_chumpy),
    "chumpy.reordering.Select": _stub(_chumpy_select),
}
_RENAMED = {  # modules of Python 2, of NumPy before 2 and of SciPy since 1.8
    "copy_reg": "copyreg",
    "__builtin__": "builtins",
    "numpy.core.multiarray": "numpy._core.multiarray",
    "numpy.core.numeric": "numpy._core.numeric",
    "scipy.sparse._csc": "scipy.sparse.csc",
    "scipy.sparse._csr": "scipy.sparse.csr",
}


class _Unpickler(pickle.Unpickler):
    """Finds the stubs and nothing else."""

    def find_class(self, module_name: str, global_name: str) -> Any:
        name = f"{_RENAMED.get(module_name, module_name)}.{global_name.replace('_array', '_matrix')}"
        if name not in _ALLOWED:
            raise pickle.UnpicklingError(f"it names {module_name[:60]}.{global_name[:60]}, which is not data")
        return _ALLOWED[name]


def read_pickle(path: str | Path, *, content: str, max_bytes: int = 4 << 30) -> Any:
    """Read a pickle of plain containers, numbers and arrays, also one that Python 2 wrote.

    Args:
        path: Path of the file.
        content: What the file should hold, for messages, e.g. "garment".
        max_bytes: Size of the largest file accepted [bytes].

    Returns:
        dict, list, tuple, str, bytes, numbers, None, arrays, and sparse arrays (`csc_array`, `csr_array`). Check
        the shape of a sparse array before you make it dense: the file may claim any. A chumpy object becomes an
        array.

    Raises:
        AssetError: The file is missing, damaged or too large, or it holds anything else.
    """
    with parsing(path, content, max_bytes=max_bytes, form=" as a pickle", remedy="write it again") as file:
        data = file.read_bytes()
        _check_memo(data)
        return _plain(_Unpickler(io.BytesIO(data), encoding="latin1").load(), {})


def _check_memo(data: bytes) -> None:
    """Raise on a memo index beyond the number of opcodes: the unpickler would allocate a table of that size."""
    puts = [0]
    for count, (opcode, argument, _) in enumerate(pickletools.genops(data), 1):
        if opcode.name.endswith("PUT") and isinstance(argument, int):
            puts.append(argument - count)
    if max(puts) > 0:
        raise ValueError("a memo index beyond the number of opcodes")


def _plain(value: Any, done: dict[int, Any]) -> Any:
    """Return plain data for what the unpickler built; shared objects stay shared.

    Args:
        value: Anything that the unpickler built.
        done: Results so far by the identity of their source; None while a source is being converted.
    """
    if type(value) in _PLAIN:
        return value
    if id(value) not in done:
        done[id(value)] = None

        def plain(item: Any) -> Any:
            return _plain(item, done)

        if type(value) is dict:
            done[id(value)] = {plain(key): plain(item) for key, item in value.items()}
        elif type(value) in (list, tuple):
            done[id(value)] = type(value)(map(plain, value))
        elif isinstance(value, _Stub) and type(value) is not _Stub:
            done[id(value)] = value.convert(plain)
        else:
            raise ValueError(f"it holds a {type(value).__name__}, which is not data")
    if done[id(value)] is None:
        raise ValueError("it contains itself")
    return done[id(value)]
