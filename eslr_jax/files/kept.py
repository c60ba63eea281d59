"""Files that save time and may be missing: their names hold a hash of the source, and the oldest ones go."""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np

from eslr_jax.errors import AssetError
from eslr_jax.files.npz import read_arrays, write_arrays

Value = TypeVar("Value")
_read_arrays = partial(read_arrays, content="cache")


@cache
def source_hash(*names: str) -> bytes:
    """Return a hash of the package's source, or of some files and folders of it."""
    package, digest = Path(__file__).resolve().parents[1], hashlib.sha256()
    for path in [package / name for name in names] or [package]:
        for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            digest.update(file.read_bytes())
    return digest.digest()


def path_of(kind: str, name: str) -> Path | None:
    """Return where a file is kept: beside JAX's compiled programs; None where those are in no folder."""
    folder = jax.config.jax_compilation_cache_dir
    if folder is None or "://" in folder:  # JAX also takes the address of a bucket
        return None
    return Path(folder) / kind / name


def content_key(code: Sequence[str], *parts: Any) -> str:
    """Return a hash of files and folders of the package, see `source_hash`, and of what a result is made from.

    Of arrays and bytes all counts, of everything else its `repr`; of a path its name.
    """
    digest = hashlib.sha256(source_hash(*code))
    for part in parts:
        if isinstance(part, bytes):
            digest.update(b"b" + len(part).to_bytes(8, "little") + part)
        elif hasattr(part, "dtype"):
            array = np.ascontiguousarray(part)
            digest.update(f"a{array.dtype}{array.shape}".encode() + array.tobytes())
        else:
            digest.update(f"r{part!r}".encode())
    return digest.hexdigest()


def find(
    path: Path | None,
    make: Callable[[], Value],
    most: int,
    *,
    write: Callable[[Path, Value], None] = write_arrays,
    read: Callable[[Path], Value] = _read_arrays,
) -> Value:
    """Return what a file holds, by default arrays; make and store it if it is missing. Without a path make it."""
    if path is None:
        return make()
    if path.exists():
        with contextlib.suppress(AssetError, OSError):  # damaged, or just removed: make it again
            value = read(path)
            os.utime(path)
            return value
    value = make()
    write_kept(path, lambda path: write(path, value), most)
    return value


def write_kept(path: Path, write: Callable[[Path], None], most: int) -> None:
    """Write a file, and remove those of its kind that were not used for longest, until so many are left.

    A folder that can't be written costs time alone.
    """
    with contextlib.suppress(AssetError, OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        write(path)
        entries = sorted(path.parent.glob(f"*{path.suffix}"), key=lambda entry: entry.stat().st_mtime)
        for oldest in entries[:-most]:
            oldest.unlink(missing_ok=True)
