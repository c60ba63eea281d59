"""Files that save time and may be missing: their names hold a hash of the source, and the oldest ones go."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Callable
from functools import cache
from pathlib import Path

from eslr_jax.errors import AssetError


@cache
def source_hash(*names: str) -> bytes:
    """Return a hash of the package's source, or of some files and folders of it."""
    package, digest = Path(__file__).resolve().parents[1], hashlib.sha256()
    for path in [package / name for name in names] or [package]:
        for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            digest.update(file.read_bytes())
    return digest.digest()


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
