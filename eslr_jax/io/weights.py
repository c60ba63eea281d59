"""Read and write network weights: arrays in an npz archive, and the configuration in JSON beside it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from eslr_jax.config import ModelConfig, from_dict, to_dict
from eslr_jax.errors import CheckpointError, ConfigError
from eslr_jax.io.atomic import atomic_write
from eslr_jax.io.npz import read_arrays, write_arrays

FORMAT = 1  # increase when older versions can no longer read the file


def write_weights(
    path: str | Path, params: Mapping[str, Any], config: ModelConfig, training: dict[str, Any]
) -> None:
    """Write a network to an npz file, and to a JSON file of the same name.

    Args:
        path: Path of the npz file.
        params: Weights, a nested dict of arrays.
        config: Architecture of the network.
        training: Record of how the network was trained and how good it is; values of JSON.

    Raises:
        AssetError: A file can't be written.
    """
    path = Path(path)
    write_arrays(path, dict(_flatten(params)), is_compressed=True)
    record = {"format": FORMAT, "model": to_dict(config), "training": training}
    with atomic_write(path.with_suffix(".json")) as temporary:
        temporary.write_text(json.dumps(record, indent=2))


def read_weights(path: str | Path) -> tuple[dict[str, Any], ModelConfig, dict[str, Any]]:
    """Read a network that `write_weights` wrote.

    Args:
        path: Path of the npz file.

    Returns:
        Weights as a nested dict of arrays, the architecture, and the training record.

    Raises:
        AssetError: The archive is missing or damaged.
        CheckpointError: The JSON is missing, damaged, or of a newer format.
    """
    path = Path(path)
    try:
        record = json.loads(path.with_suffix(".json").read_text())
        version, values, training = record["format"], record["model"], record["training"]
    except FileNotFoundError as error:
        raise CheckpointError(f"{path} has no {path.stem}.json beside it; copy both files") from error
    except (json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError) as error:
        raise CheckpointError(f"{path.with_suffix('.json')} is damaged; export the model again") from error
    if not isinstance(values, dict) or not isinstance(version, int):
        raise CheckpointError(f"{path.with_suffix('.json')} is damaged; export the model again")
    if version > FORMAT:
        raise CheckpointError(
            f"{path} has format {version}, this version reads up to {FORMAT}; update eslr-jax"
        )
    try:
        config = from_dict(ModelConfig, values)
    except ConfigError as error:
        raise CheckpointError(f"{path} is for another architecture: {error}") from error
    return _unflatten(read_arrays(path, content="model")), config, training


def _flatten(tree: Mapping[str, Any], prefix: str = ""):
    for key, value in tree.items():
        if isinstance(value, Mapping):
            yield from _flatten(value, f"{prefix}{key}/")
        else:
            yield f"{prefix}{key}", np.asarray(value)


def _unflatten(arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    tree: dict[str, Any] = {}
    for name, value in arrays.items():
        *parents, leaf = name.split("/")
        node = tree
        for parent in parents:
            node = node.setdefault(parent, {})
        node[leaf] = jnp.asarray(value, jnp.float32 if value.dtype.kind == "f" else value.dtype)
    return tree
