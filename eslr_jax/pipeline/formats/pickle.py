"""Read pickles of other projects as data: nothing that a file names is imported or called.

A pickle may name only the globals in `_ALLOWED`. Each becomes an inert stub that keeps its arguments and its
state. Stubs turn into NumPy and SciPy arrays after all of their numbers were checked.
"""

from __future__ import annotations

import io
import math
import pickle
import pickletools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse

from eslr_jax.files.parsing import parsing

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


class _OrderedDict(dict):
    """collections.OrderedDict; attributes, such as those of PyTorch's weights, are no content and are dropped."""

    def __setstate__(self, state: Any) -> None:
        pass


class _Reconstructor(_Stub):
    """copyreg._reconstructor(class, base, state): an object in protocols 0 and 1."""

    def __new__(cls, *arguments: Any) -> Any:
        if not arguments or not (isinstance(arguments[0], type) and issubclass(arguments[0], _Stub)):
            raise pickle.UnpicklingError("it rebuilds an object of an unknown class")
        return arguments[0]()


def make_stub(convert: Callable[[Any, _Plain], Any]) -> type:
    """Return a class of stubs for one global.

    `convert` makes plain data of a stub, with its `arguments` and `state`; its second argument does so for what
    they hold.
    """
    return type("_Stub", (_Stub,), {"__slots__": (), "convert": convert})


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


_ALLOWED: dict[str, type] = {
    "copyreg._reconstructor": _Reconstructor,
    "builtins.object": _Stub,  # the base that _reconstructor names
    "builtins.bytes": make_stub(_bytes),
    "_codecs.encode": make_stub(_bytes),
    "collections.OrderedDict": _OrderedDict,
    "numpy.dtype": make_stub(_dtype),
    "numpy.ndarray": make_stub(_array),
    "numpy._core.multiarray._reconstruct": make_stub(_array),  # an array that gets its state later
    "numpy._core.multiarray.scalar": make_stub(  # scalar(dtype, data)
        lambda stub, plain: _values(stub.arguments[1], plain(stub.arguments[0]), (), "C", plain)[()]
    ),
    "numpy._core.numeric._frombuffer": make_stub(_buffer),
    "scipy.sparse.csc.csc_matrix": make_stub(_sparse(scipy.sparse.csc_array)),
    "scipy.sparse.csr.csr_matrix": make_stub(_sparse(scipy.sparse.csr_array)),
    "chumpy.ch.Ch": make_stub(lambda stub, plain: np.asarray(_attributes(stub, plain, "x")["x"])),
    "chumpy.reordering.Select": make_stub(_chumpy_select),
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

    def __init__(self, data: bytes, stubs: Mapping[str, type], find_persistent: Callable[[Any], Any] | None):
        super().__init__(io.BytesIO(data), encoding="latin1")
        self._stubs, self._find_persistent = stubs, find_persistent

    def find_class(self, module_name: str, global_name: str) -> Any:
        name = f"{_RENAMED.get(module_name, module_name)}.{global_name.replace('_array', '_matrix')}"
        if name not in self._stubs:
            raise pickle.UnpicklingError(f"it names {module_name[:60]}.{global_name[:60]}, which is not data")
        return self._stubs[name]

    def persistent_load(self, pid: Any) -> Any:
        if self._find_persistent is None:
            raise pickle.UnpicklingError("it names data outside of the file")
        return self._find_persistent(pid)


def read_pickle(path: str | Path, *, content: str, max_bytes: int = 4 << 30) -> Any:
    """Read a pickle of plain containers, numbers and arrays, also one that Python 2 wrote.

    Returns:
        dict, list, tuple, str, bytes, numbers, None, arrays, and sparse arrays (`csc_array`, `csr_array`). Check
        the shape of a sparse array before you make it dense: the file may claim any. A chumpy object becomes an
        array.

    Raises:
        AssetError: The file is missing, damaged or too large, or it holds anything else.
    """
    with parsing(path, content, max_bytes=max_bytes, form=" as a pickle", remedy="write it again") as file:
        return unpickle(file.read_bytes())


def unpickle(
    data: bytes,
    *,
    stubs: Mapping[str, type] | None = None,
    find_persistent: Callable[[Any], Any] | None = None,
) -> Any:
    """Return the content of a pickle as plain data, see `read_pickle`; for `parsing`: it raises anything.

    `stubs` are further globals that it may name, as `module.name`, each with its class of `make_stub`. Where the
    pickle may refer to data outside of it, `find_persistent` returns the stub for a persistent id.
    """
    puts = (
        argument - count
        for count, (opcode, argument, _) in enumerate(pickletools.genops(data), 1)
        if opcode.name.endswith("PUT") and isinstance(argument, int)
    )
    if max(puts, default=0) > 0:  # the unpickler would allocate a table of that size
        raise ValueError("a memo index beyond the number of opcodes")
    return _plain(_Unpickler(data, {**_ALLOWED, **(stubs or {})}, find_persistent).load(), {})


def _plain(value: Any, done: dict[int, Any]) -> Any:
    """Return plain data for what the unpickler built; shared objects stay shared.

    `done` holds results by the identity of their source; None while a source is being converted.
    """
    if type(value) in _PLAIN:
        return value
    if id(value) not in done:
        done[id(value)] = None

        def plain(item: Any) -> Any:
            return _plain(item, done)

        if type(value) in (dict, _OrderedDict):
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
