"""Training configurations from TOML files (host)."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from eslr_jax.config import TrainConfig, apply_overrides, from_dict, to_dict
from eslr_jax.errors import ConfigError
from eslr_jax.models.registry import MODELS


def load_recipe(path: str | Path, overrides: dict[str, Any] | None = None) -> TrainConfig:
    """Read a training configuration; `model` is a table, a name, or a table with a `base` name.

    A file with `base`, the path of another one from where it is, changes that one's values.

    Args:
        path: TOML file.
        overrides: Dotted keys and their values, such as {"model.refinement_steps": 4}.

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
    model = values.get("model")
    if isinstance(model, dict) and "base" in model:
        base = model.pop("base")
        if base not in MODELS:
            raise ConfigError(f"unknown model {base!r}; there are {', '.join(MODELS)}")
        values["model"] = to_dict(MODELS[base]) | model
    if not isinstance(values.get("model"), dict):
        raise ConfigError(f'{path} names no model; add model = "eslr-small" or a [model] table')
    return from_dict(TrainConfig, values)


def _read(path: Path) -> dict[str, Any]:
    """Return the values of a TOML file.

    Raises:
        ConfigError: The file is missing or not TOML.
    """
    try:
        return tomllib.loads(path.read_text())
    except (FileNotFoundError, IsADirectoryError) as error:
        raise ConfigError(f"no config file {path}; give an existing TOML file") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} is not valid TOML: {error}") from error
