"""Choose a simulator for a budget or a tolerance, by measurements of the device (host)."""

from __future__ import annotations

import dataclasses
import json
import math
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from eslr_jax.assets.cache import user_cache
from eslr_jax.assets.catalog import data_folder
from eslr_jax.errors import AssetError, ConfigError
from eslr_jax.io.atomic import atomic_write

FORMAT = 1
ITERATIONS = (0, 1, 2, 5, 10, 20, 40, 80, 160)
SOLVER = "solver"
_STOPS_AT = 0.07  # of the tolerance: the median gap where frames stop for 1 %; at 4k 0.08
_FEWEST = 5  # iterations, to keep a budget: with five a network's rollouts hold together, with none not
_MOST_ITERATIONS = 500  # of a frame with a tolerance; a dress on a fast clip takes 140 on average for 1 %


@dataclasses.dataclass(frozen=True)
class Method:
    """Cost and error of one way to step a frame, at one size of garment."""

    name: str  # SOLVER, or the name of a bundled network
    vertices: int
    fixed_ms: float  # per frame: contacts, and the network's passes
    iteration_ms: float  # per L-BFGS iteration
    median: dict[str, float]  # gap relative to the initial gap after so many iterations
    p99: dict[str, float]  # the same, not exceeded by 99 % of the frames


@dataclasses.dataclass(frozen=True)
class Calibration:
    """Measurements of one device."""

    device: str
    methods: tuple[Method, ...]


@dataclasses.dataclass(frozen=True)
class Choice:
    """What was chosen, and why."""

    method: str
    iterations: int
    tolerance: float  # for SimConfig; zero where a budget was given
    fixed_ms: float  # of the method, scaled to the garment
    iteration_ms: float
    expected_ms: float
    expected_gap: float  # median, relative to the initial gap
    reason: str


def choose(
    calibration: Calibration,
    num_vertices: int,
    *,
    budget_ms: float | None = None,
    tolerance: float | None = None,
    substeps: int = 1,
) -> Choice:
    """Choose a simulator for a time per frame, or for a gap relative to the initial gap.

    Costs are scaled in proportion to the number of vertices from the size that was measured nearest by.

    Args:
        calibration: Of this device.
        num_vertices: Of the garment.
        budget_ms: Milliseconds per frame to stay within.
        tolerance: Relative gap to stay below on 99 % of the frames.
        substeps: Of a frame.

    Raises:
        ConfigError: Neither or both are given, the budget is too small, or the tolerance out of reach.
    """
    methods = methods_at(calibration, num_vertices, substeps)
    if budget_ms is not None and tolerance is None:
        return _within_budget(methods, budget_ms)
    if tolerance is not None and budget_ms is None:
        return _within_tolerance(methods, tolerance)
    raise ConfigError("give either a budget or a tolerance")


def expected_ms(
    calibration: Calibration, num_vertices: int, name: str, iterations: int, substeps: int = 1
) -> float:
    """Return how long a frame takes on this device [ms]; of a network not measured, the solver's part.

    Args:
        calibration: Of this device.
        num_vertices: Of the garment.
        name: `SOLVER`, or the name of a network.
        iterations: Of the solver, in a substep.
        substeps: Of a frame.
    """
    methods = {method.name: method for method in methods_at(calibration, num_vertices, substeps)}
    method = methods.get(name, methods[SOLVER])
    return method.fixed_ms + iterations * method.iteration_ms


def methods_at(calibration: Calibration, num_vertices: int, substeps: int = 1) -> list[Method]:
    """Return the methods of the size measured nearest by, their costs scaled to vertices and to substeps."""
    nearest = min({m.vertices for m in calibration.methods}, key=lambda v: abs(np.log(v / num_vertices)))
    scale = substeps * num_vertices / nearest
    return [
        dataclasses.replace(
            method,
            fixed_ms=method.fixed_ms * scale,
            iteration_ms=method.iteration_ms * scale,
        )
        for method in calibration.methods
        if method.vertices == nearest
    ]


def _affordable(budget_ms: float, fixed_ms: float, iteration_ms: float) -> int:
    """Return the iterations that a frame has time for, no more than were measured; negative where none fits."""
    return min(math.floor((budget_ms - fixed_ms) / iteration_ms), ITERATIONS[-1])


def _within_budget(methods: list[Method], budget_ms: float) -> Choice:
    options = []
    for method in methods:
        count = _affordable(budget_ms, method.fixed_ms, method.iteration_ms)
        if count >= min(int(key) for key in method.median):
            options.append((interpolate_gap(method.median, count), method, count))
    if not options:
        least = min(method.fixed_ms + method.iteration_ms for method in methods)
        raise ConfigError(f"--budget {budget_ms:g}ms: the fastest frame here takes {least:.1f} ms")
    options.sort(key=lambda option: option[0])
    gap, method, count = options[0]
    others = ", ".join(f"{other.name} {value:.2%}" for value, other, _ in options[1:])
    return Choice(
        method=method.name,
        iterations=count,
        tolerance=0.0,
        fixed_ms=method.fixed_ms,
        iteration_ms=method.iteration_ms,
        expected_ms=method.fixed_ms + count * method.iteration_ms,
        expected_gap=gap,
        reason=f"least gap within {budget_ms:g} ms" + (f" (others: {others})" if others else ""),
    )


