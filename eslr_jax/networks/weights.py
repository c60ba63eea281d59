"""Read and write networks: arrays in an npz archive, and the description in JSON beside it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jax.numpy as jnp
from flax.serialization import to_state_dict
from flax.traverse_util import flatten_dict, unflatten_dict

from eslr_jax.errors import CheckpointError, ConfigError
from eslr_jax.files.atomic import atomic_write
from eslr_jax.files.npz import read_arrays, write_arrays
from eslr_jax.networks.network import Network, describe_system
from eslr_jax.networks.registry import read_system
from eslr_jax.types import Normalizer

FORMAT = 1  # raise when a reader of today could not read the file


def write_network(path: str | Path, network: Network, training: dict[str, Any]) -> None:
    """Write a network to `path`, and its description to the same name with suffix .json.

    Args:
        path: The npz file to write. Arrays are named by their path, as in "statistics/garment/mean".
        network: Its weights are nested dictionaries of arrays.
        training: How the network was trained and how good it is; plain values.

    Raises:
        AssetError: A file can't be written.
        ConfigError: The network's system has no registered name.
    """
    path = Path(path)
    record = {"format": FORMAT, "model": describe_system(network.config), "training": training}
    with atomic_write(path.with_suffix(".json")) as temporary:
        temporary.write_text(json.dumps(record, indent=2))
    # The archive is written last, so that an archive never stands without its description.
    write_arrays(path, flatten_dict(to_state_dict(network.parts), sep="/"), is_compressed=True)


def read_network(path: str | Path) -> tuple[Network, dict[str, Any]]:
    """Read a network that `write_network` wrote, and its training record.

    Raises:
        AssetError: The archive is missing or damaged.
        CheckpointError: The JSON is missing, damaged, of a newer format, or asks for what this version lacks; or
            the weights do not fit it.
    """
    path = Path(path)
    try:
        record = json.loads(path.with_suffix(".json").read_text())
        version, values, training = int(record["format"]), dict(record["model"]), record["training"]
    except FileNotFoundError as error:
        raise CheckpointError(f"{path} has no {path.stem}.json beside it; copy both files") from error
    except (ValueError, KeyError, TypeError) as error:
        raise CheckpointError(f"{path.with_suffix('.json')} is damaged; export the model again") from error
    if version > FORMAT:
        raise CheckpointError(
            f"{path} has format {version}, this version reads up to {FORMAT}; update eslr-jax"
        )
    try:
        system = read_system(values)
    except ConfigError as error:
        raise CheckpointError(f"{path} is for another architecture: {error}") from error
    floats = {
        name: jnp.asarray(value, jnp.float32 if value.dtype.kind == "f" else value.dtype)
        for name, value in read_arrays(path, content="model").items()
    }
    try:
        tree = {"params": {}} | unflatten_dict(floats, sep="/")
        statistics = tree.pop("statistics", {})
        tree["statistics"] = {name: Normalizer(**fields) for name, fields in statistics.items()}
    except (AttributeError, IndexError, TypeError) as error:
        raise CheckpointError(f"{path} holds no tree of weights; export the model again") from error
    network = Network(config=system, **tree)
    system.check(network)
    return network, training
