"""Keep results that take seconds to compute on disk.

The name of an entry is a hash of its inputs and of the code that computes it, so no entry is ever out of date.
An entry appears whole or not at all: two processes may write the same one, and the last one stays. A cache that
can't be read or written costs time and nothing else.
"""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import hashlib
import os
from collections.abc import Callable
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
    "numerics.py",
    "types.py",
)

Struct = TypeVar("Struct")
_STATIC = "static"  # the array that holds the static fields of a pytree, as a Python literal


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


def cached_arrays(key: str, make: Callable[[], dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Return the arrays of an entry, named by `content_key`; make and store them if the entry is missing."""
    path = cache_folder() / f"{key}.npz"
    if path.exists():
        with contextlib.suppress(AssetError, OSError):  # damaged, or just removed: make it again
            arrays = read_arrays(path, content="cache")
            os.utime(path)
            return arrays
    arrays = make()
    write_kept(path, lambda path: write_arrays(path, arrays), MAX_ENTRIES)
    return arrays


def cached_struct(key: str, kind: type[Struct], make: Callable[[], Struct]) -> Struct:
    """Return the pytree of an entry; compute and store it if the entry is missing.

    Args:
        key: Name of the entry, from `content_key`.
        kind: Its class, a `flax.struct.dataclass`. A field of leaves holds one array, or None where that is its
            default. A static field (`pytree_node=False`) holds numbers, text, booleans, None or tuples of these.
        make: Computes the pytree.

    Returns:
        The pytree with NumPy leaves. Static fields keep their types, which JAX hashes to find compiled programs.
    """
    fields = dataclasses.fields(kind)  # type: ignore[arg-type]
    static = [field.name for field in fields if not field.metadata.get("pytree_node", True)]

    def make_arrays() -> dict[str, np.ndarray]:
        made = make()
        values = {field.name: getattr(made, field.name) for field in fields}
        text = repr({name: values.pop(name) for name in static})
        arrays = {name: np.asarray(value) for name, value in values.items() if value is not None}
        return arrays | {_STATIC: np.array(text)}

    arrays = dict(cached_arrays(key, make_arrays))
    return kind(**ast.literal_eval(str(arrays.pop(_STATIC))), **arrays)
