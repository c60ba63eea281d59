"""The training loop: steps, metrics, checkpoints, and what happens when something goes wrong (host)."""

from __future__ import annotations

import ctypes
import dataclasses
import json
import math
import os
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils

from eslr_jax.config import TrainConfig
from eslr_jax.errors import CheckpointError, ConfigError, NonFiniteError
from eslr_jax.files.atomic import atomic_write, ensure_output_dir
from eslr_jax.networks.network import Network
from eslr_jax.networks.registry import write_network
from eslr_jax.simulation.interrupt import Interruption
from eslr_jax.training.checkpoint import (
    Checkpoints,
    has_checkpoint,
    read_earlier,
    read_run_config,
    write_run_config,
)
from eslr_jax.training.data import TrainingData
from eslr_jax.training.step import TrainState, init_train_state, make_mesh, make_train_step, replicate

_AXES = TrainState(network=0, optimizer=0, pools=0, key=0, step=None, skipped=0)  # type: ignore[arg-type]
_ARENA_MAX, _MMAP_MAX, _TRIM_THRESHOLD, _TOP_PAD = -8, -4, -1, -2  # of glibc's malloc.h
_DRAWN = ("stretch", "bending", "inertia", "collision", "friction")  # terms
_SHARES = ("resets", "skipped")  # shares of the trajectories of a step

Progress = Callable[[int, int, dict[str, float]], None]


def train(
    config: TrainConfig,
    out: Path,
    *,
    resume: bool = False,
    initial: Network | None = None,
    earlier: Mapping[str, Any] | None = None,
    datasets: tuple[TrainingData, ...],
    on_progress: Progress = lambda done, total, metrics: None,
    most_seconds: float = math.inf,
) -> TrainState:
    """Train a network, or go on with a run.

    The folder is made when everything has been checked, and gets a checkpoint before anything is compiled: from
    then on a run resumes wherever it is stopped.

    Args:
        config: The run. A run that is resumed may have more `steps` than before.
        out: Folder of metrics, checkpoints and, at the end, the exported model.
        resume: Go on from the newest checkpoint of `out`.
        initial: Network whose weights to start from instead of random ones.
        earlier: Training record of that network, whose steps and core-hours the exported one counts too. A run
            that is resumed knows it.
        datasets: Of `build_training_data`, one per resolution.
        on_progress: Called with steps done, steps in all, and the latest line of metrics of the first seed.
        most_seconds: Of clock time after which this part of the run ends with a checkpoint, as by Ctrl-C; of one
            process.

    Returns:
        The last state; of several seeds stacked, see `stack_seeds`.

    Raises:
        CheckpointError: `out` holds another run, or none to resume; or `initial` does not fit `config.model`.
        ConfigError: Several seeds would be spread over devices, or several processes would end by their clocks.
        NonFiniteError: Too many updates in a row had to be skipped; the last good checkpoint is kept.
    """
    mesh = make_mesh(config)
    if config.seeds > 1 and mesh is not None:
        raise ConfigError(f"seeds = {config.seeds} share one device; take batch_size = 1, or seeds = 1")
    if most_seconds < math.inf and jax.process_count() > 1:
        raise ConfigError("processes have clocks of their own; leave out --minutes, and end them by SIGTERM")
    _check_run(config, out, resume)
    if initial is not None:
        config.model.check(initial)
    state = _first_state(config, datasets, initial)
    datasets, state = tuple(replicate(data, mesh) for data in datasets), replicate(state, mesh)
    checkpoints = Checkpoints(ensure_output_dir(out))
    folders = [ensure_output_dir(folder) for folder in seed_folders(config, out)]
    if resume:
        state = checkpoints.restore(state)
    for folder in folders:
        _forget_after(folder / "metrics.jsonl", int(state.step))
    earlier = read_earlier(out) if resume else dict(earlier or {})
    if is_first_process():
        write_run_config(out, config, earlier)
    if not resume:
        checkpoints.save(state)
        checkpoints.wait()
    step_functions = [
        make_seeds_step(config, resolution) if config.seeds > 1 else make_train_step(config, resolution, mesh)
        for resolution in range(len(datasets))
    ]
    window: list[dict[str, jax.Array]] = []
    began, first = time.perf_counter(), int(state.step)
    spent = core_seconds(folders[0]) - time.process_time()
    with ExitStack() as stack:
        name = "metrics.jsonl" if is_first_process() else os.devnull  # which is no file of the folder
        logs = [stack.enter_context((folder / name).open("a")) for folder in folders]
        stop = stack.enter_context(Interruption())
        for step in range(first, config.steps):
            resolution = step % len(step_functions)
            state, metrics = step_functions[resolution](state, datasets[resolution])
            # Once all is compiled there are steps to lose. jax.distributed has the signals of several processes.
            if step - first == len(step_functions) - 1 and jax.process_count() == 1:
                stop.begin()
            window.append(metrics)
            done = step + 1
            if done % config.log_every == 0 or done == config.steps:
                seconds = time.perf_counter() - began
                shared = {"step": done, "seconds": seconds, "core_seconds": spent + time.process_time()}
                shared["its"] = (done - first) / seconds
                records = [shared | own for own in window_metrics(window, len(folders))]
                window = []
                for log, record in zip(logs, records, strict=True):
                    log.write(json.dumps(record) + "\n")
                    log.flush()
                on_progress(done, config.steps, records[0])
                _check_skipped(state, config, checkpoints, out, earlier)
            if done % config.checkpoint_every == 0 or done == config.steps:
                checkpoints.save(state)
            is_stopping = stop.is_wanted or time.perf_counter() - began > most_seconds
            if jax.process_count() > 1:  # several stop after the same step, as jax.distributed agrees on
                is_stopping = multihost_utils.reached_preemption_sync_point(done)
            if is_stopping:
                if done % config.checkpoint_every:
                    checkpoints.save(state)
                break
    checkpoints.close()
    if int(state.step) >= config.steps:
        export(state, config, [folder / "model.npz" for folder in folders], earlier)
    return state


