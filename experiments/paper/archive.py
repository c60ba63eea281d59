"""Trained networks on disk: nested arrays in an npz archive, and how they were trained beside it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict

from eslr_jax.io.npz import read_arrays, write_arrays


def write_archive(path: Path, arrays: dict[str, Any], record: dict[str, Any]) -> None:
    """Write nested arrays, and a record of plain values beside them.

    Args:
        path: Path of the archive; the record's has the suffix .json.
        arrays: Dictionaries of arrays, nested as deep as wanted; no key holds a slash.
        record: What JSON can hold.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    leaves = {"/".join(keys): np.asarray(leaf) for keys, leaf in flatten_dict(arrays).items()}
    write_arrays(path, leaves, is_compressed=True)
    path.with_suffix(".json").write_text(json.dumps(record, indent=1))


def read_archive(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the arrays and the record that `write_archive` wrote."""
    arrays = {
        tuple(name.split("/")): jnp.asarray(leaf)
        for name, leaf in read_arrays(path, content="network").items()
    }
    return unflatten_dict(arrays), json.loads(path.with_suffix(".json").read_text())
