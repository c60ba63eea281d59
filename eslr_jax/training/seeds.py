"""Several seeds of a run as a batch axis of one compiled step.

At 1k vertices a GPU spends a step on starting kernels, and their number does not grow with the seeds.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp

from eslr_jax.config import TrainConfig
from eslr_jax.training.step import TrainState, make_train_step

_AXES = TrainState(network=0, optimizer=0, pools=0, key=0, step=None, skipped=0)  # type: ignore[arg-type]


def seed_configs(config: TrainConfig) -> list[TrainConfig]:
    """Return the run of each seed alone."""
    return [dataclasses.replace(config, seed=config.seed + k, seeds=1) for k in range(config.seeds)]


def seed_folders(config: TrainConfig, out: Path) -> list[Path]:
    """Return where metrics and network of each seed lie: `out`, or with several seeds a folder for each."""
    if config.seeds == 1:
        return [out]
    return [out / f"seed-{one.seed}" for one in seed_configs(config)]


def stack_seeds(states: list[TrainState]) -> TrainState:
    """Return states of equal step as one, along a new first axis."""
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
    return stacked.replace(step=states[0].step)  # one for all: a batch of steps would be one of garments too


def take_seed(state: TrainState, place: int) -> TrainState:
    """Return one seed's state."""
    one = jax.tree.map(lambda leaf: leaf[place], state.replace(step=None))
    return one.replace(step=state.step)


def make_seeds_step(config: TrainConfig, resolution: int) -> Callable:
    """Return the jitted step of all seeds: (states, data) -> (states, metrics); the states are donated.

    Args:
        config: The run.
        resolution: Index of the pool and of the data that the step works on.
    """
    step = jax.vmap(make_train_step(config, resolution), in_axes=(_AXES, None), out_axes=(_AXES, 0))
    return jax.jit(step, donate_argnums=0)