def _first_state(
    config: TrainConfig, datasets: tuple[TrainingData, ...], initial: Network | None
) -> TrainState:
    states = [init_train_state(one, datasets) for one in seed_configs(config)]
    if initial is not None:  # copies, since a step donates its state
        initial = initial.replace(config=config.model)
        states = [state.replace(network=jax.tree.map(jnp.array, initial)) for state in states]
    return stack_seeds(states) if config.seeds > 1 else states[0]


def export(state: TrainState, config: TrainConfig, paths: list[Path], earlier: Mapping[str, Any]) -> None:
    """Write the networks of a run, one a seed, as npz and JSON; see `train` for `earlier`."""
    if not is_first_process():
        return
    for place, path in enumerate(paths):
        own = take_seed(state, place) if config.seeds > 1 else state
        training = {
            "steps": earlier.get("steps", 0) + int(own.step),
            "garments": config.garments,
            "vertices": config.vertices,
        }
        if not earlier or "core_hours" in earlier:  # else nobody knows how long it took in all
            hours = core_seconds(path.parent) / 3600 / config.seeds  # seeds share the run
            training["core_hours"] = earlier.get("core_hours", 0.0) + hours
        write_network(path, jax.device_get(own.network), training)


def core_seconds(out: Path) -> float:
    """Return the processor time that a run has taken so far, summed over cores and resumptions [s]."""
    metrics = out / "metrics.jsonl"
    lines = metrics.read_text().splitlines() if metrics.exists() else []
    return json.loads(lines[-1]).get("core_seconds", 0.0) if lines else 0.0


def _check_run(config: TrainConfig, out: Path, resume: bool) -> None:
    """Raise a CheckpointError where a folder holds another run or configuration, or no run to resume."""
    if not resume:
        if has_checkpoint(out):
            raise CheckpointError(f"{out} already holds a training run; add --resume or choose another --out")
        return
    before = read_run_config(out)
    if dataclasses.replace(before, steps=config.steps) != config:
        raise CheckpointError(f"{out} holds a run with another configuration; resume it with its own")
    if config.steps < before.steps:
        raise CheckpointError(
            f"{out} holds a run of {before.steps} steps; it can be extended to more, not cut to {config.steps}"
        )


def _forget_after(metrics: Path, step: int) -> None:
    """Drop the records of steps that come again, as of a killed run after its last checkpoint."""
    if not is_first_process() or not metrics.exists():
        return
    lines = metrics.read_text().splitlines()
    kept = [line for line in lines if line.endswith("}") and json.loads(line)["step"] <= step]
    with atomic_write(metrics) as temporary:
        temporary.write_text("".join(line + "\n" for line in kept))


def is_first_process() -> bool:
    """Return whether this process writes what all processes share."""
    return jax.process_index() == 0


