"""Budgets and tolerances, and `eslr calibrate`, which measures what they are chosen from."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.table import Table

from eslr_jax.cli.console import app, use_compile_cache, waiting
from eslr_jax.errors import ConfigError

# Peak memory of whole runs of 1,920 and 31,200 vertices over 6 and 60 frames, of the solver and smooth-small.
_BASE_GB = 1.7
_VERTEX_BYTES = 1e4
_FRAME_BYTES = 240
_TOLERANCE = "1%"  # by default: what is left is not seen, and it takes a third of the default network's time


def parse_budget(text: str | None) -> float | None:
    """Return a time in milliseconds.

    Raises:
        ConfigError: It is not a positive time.
    """
    if text is None:
        return None
    units = {"ms": 1.0, "s": 1e3}
    unit = "ms" if text.endswith("ms") else "s"
    try:
        value = float(text.removesuffix(unit)) * units[unit] if text.endswith(unit) else 0.0
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise ConfigError(f"--budget {text}: write a time per frame, such as 20ms or 0.1s")
    return value


def parse_share(text: str | None) -> float | None:
    """Return a share, written as 1% or 0.01.

    Raises:
        ConfigError: It is not between 0 and 1.
    """
    if text is None:
        return None
    try:
        value = float(text.removesuffix("%")) / (100 if text.endswith("%") else 1)
    except ValueError:
        value = 0.0
    if not 0 < value < 1:
        raise ConfigError(f"--tolerance {text}: write a share of the initial gap, such as 1% or 0.01")
    return value


def parse_request(
    budget: str | None, tolerance: str | None, *, is_chosen: bool
) -> tuple[float | None, float | None]:
    """Return the budget [ms] or the tolerance that chooses the simulator; neither if a simulator is named.

    Args:
        budget: Text of the command line.
        tolerance: Text of the command line.
        is_chosen: Choose the simulator, because the command line names none.

    Raises:
        ConfigError: One of them can't be read, both are given, or one of them and a simulator.
    """
    if is_chosen:
        return parse_budget(budget), parse_share(tolerance or (None if budget else _TOLERANCE))
    if budget is not None or tolerance is not None:
        raise ConfigError(
            "--budget and --tolerance choose the simulator and its iterations; leave out --simulator, --model "
            "and --iterations"
        )
    return None, None


def describe_load(num_vertices: int, num_frames: int, frame_ms: float) -> str:
    """Return the expected time and memory of a simulation, as text.

    Args:
        num_vertices: Of the garment.
        num_frames: Of the simulation.
        frame_ms: Expected time of a frame.
    """
    minutes = num_frames * frame_ms / 60e3
    memory = _BASE_GB + 1e-9 * num_vertices * (_VERTEX_BYTES + num_frames * _FRAME_BYTES)
    return (
        f"{num_vertices:,} vertices take about {frame_ms / 1e3:.1f} s a frame, {max(minutes, 1):.0f} min for "
        f"{num_frames} frames, and {memory:.1f} GB of memory; --frames and a coarser mesh take less"
    )


@app.command
def calibrate(models: tuple[str, ...] = (), out: Path | None = None) -> None:
    """Measure what this device can do in how much time, for `eslr simulate --budget` and `--tolerance`.

    Takes a few minutes on an otherwise idle machine. The result is kept with the compiled programs.

    Args:
        models: Bundled networks to measure beside the solver; if not given, the default network and the one that
            was trained as a start for the solver.
        out: File to write to, instead of the one that `eslr simulate` reads.
    """
    from eslr_jax.assets.models import DEFAULT_MODEL, START_MODEL
    from eslr_jax.evaluation.calibrate import calibrate as run
    from eslr_jax.evaluation.report import environment
    from eslr_jax.io.atomic import ensure_output_dir
    from eslr_jax.simulation.budget import cache_path, write_calibration

    use_compile_cache()
    path = out or cache_path()
    ensure_output_dir(path.parent)  # before minutes are spent
    with waiting("measuring"):
        measured = run(models or (START_MODEL, DEFAULT_MODEL))
    write_calibration(measured, path, environment())
    table = Table("", "vertices", "per frame [ms]", "per iteration [ms]", "gap after 20", box=None)
    for method in measured.methods:
        table.add_row(
            method.name,
            str(method.vertices),
            f"{method.fixed_ms:.1f}",
            f"{method.iteration_ms:.2f}",
            f"{method.median['20']:.2%}",
        )
    Console().print(table, markup=False)
    print(path)