def _within_tolerance(methods: list[Method], tolerance: float) -> Choice:
    options = []
    for method in methods:
        counts = range(min(int(key) for key in method.p99), ITERATIONS[-1] + 1)
        # Where a frame ended in another minimum than the deepest known one, no number of iterations keeps it.
        kept = (count for count in counts if interpolate_gap(method.p99, count) <= tolerance)
        stops_at = _STOPS_AT * tolerance
        stops = (count for count in counts if interpolate_gap(method.median, count) <= stops_at)
        count = max(next(kept, counts[-1]), next(stops, counts[-1]))
        if interpolate_gap(method.median, count) <= tolerance:
            options.append((method.fixed_ms + count * method.iteration_ms, method, count))
    if not options:
        best = min(min(method.median.values()) for method in methods)
        raise ConfigError(f"--tolerance {tolerance:.3%}: the best that was measured here is {best:.3%}")
    options.sort(key=lambda option: option[0])
    cost, method, count = options[0]
    is_kept = interpolate_gap(method.p99, count) <= tolerance
    on_which = "on 99 % of frames" if is_kept else "in the median frame"
    others = ", ".join(f"{other.name} {value:.1f} ms" for value, other, _ in options[1:])
    return Choice(
        method=method.name,
        iterations=_MOST_ITERATIONS,
        tolerance=tolerance,
        fixed_ms=method.fixed_ms,
        iteration_ms=method.iteration_ms,
        expected_ms=cost,
        expected_gap=interpolate_gap(method.median, count),
        reason=f"fastest below {tolerance:.2%} {on_which}" + (f" (others: {others})" if others else ""),
    )


def keep_budget(choice: Choice, budget_ms: float) -> Callable[[int, float], int]:
    """Return a `pace` for `simulate` that adapts the iterations, so that frames keep a budget.

    The calibration divides the cost of a frame into a fixed part and a part per iteration. The time of the last
    frames gives the factor by which both are slower or faster now.

    Args:
        choice: Of `choose`, for the budget.
        budget_ms: Milliseconds per frame.

    Returns:
        A function of the iterations of the last frames, and of the milliseconds that one of them took. It returns
        the iterations of the next frames, but never too few for intact cloth: a smaller budget is missed.
    """
    least = min(choice.iterations, _FEWEST)

    def pace(iterations: int, took_ms: float) -> int:
        slower = took_ms / (choice.fixed_ms + iterations * choice.iteration_ms)
        return max(_affordable(budget_ms / slower, choice.fixed_ms, choice.iteration_ms), least)

    return pace


def interpolate_gap(curve: Mapping[Any, float], place: float) -> float:
    """Return a curve's gap at a place: between measurements its logarithm is linear, beyond them it stays.

    Args:
        curve: Relative gap by iterations or by milliseconds; keys are numbers, or their text as JSON has it.
        place: The same.
    """
    keys = sorted(curve, key=float)
    values = [np.log(max(curve[key], 1e-7)) for key in keys]
    return float(np.exp(np.interp(place, [float(key) for key in keys], values)))


def device_name() -> str:
    """Return what calibrations are kept under: kind of device and number of cores."""
    device = jax.devices()[0]
    cores = f", {os.cpu_count()} cores" if device.platform == "cpu" else ""
    return f"{device.device_kind}{cores}"


def cache_path() -> Path:
    """Return the file in which this device's own calibration is kept."""
    name = "".join(letter if letter.isalnum() else "-" for letter in device_name().lower())
    return user_cache() / f"calibration-{name}.json"


def write_calibration(calibration: Calibration, path: Path, environment: Mapping[str, Any]) -> None:
    """Write a calibration as JSON, with the device and the versions that it was measured with."""
    record = {"format": FORMAT, **dataclasses.asdict(calibration), "environment": environment}
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(record, indent=2) + "\n")


def read_calibration(path: Path | None = None) -> Calibration:
    """Read this device's calibration, or the shipped one of two CPU cores where there is none.

    Raises:
        AssetError: The file is damaged.
    """
    if path is None:
        path = cache_path() if cache_path().exists() else data_folder() / "models" / "calibration.json"
    try:
        record = json.loads(path.read_text())
        if record["format"] != FORMAT:
            raise ValueError(f"format {record['format']}")
        methods = tuple(Method(**method) for method in record["methods"])
        return Calibration(record["device"], methods)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise AssetError(f"{path} is no calibration ({error}); make one by eslr calibrate") from error
