"""Read and write network weights: arrays in an npz archive, and the configuration in JSON beside it."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from eslr_jax.config import ModelConfig, from_dict, to_dict
from eslr_jax.errors import CheckpointError, ConfigError
from eslr_jax.io.atomic import atomic_write
from eslr_jax.io.npz import read_arrays, write_arrays
from eslr_jax.types import Normalizer

FORMAT = 1  # raise when a reader of today could not read the file
# Options of earlier versions, each with the only value that networks still have.
FROZEN = {"residual": True, "readd_edges": True, "smooth_world_edges": True, "world_edge_capacity": None}


def write_weights(
    path: str | Path, params: Mapping[str, Any], config: ModelConfig, training: dict[str, Any]
) -> None:
    """Write a network to `path`, and its description to the same name with suffix .json.

    Args:
        path: The npz file to write.
        params: Weights: nested dictionaries of arrays and normalisers. Arrays are named by their path,
            as in "statistics/garment/mean".
        config: Architecture.
        training: How the network was trained and how good it is; plain values.

    Raises:
        AssetError: A file can't be written.
    """
    path = Path(path)
    record = {"format": FORMAT, "model": to_dict(config), "training": training}
    with atomic_write(path.with_suffix(".json")) as temporary:
        temporary.write_text(json.dumps(record, indent=2))
    # Last, since it is by the archive that a network is taken for written.
    write_arrays(path, dict(_flatten(params)), is_compressed=True)


def read_weights(path: str | Path) -> tuple[dict[str, Any], ModelConfig, dict[str, Any]]:
    """Read a network that `write_weights` wrote.

    Args:
        path: The npz file; the JSON file lies beside it.

    Returns:
        Weights, architecture, and the training record.

    Raises:
        AssetError: The archive is missing or damaged.
        CheckpointError: The JSON is missing, damaged, of a newer format, or asks for what this version lacks.
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
        config = from_dict(ModelConfig, without_frozen(values))
    except ConfigError as error:
        raise CheckpointError(f"{path} is for another architecture: {error}") from error
    return _unflatten(read_arrays(path, content="model"), path), config, training


def without_frozen(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a `ModelConfig` of an earlier version, without the options that no longer exist.

    Raises:
        ConfigError: Such an option has a value other than the one that remains.
    """
    for name, only in FROZEN.items():
        if name in values and values[name] != only:
            raise ConfigError(
                f"{name} = {json.dumps(values[name])} is no longer an option, networks have "
                f"{json.dumps(only)}; train the model again"
            )
    return {name: value for name, value in values.items() if name not in FROZEN}


def _flatten(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, np.ndarray]]:
    """Yield the path and the array of every leaf."""
    for key, value in tree.items():
        if isinstance(value, Normalizer):
            value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
        if isinstance(value, Mapping):
            yield from _flatten(value, f"{prefix}{key}/")
        else:
            yield f"{prefix}{key}", np.asarray(value)


def _unflatten(arrays: Mapping[str, np.ndarray], path: Path) -> dict[str, Any]:
    """Return nested dictionaries of arrays by path, with normalisers under "statistics".

    Raises:
        CheckpointError: The names don't form a tree of weights.
    """
    tree: dict[str, Any] = {"statistics": {}}
    try:
        for name, value in arrays.items():
            *parents, leaf = name.split("/")
            node = tree
            for parent in parents:
                node = node.setdefault(parent, {})
            node[leaf] = jnp.asarray(value, jnp.float32 if value.dtype.kind == "f" else value.dtype)
        tree["statistics"] = {name: Normalizer(**fields) for name, fields in tree["statistics"].items()}
    except (AttributeError, TypeError) as error:
        raise CheckpointError(f"{path} holds no tree of weights; export the model again") from error
    return tree
