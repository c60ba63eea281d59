"""Read files by libraries that a damaged file may crash: each in a process of its own, which dies alone.

A reader is a script of this folder. It imports NumPy and its library alone, so that it starts at once, and gets
the file, the archive to write arrays to, and arguments. What a person must know of the file is its `sys.exit`.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from eslr_jax.errors import AssetError
from eslr_jax.files.npz import read_arrays


def read_apart(form: str, path: Path, *arguments: object) -> dict[str, np.ndarray]:
    """Return the arrays that the reader of a form, such as "alembic", wrote of a file.

    Raises:
        AssetError: The reader refused the file, failed or crashed.
    """
    script = Path(__file__).with_name(f"{form}.py")
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "arrays.npz"
        # -P: Python would look for its own modules beside the script first.
        command = [sys.executable, "-P", script, path, out, *map(str, arguments)]
        done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, errors="replace")
        if done.returncode == 0:
            return read_arrays(out, content=form)
    last = (done.stderr.strip().splitlines() or [""])[-1]
    if done.returncode == 1 and "Traceback (most recent call last)" not in done.stderr:
        raise AssetError(f"{path}: {last}")
    cause = last[:200] if done.returncode == 1 else "its reader crashed"
    raise AssetError(f"{path} is damaged or no {form} file ({cause}); export it again")
