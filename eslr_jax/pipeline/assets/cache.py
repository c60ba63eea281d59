"""Keep results that take seconds to compute on disk.

The name of an entry is a hash of its inputs and of the code that computes it, so no entry is ever out of date.
An entry appears whole or not at all: two processes may write the same one, and the last one stays. A cache that
can't be read or written costs time and nothing else.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import platformdirs

from eslr_jax.errors import AssetError
from eslr_jax.files.kept import source_hash, write_kept
from eslr_jax.files.npz import read_arrays, write_arrays

MAX_ENTRIES = 200  # a 4k garment takes 2 MB; the entries that were not used for longest go first
MAX_COMPILED = 1_000_000_000  # bytes of compiled programs; a scene takes about 3 MB
# A change in these makes every entry stale.
_CODE = (
    "mesh",
    "pose",
    "files",
    "pipeline/formats",
    "pipeline/dressing",
    "pipeline/assets/cache.py",
    "pipeline/assets/garments.py",
    "pipeline/rigs/alignment.py",
    "pipeline/rigs/rig.py",
    "simulation/archive.py",
    "numerics.py",
    "types.py",
)

Value = TypeVar("Value")
_read_arrays = partial(read_arrays, content="cache")


def user_cache() -> Path:
    """Return the folder for all caches of this user, which may not exist yet; Linux honours XDG_CACHE_HOME."""
    return platformdirs.user_cache_path("eslr-jax", appauthor=False)


def cache_folder() -> Path:
    """Return the folder for cached garments, which may not exist yet."""
    return user_cache() / "garments"


def compiled_folder() -> Path:
    """Return the folder for what commands compile, which may not exist yet."""
    return user_cache() / "compiled"


def files_of(folder: Path) -> list[tuple[float, int, Path]]:
    """Return all files below a folder by age, the oldest first: time of the last change [s], bytes, path."""
    found = []
    for file in folder.rglob("*"):
        with contextlib.suppress(OSError):  # just removed by another process
            status = file.stat()
            if file.is_file():
                found.append((status.st_mtime, status.st_size, file))
    return sorted(found)


def trim_folder(folder: Path, most: int = MAX_COMPILED) -> None:
    """Remove the oldest files of a folder until the others take so many bytes at most."""
    files = files_of(folder)
    excess = sum(size for _, size, _ in files) - most
    for _, size, file in files:
        if excess <= 0:
            return
        with contextlib.suppress(OSError):
            file.unlink()
        excess -= size


def content_key(*parts: Any) -> str:
    """Return a hash of arrays, of bytes, and of the `repr` of everything else; a path counts as its name."""
    digest = hashlib.sha256(source_hash(*_CODE))
    for part in parts:
        if isinstance(part, bytes):
            digest.update(b"b" + len(part).to_bytes(8, "little") + part)
        elif hasattr(part, "dtype"):
            array = np.ascontiguousarray(part)
            digest.update(f"a{array.dtype}{array.shape}".encode() + array.tobytes())
        else:
            digest.update(f"r{part!r}".encode())
    return digest.hexdigest()


def cached(
    key: str,
    make: Callable[[], Value],
    *,
    write: Callable[[Path, Value], None] = write_arrays,
    read: Callable[[Path], Value] = _read_arrays,
) -> Value:
    """Return an entry, named by `content_key`; make and store it if it is missing. By default it holds arrays."""
    path = cache_folder() / f"{key}.npz"
    if path.exists():
        with contextlib.suppress(AssetError, OSError):  # damaged, or just removed: make it again
            value = read(path)
            os.utime(path)
            return value
    value = make()
    write_kept(path, lambda path: write(path, value), MAX_ENTRIES)
    return value
