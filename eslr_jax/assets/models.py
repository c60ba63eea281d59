"""Load trained networks by name or by path."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any

from eslr_jax.assets.catalog import find_asset, is_path
from eslr_jax.config import ModelConfig
from eslr_jax.errors import AssetError
from eslr_jax.io.weights import read_weights

DEFAULT_MODEL = "eslr-small"  # of `eslr simulate --simulator network`
START_MODEL = "smooth-small"  # the network that was trained to give the solver an initial guess


def load_model(name: str | Path) -> tuple[dict[str, Any], ModelConfig]:
    """Load a trained network.

    Args:
        name: Name of a bundled model, or path of an exported npz file. `NAME:STEPS` changes the number of
            refinement steps per frame, for less error or less time.

    Returns:
        Its weights and its architecture.

    Raises:
        AssetError: There is no such model, it can't take so many refinement steps, or the file is damaged.
        CheckpointError: The file is for another architecture or a newer version.
    """
    (params, config, _), steps = _read_model(str(name))
    if steps is not None:
        try:
            config = dataclasses.replace(config, refinement_steps=steps)
        except ValueError as error:
            raise AssetError(f"model {name}: {error}") from error
    return params, config


def model_record(name: str | Path) -> dict[str, Any]:
    """Return how a network was trained, as its file tells; the argument is that of `load_model`."""
    return _read_model(str(name))[0][2]


def _read_model(name: str) -> tuple[tuple[dict[str, Any], ModelConfig, dict[str, Any]], int | None]:
    """Return weights, architecture and training record of a model, and the refinement steps asked for."""
    parts = re.fullmatch(r"(.+):(\d+)", name)
    model = parts[1] if parts else name
    path = Path(model) if is_path(model) else find_asset("model", model)
    return read_weights(path), int(parts[2]) if parts else None
