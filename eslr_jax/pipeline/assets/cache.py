"""Keep results that take seconds to compute on disk.

The name of an entry is a hash of its inputs and of the code that computes it, so no entry is ever out of date.
An entry appears whole or not at all: two processes may write the same one, and the last one stays. A cache that
can't be read or written costs time and nothing else.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import platformdirs

from eslr_jax.files import kept

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


content_key = partial(kept.content_key, _CODE)


def cached(key: str, make: Callable[[], kept.Value], **formats: Callable[..., Any]) -> kept.Value:
    """Return an entry, named by `content_key`; make and store it if it is missing, see `kept.find`."""
    return kept.find(cache_folder() / f"{key}.npz", make, MAX_ENTRIES, **formats)
