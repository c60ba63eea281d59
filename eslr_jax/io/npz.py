"""Arrays in a NumPy archive, written whole and read with suspicion."""

from __future__ import annotations

import contextlib
import math
import os
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np

from eslr_jax.errors import AssetError
from eslr_jax.io.atomic import atomic_write
from eslr_jax.io.parsing import one_line

# What the standard library and NumPy raise from the bytes of a damaged archive.
_DAMAGE = (
    ValueError,
    EOFError,
    KeyError,
    TypeError,
    RuntimeError,
    MemoryError,
    SyntaxError,
    zlib.error,
    struct.error,
    tokenize.TokenError,
)


def write_arrays(path: str | Path, arrays: Mapping[str, np.ndarray], *, is_compressed: bool = False) -> None:
    """Write named arrays as an npz archive, atomically.

    Args:
        path: The file to write.
        arrays: Name -> array.
        is_compressed: Deflate the members: smaller, several times slower.

    Raises:
        AssetError: If the file can't be written.
    """
    save = np.savez_compressed if is_compressed else np.savez
    with atomic_write(path) as temporary, temporary.open("wb") as stream:
        save(stream, **{name: np.asarray(array) for name, array in arrays.items()})  # pyright: ignore[reportArgumentType]


def read_arrays(
    path: str | Path, *, content: str, names: Collection[str] | None = None, max_bytes: int = 16 << 30
) -> dict[str, np.ndarray]:
    """Read arrays of an npz archive, without unpickling and without trusting its headers.

    Args:
        path: The file to read.
        content: What the file should be, for messages, e.g. "trajectory".
        names: Read only these, where they are there; None reads all.
        max_bytes: Largest unpacked size accepted [bytes].

    Returns:
        Name -> array.

    Raises:
        AssetError: If the file is missing, truncated, damaged, larger than `max_bytes`, or no npz archive.
    """
    with _readable(path, content), zipfile.ZipFile(path) as archive:
        members = {member.removesuffix(".npy"): member for member in archive.namelist()}
        if names is not None:
            members = {name: member for name, member in members.items() if name in names}
        total = sum(archive.getinfo(member).file_size for member in members.values())
        if total > max_bytes:
            raise AssetError(
                f"{content} file {path} unpacks to {total} bytes, more than {max_bytes}; check the file"
            )
        return {name: _read_member(archive, member) for name, member in members.items()}


@contextlib.contextmanager
def _readable(path: str | Path, content: str) -> Iterator[None]:
    """Turn every way in which an archive can be broken into one named error."""
    if not os.path.exists(path):
        raise AssetError(f"{content} file {path} doesn't exist; check the path")
    try:
        yield
    except zipfile.BadZipFile as error:
        raise AssetError(
            f"{content} file {path} is not an npz archive or is truncated; write it again"
        ) from error
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise AssetError(f"{content} file {path} can't be read: {reason}; check the path") from error
    except _DAMAGE as error:
        raise AssetError(f"{content} file {path} is damaged ({one_line(error)}); write it again") from error


def _read_member(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    """Read one array after checking that its header agrees with its size."""
    size = archive.getinfo(name).file_size
    with archive.open(name) as stream:
        shape, dtype = _read_header(stream)
        expected = math.prod(shape) * dtype.itemsize
        if dtype.hasobject or expected > size:
            raise ValueError(f"array {name} has an impossible header")
    with archive.open(name) as stream:
        return np.lib.format.read_array(stream, allow_pickle=False)


def _read_header(stream: IO[bytes]) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Read the shape and dtype of an npy stream."""
    version = np.lib.format.read_magic(stream)
    if version == (1, 0):
        shape, _, dtype = np.lib.format.read_array_header_1_0(stream)
    else:
        shape, _, dtype = np.lib.format.read_array_header_2_0(stream)
    return shape, dtype