def window_metrics(window: list[dict[str, jax.Array]], seeds: int) -> list[dict[str, float]]:
    """Return every seed's shares of a window, and medians over its good updates.

    A median, as a reset has energies a hundred times the usual; a skipped update may have NaN.
    """
    fetched = jax.device_get(window)
    columns = {name: np.stack([np.reshape(entry[name], seeds) for entry in fetched]) for name in fetched[0]}

    def of_seed(own: dict[str, np.ndarray]) -> dict[str, float]:
        is_good = own["skipped"] == 0
        taken = is_good if np.any(is_good) else ~is_good
        return {
            name: float(np.mean(values) if name in _SHARES else np.median(values[taken]))
            for name, values in own.items()
        }

    return [of_seed({name: values[:, place] for name, values in columns.items()}) for place in range(seeds)]


def _check_skipped(
    state: TrainState, config: TrainConfig, checkpoints: Checkpoints, out: Path, earlier: Mapping[str, Any]
) -> None:
    """Stop a run that produces nothing but NaN; its weights are good, as such updates are not applied."""
    skipped = int(np.max(state.skipped))
    if skipped <= config.max_skipped:
        return
    checkpoints.wait()
    weights = [folder / "last_finite.npz" for folder in seed_folders(config, out)]
    export(state, config, weights, earlier)
    states = out / "offending_state.npz"  # of all seeds
    leaves = jax.tree.leaves(jax.device_get(state.pools))
    np.savez(states, **{str(number): leaf for number, leaf in enumerate(leaves)})
    raise NonFiniteError(
        f"the last {skipped} updates were not finite at step {int(state.step)}; the states that they began from "
        f"are in {states}. Begin another run with a lower learning_rate; --start-from {weights[0]} keeps what "
        "was learned"
    )


def seed_configs(config: TrainConfig) -> list[TrainConfig]:
    """Return the run of each seed alone."""
    return [dataclasses.replace(config, seed=config.seed + k, seeds=1) for k in range(config.seeds)]


def seed_folders(config: TrainConfig, out: Path) -> list[Path]:
    """Return where metrics and network of each seed lie: `out`, or with several seeds a folder for each."""
    return [out] if config.seeds == 1 else [out / f"seed-{one.seed}" for one in seed_configs(config)]


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

    The seeds are a batch axis of the step of `make_train_step`: at 1k vertices a GPU spends it on starting
    kernels, whose number does not grow with the seeds.
    """
    step = jax.vmap(make_train_step(config, resolution), in_axes=(_AXES, None), out_axes=(_AXES, 0))
    return jax.jit(step, donate_argnums=0)


def keep_memory() -> None:
    """Make glibc, if any, keep freed memory: one arena, no mapping per allocation, nothing given back.

    A training step on a CPU takes a hundred megabytes of temporary buffers and frees them. By default glibc
    returns them to the kernel, and a third of a step is page faults. Call it before the first array.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is None:
        return
    for option, value in ((_ARENA_MAX, 1), (_MMAP_MAX, 0), (_TRIM_THRESHOLD, 2**31 - 1), (_TOP_PAD, 2**28)):
        mallopt(option, value)


def plot_curves(folder: Path, config: TrainConfig) -> Path | None:
    """Draw the curves of a run's `metrics.jsonl` into `curves.png` (extra `plot`); None without it or metrics."""
    try:
        import matplotlib
    except ImportError:
        return None
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    records = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    if not records:
        return None
    steps = [record["step"] for record in records]
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
    losses = [record["loss"] for record in records]
    spans_decades = not 0 < max(losses) < 10 * min(losses)
    left.plot(steps, losses)
    left.set(xlabel="step", ylabel=f"loss, {_unit(config)}", yscale="symlog" if spans_decades else "linear")
    for term in _DRAWN:
        right.plot(steps, [max(record[term], 1e-7) for record in records], label=term)
    right.set(xlabel="step", ylabel="energy at the prediction, median [J]", yscale="log")
    right.legend()
    with atomic_write(folder / "curves.png") as temporary:
        figure.savefig(temporary, format="png", dpi=100)
    plt.close(figure)
    return folder / "curves.png"


def _unit(config: TrainConfig) -> str:
    """Return what a run's loss is measured in, see `training.loss`."""
    if config.iterations:
        return "mean logarithm of the shares of gap and squared distance that are left"
    if config.refinement_weights == "contraction":
        return "mean share of a pass's gap that it leaves"
    return "J" if config.energy_set == "hood" else "in units of lifting the garment by 1 cm"
