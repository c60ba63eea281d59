"""What a frame costs on this device, and how many iterations a time per frame pays for (host)."""

from __future__ import annotations

import dataclasses
import json
import math
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax

from eslr_jax.errors import AssetError, ConfigError
from eslr_jax.files.atomic import atomic_write
from eslr_jax.pipeline.assets.cache import user_cache
from eslr_jax.pipeline.assets.catalog import data_folder

FORMAT = 2
SOLVER = "solver"
_MOST = 160  # iterations; after so many, rounding leaves little to gain
_FEWEST = 5  # iterations, to keep a budget: with fewer, cloth does not hold together


@dataclasses.dataclass(frozen=True)
class Cost:
    """Time of a frame on one device, by one method, at one size of garment."""

    name: str  # SOLVER, or a network that the solver continues
    vertices: int
    fixed_ms: float  # per frame: contacts, and the network's passes
    iteration_ms: float  # per L-BFGS iteration

    def frame_ms(self, iterations: float) -> float:
        """Return the time of a frame of so many iterations [ms]."""
        return self.fixed_ms + iterations * self.iteration_ms

    def iterations_within(self, budget_ms: float) -> int:
        """Return the iterations that a frame has time for, at most 160; negative where it has none."""
        return min(math.floor((budget_ms - self.fixed_ms) / self.iteration_ms), _MOST)


@dataclasses.dataclass(frozen=True)
class Calibration:
    """Measurements of one device."""

    device: str
    costs: tuple[Cost, ...]

    def cost(self, num_vertices: int, name: str = SOLVER, substeps: int = 1) -> Cost:
        """Return the cost of a frame, in proportion to the vertices from the size that was measured nearest by.

        Of a network that was not measured it is the solver's part.
        """
        nearest = min({cost.vertices for cost in self.costs}, key=lambda v: abs(math.log(v / num_vertices)))
        measured = {cost.name: cost for cost in self.costs if cost.vertices == nearest}
        cost, scale = measured.get(name, measured[SOLVER]), substeps * num_vertices / nearest
        return Cost(cost.name, num_vertices, scale * cost.fixed_ms, scale * cost.iteration_ms)


def first_iterations(cost: Cost, budget_ms: float) -> int:
    """Return the iterations of the first frames of a simulation with a budget.

    Raises:
        ConfigError: There is no time for one.
    """
    iterations = cost.iterations_within(budget_ms)
    if iterations < 1:
        raise ConfigError(
            f"--budget {budget_ms:g}ms: the fastest frame here takes {cost.frame_ms(1):.1f} ms; give more"
        )
    return iterations


def keep_budget(cost: Cost, budget_ms: float) -> Callable[[int, float], int]:
    """Return a `pace` for `simulate`: from the last frames' iterations and milliseconds to the next iterations.

    The time of the last frames gives the factor by which the device is slower or faster now than calibrated.
    There are never too few iterations for intact cloth: a smaller budget is missed.
    """
    least = min(cost.iterations_within(budget_ms), _FEWEST)

    def pace(iterations: int, took_ms: float) -> int:
        slower = took_ms / cost.frame_ms(iterations)
        return max(cost.iterations_within(budget_ms / slower), least)

    return pace


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
        return Calibration(record["device"], tuple(Cost(**cost) for cost in record["costs"]))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise AssetError(f"{path} is no calibration ({error}); make one by eslr calibrate") from error
