"""Names of assets: a bundled name or a path."""

from __future__ import annotations

from pathlib import Path


def is_path(name: str) -> bool:
    """Tell a path from a name: it has a separator or a suffix, or is a file.

    A folder is none, such as the one of a run that has the name of its garment.
    """
    return "/" in name or "\\" in name or Path(name).suffix != "" or Path(name).is_file()
