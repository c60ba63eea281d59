"""Checkpoints of a training run: asynchronous, rotated, never half-written."""

from __future__ import annotations

import contextlib
import itertools
import json
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import orbax.checkpoint as ocp
from jax.experimental.multihost_utils import sync_global_devices

from eslr_jax.config import TrainConfig
from eslr_jax.errors import CheckpointError, ConfigError
from eslr_jax.files.atomic import atomic_write
from eslr_jax.files.parsing import one_line
from eslr_jax.training.recipe import describe_train_config, read_train_config
from eslr_jax.training.step import TrainState

FORMAT = 1
_KEPT = 3
_LONGEST = 120  # characters of a library's message
_FOLDER = "checkpoints"


class Checkpoints:
    """The checkpoints of one output folder."""

    def __init__(self, folder: Path):
        """Open the folder, and create it."""
        options = ocp.CheckpointManagerOptions(
            max_to_keep=_KEPT, create=True, enable_async_checkpointing=True
        )
        self._manager = ocp.CheckpointManager((folder / _FOLDER).absolute(), options=options)

    def save(self, state: TrainState) -> None:
        """Start to write a checkpoint of a state, copied first; a CheckpointError where one can't be written."""
        with _explained():
            self._manager.save(int(state.step), args=ocp.args.StandardSave(_plain(state)))

    def wait(self) -> None:
        """Wait for what is being written; a CheckpointError where it could not be, as on a full disk."""
        with _explained():
            self._manager.wait_until_finished()

    def restore(self, example: TrainState) -> TrainState:
        """Return the newest checkpoint that can be read, like `example`; damaged ones are moved aside."""
        steps = sorted(self._manager.all_steps(), reverse=True)
        if not steps:
            raise CheckpointError("there is no checkpoint to resume from; start without --resume")
        abstract = jax.tree.map(ocp.utils.to_shape_dtype_struct, _plain(example))
        reasons = []
        for step in steps:
            try:
                plain = self._manager.restore(step, args=ocp.args.StandardRestore(abstract))
            except Exception as error:  # orbax, its storage and JAX have classes of their own for bad bytes
                reasons.append(f"{step}: {one_line(error)[:_LONGEST]}")
                continue
            for damaged in steps[: len(reasons)] if jax.process_index() == 0 else []:
                aside = _move_aside(Path(self._manager.directory) / str(damaged))
                warnings.warn(
                    f"checkpoint {damaged} can't be read and is now {aside}; going on from {step}",
                    stacklevel=2,
                )
            if reasons and jax.process_count() > 1:
                sync_global_devices("damaged checkpoints moved")
            self._manager.reload()
            return jax.tree.unflatten(jax.tree.structure(example), jax.tree.leaves(plain))
        raise CheckpointError(
            f"no checkpoint can be read ({'; '.join(reasons)}); they are damaged or of another version: "
            "start a new run in another folder"
        )

    def close(self) -> None:
        """Finish writing and release the folder."""
        self.wait()
        self._manager.close()


def _move_aside(checkpoint: Path) -> Path:
    """Give a checkpoint a name that is no step's, as another version may be able to read it; return the path."""
    names = (checkpoint.with_name(f"{checkpoint.name}.damaged{number or ''}") for number in itertools.count())
    return checkpoint.rename(next(path for path in names if not path.exists()))


@contextlib.contextmanager
def _explained() -> Iterator[None]:
    """Raise a CheckpointError, with a remedy, where writing fails."""
    try:
        yield
    except (OSError, ValueError) as error:
        raise CheckpointError(
            f"a checkpoint could not be written: {one_line(error)}; free some space and resume"
        ) from error


def _plain(state: TrainState) -> dict[str, Any]:
    """Return the state's leaves by number: a layout that no library's class names can break."""
    return {f"{number:05d}": leaf for number, leaf in enumerate(jax.tree.leaves(state))}


def has_checkpoint(folder: Path) -> bool:
    """Tell whether a folder holds a whole checkpoint: without one there is nothing to lose."""
    return any(path.name.isdigit() for path in (folder / _FOLDER).glob("*"))


def write_run_config(folder: Path, config: TrainConfig, earlier: Mapping[str, Any]) -> None:
    """Keep a run's configuration beside its checkpoints, and the record of the weights that it started from."""
    record = {"format": FORMAT, "train": describe_train_config(config), "earlier": dict(earlier)}
    with atomic_write(folder / "config.json") as temporary:
        temporary.write_text(json.dumps(record, indent=2))


def read_run_config(folder: Path) -> TrainConfig:
    """Return the configuration of a run; a CheckpointError where there is none, or one of a newer format."""
    path = folder / "config.json"
    try:
        record = json.loads(path.read_text())
        version, values = record["format"], record["train"]
        if not isinstance(version, int) or "model" not in values:
            raise TypeError("another layout")
    except FileNotFoundError as error:
        raise CheckpointError(f"{folder} holds no training run; start one without --resume") from error
    except (json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError) as error:
        raise CheckpointError(f"{path} is damaged; start the run again in another folder") from error
    if version > FORMAT:
        raise CheckpointError(
            f"{path} has format {version}, this version reads up to {FORMAT}; update eslr-jax"
        )
    try:
        return read_train_config(values)
    except ConfigError as error:
        raise CheckpointError(f"{path} is for another version: {error}") from error


def read_earlier(folder: Path) -> dict[str, Any]:
    """Return the training record of the weights that a run started from; empty for random ones."""
    return json.loads((folder / "config.json").read_text()).get("earlier", {})
