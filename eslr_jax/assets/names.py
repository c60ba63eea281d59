"""Names of assets: a bundled name or a path."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from eslr_jax.errors import AssetError


def is_path(name: str) -> bool:
    """Tell a path from a name: it has a separator or a suffix, or is a file.

    A folder is none, such as the one of a run that has the name of its garment.
    """
    return "/" in name or "\\" in name or Path(name).suffix != "" or Path(name).is_file()


def unknown_suffix(content: str, file: str | Path, known: Iterable[str]) -> AssetError:
    """Return the error for a file of an unknown kind."""
    suffix = Path(file).suffix.lower()
    if suffix == ".fbx":
        return AssetError(
            f"{content} file {file}: FBX is not read; export it as glTF (in Blender: File > Export > glTF 2.0)"
        )
    return AssetError(
        f"{content} file {file} has the unknown suffix {suffix!r}; give one of {', '.join(known)}"
    )
