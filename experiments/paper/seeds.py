"""Train several seeds of a network at once.

    python experiments/paper/seeds.py --config RECIPE --seeds 0 1 2 3 --out DIR [--set KEY=VALUE ...] [--resume]

The seeds are a batch axis of one compiled step. At 1k vertices a GPU spends a step on starting kernels, and their
number does not grow with the seeds. Folder DIR/seed-S is what `eslr train --set seed=S` leaves, but for the
checkpoints: they hold all seeds and lie in DIR.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from eslr_jax.config import TrainConfig, parse_override
from eslr_jax.simulation.interrupt import Interruption
from eslr_jax.training.checkpoint import Checkpoints, write_run_config
from eslr_jax.training.data import load_training_data
from eslr_jax.training.loop import export
from eslr_jax.training.recipe import load_recipe
from eslr_jax.training.step import TrainState, init_train_state, make_train_step

AXES = TrainState(params=0, optimizer=0, pools=0, key=0, step=None, skipped=0)  # type: ignore[arg-type]


def stack_seeds(states: list[TrainState]) -> TrainState:
    """Return states of equal step as one, along a new first axis."""
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
    return stacked.replace(step=states[0].step)  # one for all: a batch of steps would be one of garments too


def take_seed(state: TrainState, place: int) -> TrainState:
    """Return one seed's state."""
    one = jax.tree.map(lambda leaf: leaf[place], state.replace(step=None))
    return one.replace(step=state.step)


def make_seeds_step(config: TrainConfig) -> Callable:
    """Return the jitted step of all seeds: (states, data) -> (states, metrics); the states are donated."""
    step = make_train_step(config, 0)
    return jax.jit(jax.vmap(step, in_axes=(AXES, None), out_axes=(AXES, 0)), donate_argnums=0)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--config", type=Path, required=True)
    parser.add_argument("--set", dest="changes", nargs="*", default=[])
    parser.add_argument("--seeds", type=int, nargs="+", required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--resume", action="store_true")
    parser.add_argument("--smoke", action="store_true", help="two steps")
    chosen = parser.parse_args()
    changes = dict(parse_override(text) for text in chosen.changes) | ({"steps": 2} if chosen.smoke else {})
    config = load_recipe(chosen.config, changes)
    train_seeds([dataclasses.replace(config, seed=seed) for seed in chosen.seeds], chosen.out, chosen.resume)


def train_seeds(configs: list[TrainConfig], out: Path, is_resumed: bool) -> None:
    """Train a network from several seeds at one resolution; an interruption writes a checkpoint first."""
    config = configs[0]
    (vertices,) = config.vertices
    data = load_training_data(config, vertices)
    state = stack_seeds([init_train_state(one, (data,)) for one in configs])
    checkpoints = Checkpoints(out)
    if is_resumed:
        state = checkpoints.restore(state)
    step = make_seeds_step(config)
    folders = [out / f"seed-{one.seed}" for one in configs]
    for folder, one in zip(folders, configs, strict=True):
        folder.mkdir(parents=True, exist_ok=True)
        write_run_config(folder, one)
    window: list[dict[str, Any]] = []
    began, spent = time.perf_counter(), time.process_time()
    with Interruption() as stop:
        stop.begin()
        for done in range(int(state.step) + 1, config.steps + 1):
            state, metrics = step(state, data)
            window.append(metrics)
            if done % config.log_every == 0:
                times = {
                    "step": done,
                    "seconds": time.perf_counter() - began,
                    "core_seconds": time.process_time() - spent,
                }
                _log(folders, jax.device_get(window), times)
                window = []
            if done % config.checkpoint_every == 0 or done == config.steps or stop.is_wanted:
                checkpoints.save(state)
            if stop.is_wanted:
                break
    checkpoints.close()
    for place, (folder, one) in enumerate(zip(folders, configs, strict=True)):
        export(take_seed(state, place), one, folder)


def _log(folders: list[Path], window: list[dict[str, np.ndarray]], times: dict[str, float]) -> None:
    """Add a line to every seed's metrics: medians, as in training of one."""
    for place, folder in enumerate(folders):
        values = {name: float(np.median([entry[name][place] for entry in window])) for name in window[0]}
        with (folder / "metrics.jsonl").open("a") as log:
            log.write(json.dumps(times | values) + "\n")


if __name__ == "__main__":
    main()
