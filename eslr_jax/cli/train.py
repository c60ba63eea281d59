"""`eslr train`."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from eslr_jax.cli.console import app, say, stderr, use_compile_cache
from eslr_jax.config import ModelConfig, TrainConfig, describe_keys
from eslr_jax.errors import ConfigError
from eslr_jax.extras import require
from eslr_jax.io.parsing import one_line

_KEYS = "\n".join([*describe_keys(TrainConfig), *describe_keys(ModelConfig, "model.")])
_CHANGES = (
    "Changes to the configuration, as key=value with dots for tables, e.g. model.refinement_steps=4. "
    f"The keys of a configuration and their defaults:\n{_KEYS}\n"
)


@app.command
def train(
    out: Path,
    config: Path | None = None,
    set_: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(name="set", help=_CHANGES)
    ] = (),
    resume: bool = False,
    start_from: str | None = None,
    tensorboard: bool = False,
    coordinator: str | None = None,
    num_processes: int | None = None,
    process_id: int | None = None,
) -> None:
    """Train a network on the physics loss; Ctrl-C or SIGTERM writes a checkpoint first.

    A batch (`--set batch_size=8`) is spread over all devices of this machine, and with --coordinator over
    those of several machines: start the same command once on each.

    Args:
        out: Folder of metrics, checkpoints and the exported model; with `--set seeds=3` of folders for each seed.
        config: TOML file of a training configuration; not needed with --resume.
        set_: Changes to the configuration, as key=value.
        resume: Go on from the newest checkpoint of the folder; --set steps=N extends a run to N steps.
        start_from: Name of a bundled network or an exported file whose weights to start from.
        tensorboard: Write event files for TensorBoard too.
        coordinator: Address of the first process as HOST:PORT, or "auto" under Slurm.
        num_processes: Number of processes; not needed with "auto".
        process_id: Number of this process, from 0; not needed with "auto".
    """
    from eslr_jax.assets.models import load_model, model_record
    from eslr_jax.config import from_dict, parse_override, to_dict
    from eslr_jax.models.registry import check_params
    from eslr_jax.training.checkpoint import read_run_config
    from eslr_jax.training.loop import is_first_process
    from eslr_jax.training.loop import train as run
    from eslr_jax.training.memory import keep_memory
    from eslr_jax.training.plot import plot_curves
    from eslr_jax.training.recipe import load_recipe
    from eslr_jax.training.seeds import seed_folders

    if coordinator is None and (num_processes is not None or process_id is not None):
        raise ConfigError("--num-processes and --process-id need --coordinator, which joins the processes")
    if resume:
        changes = dict(parse_override(text) for text in set_)
        if config is not None or changes.keys() - {"steps"} or start_from is not None:
            raise ConfigError(
                "--resume goes on with the run's own configuration; leave out --config, --start-from, and every "
                "--set but steps=N, which extends the run, or start a new one in another folder"
            )
        chosen = from_dict(TrainConfig, to_dict(read_run_config(out)) | changes)
    elif config is None:
        raise ConfigError("no --config; give a TOML file, such as one of experiments/configs")
    else:
        chosen = load_recipe(config, dict(parse_override(text) for text in set_))
    keep_memory()
    use_compile_cache()
    if coordinator is not None:  # before anything is computed, as jax.distributed demands
        _join_processes(coordinator, num_processes, process_id)
    initial, earlier = None, {}
    if start_from is not None:
        initial, _ = load_model(start_from)
        earlier = model_record(start_from)
        check_params(chosen.model, initial)
    with _training_progress(chosen.steps, out if tensorboard and is_first_process() else None) as show:
        state = run(chosen, out, resume=resume, initial_params=initial, earlier=earlier, on_progress=show)
    if not is_first_process():
        return
    folders = seed_folders(chosen, out)
    for folder in folders:
        plot_curves(folder, chosen)
    done = int(state.step)
    if done < chosen.steps:
        say(f"stopped at step {done} of {chosen.steps}; go on with: eslr train --out {out} --resume")
    else:
        for folder in folders:
            print(folder / "model.npz")


def _join_processes(coordinator: str, num_processes: int | None, process_id: int | None) -> None:
    """Connect with the other processes of a training run.

    Raises:
        ConfigError: The processes are not all told, or do not answer.
    """
    import jax

    is_automatic = coordinator == "auto"
    if not is_automatic and (num_processes is None or process_id is None):
        raise ConfigError("--coordinator HOST:PORT needs --num-processes and --process-id too")
    try:
        jax.distributed.initialize(None if is_automatic else coordinator, num_processes, process_id)
    except (RuntimeError, ValueError) as error:
        text = one_line(error)
        raise ConfigError(f"the processes could not be joined: {text}; check --coordinator") from error


@contextlib.contextmanager
def _training_progress(total: int, tensorboard: Path | None) -> Iterator[Any]:
    """Show steps per second, the loss, its terms and the time left.

    Raises:
        MissingExtraError: TensorBoard's event files are asked for and its writer is not installed.
    """
    open_events = None
    if tensorboard is not None:
        board = require("tensorboardX", extra="tensorboard", purpose="--tensorboard")
        open_events = partial(board.SummaryWriter, str(tensorboard / "events"))
    columns = (
        TextColumn("training"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[text]}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with contextlib.ExitStack() as stack:
        progress = stack.enter_context(Progress(*columns, console=stderr))
        task = progress.add_task("training", total=total, text="compiling")
        events = None

        def show(done: int, total: int, metrics: dict[str, float]) -> None:
            terms = ("stretch", "bending", "inertia", "collision", "friction")
            shares = "\n".join(f"{name} {metrics[name] * 1e3:.1f} mJ" for name in terms)
            text = f"{metrics['its']:.1f} it/s\nloss {metrics['loss']:.4f}\n{shares}"
            progress.update(task, completed=done, total=total, text=text)
            nonlocal events
            if open_events is not None and events is None:  # a run that is refused leaves no file
                events = stack.enter_context(contextlib.closing(open_events()))
            if events is not None:
                for name, value in metrics.items():
                    events.add_scalar(name, value, done)

        yield show
