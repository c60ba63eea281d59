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

    Args:
        path: TOML file.
        overrides: Dotted keys and their values, such as {"model.refinement_steps": 4}.

    Raises:
        ConfigError: The file is missing or not TOML, or a value is unknown or impossible.
    """
    try:
        values = tomllib.loads(Path(path).read_text())
    except (FileNotFoundError, IsADirectoryError) as error:
        raise ConfigError(f"no config file {path}; give an existing TOML file") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} is not valid TOML: {error}") from error
    overrides = dict(overrides or {})
    model = overrides.pop("model", values.get("model"))
    values["model"] = {"base": model} if isinstance(model, str) else model
    apply_overrides(values, overrides)
    model = values["model"]
    if isinstance(model, dict) and "base" in model:
        base = model.pop("base")
        if base not in MODELS:
            raise ConfigError(f"unknown model {base!r}; there are {', '.join(MODELS)}")
        values["model"] = to_dict(MODELS[base]) | model
    if not isinstance(values.get("model"), dict):
        raise ConfigError(f'{path} names no model; add model = "eslr-small" or a [model] table')
    return from_dict(TrainConfig, values)
