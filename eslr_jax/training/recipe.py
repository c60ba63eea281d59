"""Training configurations from TOML files (host)."""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from eslr_jax.config import TrainConfig, apply_overrides, from_dict
from eslr_jax.errors import ConfigError
from eslr_jax.networks.network import describe_system
from eslr_jax.networks.registry import read_system


def load_recipe(path: str | Path, overrides: dict[str, Any] | None = None) -> TrainConfig:
    """Read a training configuration from a TOML file; see `registry.read_system` for its `model`.

    A file with `base`, the path of another one from where it is, changes that one's values. `overrides` are
    dotted keys and their values, such as {"model.refinement_steps": 4}.

    Raises:
        ConfigError: The file is missing or not TOML, or a value is unknown or impossible.
    """
    values = _read(Path(path))
    if "base" in values:
        base = Path(path).parent / str(values.pop("base"))
        values = _read(base) | values
        if "base" in values:
            raise ConfigError(f"{base} has a base of its own; give {path} the values of both")
    overrides = dict(overrides or {})
    if "model" in overrides:
        values["model"] = overrides.pop("model")
    if isinstance(values.get("model"), str):
        values["model"] = {"base": values["model"]}
    apply_overrides(values, overrides)
    if "model" not in values:
        raise ConfigError(f'{path} names no model; add model = "eslr-small" or a [model] table')
    return read_train_config(values)


def read_train_config(values: Mapping[str, Any]) -> TrainConfig:
    """Return a training configuration from plain values; a ConfigError where one is unknown or impossible."""
    return from_dict(TrainConfig, {**values, "model": read_system(values["model"])})


def describe_train_config(config: TrainConfig) -> dict[str, Any]:
    """Return a training configuration as plain values, ready for JSON; `read_train_config` reads them."""
    values = {field.name: getattr(config, field.name) for field in dataclasses.fields(config)}
    return values | {"model": describe_system(config.model)}


def _read(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text())
    except (FileNotFoundError, IsADirectoryError) as error:
        raise ConfigError(f"no config file {path}; give an existing TOML file") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} is not valid TOML: {error}") from error
