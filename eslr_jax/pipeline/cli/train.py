"""`eslr train`."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import tyro
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from eslr_jax.config import TrainConfig, parse_override
from eslr_jax.errors import ConfigError
from eslr_jax.files.parsing import one_line
from eslr_jax.pipeline.cli.console import app, say, stderr, use_compile_cache
from eslr_jax.pipeline.extras import require


@app.command(name="train")
@dataclasses.dataclass(frozen=True)
class Train:
    """Train a network on the physics loss; Ctrl-C or SIGTERM writes a checkpoint first.

    A batch (`--set batch_size=8`) is spread over all devices of this machine, and with --coordinator over
    those of several machines: start the same command once on each.
    """

    # Folder of metrics, checkpoints and the exported model; with `--set seeds=3` of folders for each seed.
    out: Path | None = None
    # TOML file of a training configuration; not needed with --resume.
    config: Path | None = None
    # Changes to the configuration, as key=value with dots for tables, e.g. model.refinement_steps=4. See --keys.
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    # Show all keys of a configuration with their defaults, and end.
    keys: bool = False
    # Go on from the newest checkpoint of the folder; --set steps=N extends a run to N steps.
    resume: bool = False
    # End after this many minutes with a checkpoint, from which --resume goes on.
    minutes: float | None = None
    # Name of a bundled network or an exported file whose weights to start from.
    start_from: str | None = None
    # Write event files for TensorBoard too.
    tensorboard: bool = False
    # Address of the first process as HOST:PORT, or "auto" under Slurm.
    coordinator: str | None = None
    # Number of processes; not needed with "auto".
    num_processes: int | None = None
    # Number of this process, from 0; not needed with "auto".
    process_id: int | None = None

    def __call__(self) -> None:
        """Train, draw the curves, and print where the networks are."""
        from eslr_jax.pipeline.assets.models import load_model, load_training_data, model_record
        from eslr_jax.training.loop import is_first_process, keep_memory, plot_curves, seed_folders, train

        if self.keys:
            return _show_keys()
        out = self.out
        if out is None:
            raise ConfigError("no --out; name a folder for metrics, checkpoints and the network")
        chosen = self._configuration(out)
        keep_memory()
        use_compile_cache()
        if self.coordinator is not None:  # before anything is computed, as jax.distributed demands
            self._join_processes(self.coordinator)
        initial, earlier = None, {}
        if self.start_from is not None:
            initial, earlier = load_model(self.start_from), model_record(self.start_from)
        datasets = tuple(load_training_data(chosen, vertices) for vertices in chosen.vertices)
        with _training_progress(
            chosen.steps, out if self.tensorboard and is_first_process() else None
        ) as show:
            state = train(
                chosen,
                out,
                datasets=datasets,
                resume=self.resume,
                initial=initial,
                earlier=earlier,
                on_progress=show,
                most_seconds=math.inf if self.minutes is None else 60 * self.minutes,
            )
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

    def _configuration(self, out: Path) -> TrainConfig:
        """Return the configuration of the recipe, or that of the run which goes on."""
        from eslr_jax.training.checkpoint import read_run_config
        from eslr_jax.training.recipe import describe_train_config, load_recipe, read_train_config

        is_alone = self.coordinator is None
        if is_alone and (self.num_processes is not None or self.process_id is not None):
            raise ConfigError(
                "--num-processes and --process-id need --coordinator, which joins the processes"
            )
        changes = dict(parse_override(text) for text in self.set)
        if self.resume:
            if self.config is not None or changes.keys() - {"steps"} or self.start_from is not None:
                raise ConfigError(
                    "--resume goes on with the run's own configuration; leave out --config, --start-from, and "
                    "every --set but steps=N, which extends the run, or start a new one in another folder"
                )
            return read_train_config(describe_train_config(read_run_config(out)) | changes)
        if self.config is None:
            raise ConfigError("no --config; give a TOML file, such as one of experiments/configs")
        return load_recipe(self.config, changes)

    def _join_processes(self, coordinator: str) -> None:
        """Connect with the other processes of a training run."""
        import jax

        is_automatic = coordinator == "auto"
        if not is_automatic and (self.num_processes is None or self.process_id is None):
            raise ConfigError("--coordinator HOST:PORT needs --num-processes and --process-id too")
        address = None if is_automatic else coordinator
        try:
            jax.distributed.initialize(address, self.num_processes, self.process_id)
        except (RuntimeError, ValueError) as error:
            text = one_line(error)
            raise ConfigError(f"the processes could not be joined: {text}; check --coordinator") from error


@dataclasses.dataclass(frozen=True)
class _Keys(TrainConfig):
    """A recipe as it is written."""

    # Network: a name, or a table [model] with that as base and keys that differ; MODULE:NAME for one's own.
    model: str


def _show_keys() -> None:
    """Print the keys of a configuration and of every system, with defaults and what their comments say."""
    from eslr_jax.networks.registry import MODELS

    systems = {type(model) for model in MODELS.values()}
    described: dict[type, str] = {
        _Keys: "Keys of a recipe in TOML, and of --set: write --steps below as steps=20000."
    }
    for system in sorted(systems, key=lambda system: system.__name__):
        names = ", ".join(name for name, model in MODELS.items() if type(model) is system)
        described[system] = f"Keys of [model] with base = {names}; of --set as model.KEY."
    for keys, description in described.items():
        parser = tyro.extras.get_parser(
            keys,
            prog="eslr train --keys",
            description=description,
            use_underscores=True,
            config=(tyro.conf.FlagConversionOff,),
        )
        print(parser.format_help())


@contextlib.contextmanager
def _training_progress(total: int, tensorboard: Path | None) -> Iterator[Any]:
    """Show steps per second, the loss, its terms and the time left."""
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
