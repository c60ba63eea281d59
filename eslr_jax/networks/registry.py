"""Named networks, and their files: arrays in an npz archive, and the description in JSON beside it (host)."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
from flax.serialization import to_state_dict
from flax.traverse_util import flatten_dict, unflatten_dict

from eslr_jax.config import from_dict
from eslr_jax.errors import CheckpointError, ConfigError
from eslr_jax.files.atomic import atomic_write
from eslr_jax.files.npz import read_arrays, write_arrays
from eslr_jax.networks.architecture import Architecture
from eslr_jax.networks.eslr import Eslr
from eslr_jax.networks.hood import Hood
from eslr_jax.networks.network import Network, System, describe_system, find_system
from eslr_jax.networks.refinement import Refinement
from eslr_jax.networks.smoothing import Smoothing
from eslr_jax.types import Normalizer

FORMAT = 1  # raise when a reader of today could not read the file

PAPER = Eslr()
# The paper's network scaled to 1k vertices. Garments are 21 hops across at 1k, and some 60 in the paper. The
# ratio of layers to hops, and that of width to layers, are the paper's. One application a frame, HOOD's
# features, an acceleration.
SHALLOW = Eslr(
    message_passing_steps=5,
    attention_blocks=2,
    latent_size=64,
    attention_size=32,
    attention_features=110,  # floor(32 ln 32)
    remat="none",
)
SMALL = Refinement()
# HOOD's MeshGraphNet "fine15", which updates body rows.
FINE = Eslr(smoothing_steps=0, attention_blocks=0, update_body=True)


def _plain(config: Any) -> Any:
    """Return MeshGraphNet: neither smoothing nor attention."""
    return dataclasses.replace(config, smoothing_steps=0, attention_blocks=0)


MODELS: dict[str, Architecture] = {
    "eslr-15": PAPER,
    "eslr-10": dataclasses.replace(PAPER, message_passing_steps=10, attention_blocks=3),
    "lsdmp-15": dataclasses.replace(PAPER, attention_blocks=0),
    "gsa-15": dataclasses.replace(PAPER, smoothing_steps=0),
    "mgn-15": FINE,
    "mgn-48": dataclasses.replace(FINE, message_passing_steps=48),
    "hood": Hood(),
    "eslr-5": SHALLOW,
    "lsdmp-5": dataclasses.replace(SHALLOW, attention_blocks=0),
    "gsa-5": dataclasses.replace(SHALLOW, smoothing_steps=0),
    "mgn-5": _plain(SHALLOW),
    "hood-5": Hood(steps_per_stage=1, latent_size=64, remat="none"),
    "mgn-16": dataclasses.replace(_plain(SHALLOW), message_passing_steps=16),
    "eslr-small": SMALL,
    "lsdmp-small": dataclasses.replace(SMALL, attention_blocks=0),
    "gsa-small": dataclasses.replace(SMALL, smoothing_steps=0),
    "mgn-small": _plain(SMALL),
    "smooth-small": Smoothing(),
}


def read_system(values: Any) -> System:
    """Return the system that plain values describe: a name, or a table with a name as `base` and other values.

    The name is one of `MODELS`, or that of a registered system; MODULE:NAME for one's own.

    Raises:
        ConfigError: There is no such name, or an option is unknown or impossible.
    """
    if not isinstance(values, str | Mapping):
        raise ConfigError(f"the model is {values!r}; give a name or a table")
    given = {"base": values} if isinstance(values, str) else dict(values)
    name = given.pop("base", None)
    if not isinstance(name, str):
        raise ConfigError('the model has no base; add one, such as base = "eslr-small"')
    if name in MODELS:
        return from_dict(type(MODELS[name]), dataclasses.asdict(MODELS[name]) | given, where="model.")
    system = find_system(name)
    if system is None:
        raise ConfigError(
            f"unknown model {name!r}; there are {', '.join(MODELS)}, and MODULE:NAME for a class of your own, "
            'marked by @network("NAME")'
        )
    return from_dict(system, given, where="model.")


def write_network(path: str | Path, network: Network, training: dict[str, Any]) -> None:
    """Write a network to `path`, and its description to the same name with suffix .json.

    Weights are nested dictionaries of arrays, named in the file by their path as in "statistics/garment/mean".
    `training` says in plain values how the network was trained and how good it is.

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
