"""Load trained networks by name or by path, and what a recipe trains them on."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any

from eslr_jax.config import TrainConfig
from eslr_jax.errors import AssetError
from eslr_jax.mesh.prepare import pad_alike
from eslr_jax.networks.network import Network
from eslr_jax.networks.registry import read_network
from eslr_jax.pipeline.assets.catalog import find_asset, is_path, split_clips
from eslr_jax.pipeline.assets.garments import load_garment
from eslr_jax.pipeline.assets.motions import load_body, load_motion
from eslr_jax.training.data import TrainingData, build_training_data

DEFAULT_MODEL = "eslr-small"  # of `eslr simulate --simulator network`
START_MODEL = "smooth-small"  # the network that was trained to give the solver an initial guess


def load_model(name: str | Path) -> Network:
    """Load a trained network.

    Args:
        name: Name of a bundled model, or path of an exported npz file. `NAME:STEPS` changes the number of
            refinement steps per frame, for less error or less time.

    Raises:
        AssetError: There is no such model, it can't take so many refinement steps, or the file is damaged.
        CheckpointError: The file is for another architecture or a newer version.
    """
    (network, _), steps = _read_model(str(name))
    if steps is None:
        return network
    try:
        return network.replace(config=dataclasses.replace(network.config, refinement_steps=steps))
    except TypeError as error:
        raise AssetError(f"model {name}: it has no refinement steps; leave out :{steps}") from error
    except ValueError as error:
        raise AssetError(f"model {name}: {error}") from error


def model_record(name: str | Path) -> dict[str, Any]:
    """Return how a network was trained, as its file tells; the argument is that of `load_model`."""
    return _read_model(str(name))[0][1]


def _read_model(name: str) -> tuple[tuple[Network, dict[str, Any]], int | None]:
    """Return a network, its training record, and the refinement steps asked for."""
    parts = re.fullmatch(r"(.+):(\d+)", name)
    model = parts[1] if parts else name
    path = Path(model) if is_path(model) else find_asset("model", model)
    return read_network(path), int(parts[2]) if parts else None


def load_training_data(config: TrainConfig, vertices: str) -> TrainingData:
    """Load the garments at one resolution and the clips of a training run.

    Raises:
        ConfigError: The split is unknown or empty.
        AssetError: A garment does not exist.
    """
    options = getattr(config.model, "garment_options", {})
    unpadded = [load_garment(name, vertices=vertices, **options) for name in config.garments]  # type: ignore[arg-type]
    motions = [load_motion(clip) for clip in split_clips(config.split)]
    return build_training_data(pad_alike(unpadded), load_body(), motions, has_shapes=config.shape_range > 0)
