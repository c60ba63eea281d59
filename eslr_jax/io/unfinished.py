"""A simulation that was interrupted: its frames, and the options to go on with."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from eslr_jax.errors import AssetError
from eslr_jax.io.npz import check_layout, read_arrays, write_arrays
from eslr_jax.types import Trajectory

NAME = "unfinished.npz"
_FORMAT = "eslr-unfinished-3"
_ENERGY = "energy_"  # before the name of a term
_FIELDS = {
    "positions": ("f", "frames vertices 3"),
    "velocities": ("f", "frames vertices 3"),
    "friction_loads": ("f", "frames vertices"),
    "residuals": ("f", "frames"),
    "gap_bounds": ("f", "frames"),
    "iterations": ("iu", "frames"),
}
_PAIRS = "pair_demand"
_REMEDY = "start without --resume in another folder"


def write_unfinished(folder: Path, trajectory: Trajectory, options: dict[str, Any]) -> None:
    """Keep the frames of an interrupted simulation.

    Args:
        folder: Folder of the run.
        trajectory: Frames without an error, from the scene's initial state on.
        options: What was simulated, as values of JSON.

    Raises:
        AssetError: The file can't be written.
    """
    arrays = {name: np.asarray(getattr(trajectory, name)) for name in _FIELDS}
    arrays |= {_ENERGY + name: np.asarray(track) for name, track in trajectory.energies.items()}
    if trajectory.pair_demand is not None:
        arrays[_PAIRS] = np.asarray(trajectory.pair_demand)
    text = {"format": np.array(_FORMAT), "options": np.array(json.dumps(options))}
    write_arrays(folder / NAME, {**text, **arrays})


def read_unfinished(folder: Path) -> tuple[Trajectory, dict[str, Any]]:
    """Return the frames and the options of an interrupted simulation.

    Args:
        folder: Folder of the run.

    Raises:
        AssetError: The folder holds no interrupted simulation, or its file is damaged.
    """
    path = folder / NAME
    if not path.is_file():
        raise AssetError(f"{folder} holds no interrupted simulation; leave out --resume")
    arrays = read_arrays(path, content="interrupted simulation")
    if str(arrays.get("format", "")) != _FORMAT:
        raise AssetError(f"{path} was written by another version; {_REMEDY}")
    lost = [name for name in ("options", *_FIELDS) if name not in arrays]
    if lost:
        raise AssetError(f"{path} lacks {', '.join(lost)}; {_REMEDY}")
    energies = [name for name in arrays if name.startswith(_ENERGY)]
    layout = _FIELDS | dict.fromkeys(energies, ("f", "frames")) | {_PAIRS: ("iu", "frames")}
    check_layout(arrays, layout, what=str(path), remedy=_REMEDY)
    try:
        options = json.loads(str(arrays["options"]))
        if not isinstance(options, dict):
            raise ValueError("no table")
    except ValueError as error:
        raise AssetError(f"{path} is damaged: its options can't be read; {_REMEDY}") from error
    trajectory = Trajectory(
        **{name: arrays[name] for name in _FIELDS},
        energies={name.removeprefix(_ENERGY): arrays[name] for name in energies},
        pair_demand=arrays.get(_PAIRS),
        status=np.int32(0),  # pyright: ignore[reportArgumentType]
        first_bad_frame=np.int32(-1),  # pyright: ignore[reportArgumentType]
    )
    return trajectory, options
