"""Error and cost of the solver, and of the solver behind networks, from the same states."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np

from eslr_jax.pipeline.assets.budget import SOLVER, Cost
from eslr_jax.pipeline.report.calibrate import measure_costs, simulator_of
from eslr_jax.pipeline.report.gap import GapOptions, OptimalityGap, measure_gap
from eslr_jax.simulation.rollout import rollout_scene
from eslr_jax.types import Scene, Trajectory

ITERATIONS = (0, 1, 2, 5, 10, 20, 40, 80, 160)
EVERY = 3  # frames between those whose gap is measured
TRUTH_ITERATIONS = 100  # of the rollouts that supply the states


@dataclasses.dataclass(frozen=True)
class Method:
    """Cost and error of one way to step a frame, at one size of garment."""

    cost: Cost
    median: dict[str, float]  # gap relative to the initial gap after so many iterations
    p99: dict[str, float]  # the same, not exceeded by 99 % of the frames


def measure_methods(names: tuple[str, ...], scenes: list[Scene]) -> list[Method]:
    """Measure error and cost of methods, on states of the optimum's own rollouts.

    The optimum of a frame is the lowest potential that any method finds, since a network may lead to a deeper
    minimum.

    Args:
        names: Of networks; SOLVER is the solver alone.
        scenes: Of one size; the first is timed.
    """
    _, solver = simulator_of(SOLVER)
    truths = [rollout_scene(None, scene, solver, TRUTH_ITERATIONS) for scene in scenes]
    measured = {
        name: [measure_ends(name, scene, truth) for scene, truth in zip(scenes, truths, strict=True)]
        for name in names
    }
    optima = [
        np.min([ends.optimum for ends in same], axis=0) for same in zip(*measured.values(), strict=True)
    ]
    costs = measure_costs(names, scenes[0])
    return [Method(cost, *quantiles(cost.name, measured[cost.name], optima)) for cost in costs]


def measure_ends(name: str, scene: Scene, truth: Trajectory) -> OptimalityGap:
    """Return the potentials that a method leaves after every count of `ITERATIONS`, as NumPy arrays."""
    network, _ = simulator_of(name)
    options = GapOptions(EVERY, ITERATIONS[1:] if network is None else (), ITERATIONS)
    return jax.device_get(measure_gap(network, truth, scene, options))


def quantiles(
    name: str, gaps: list[OptimalityGap], optima: list[np.ndarray]
) -> tuple[dict[str, float], dict[str, float]]:
    """Return the median and the 99 % quantile of a method's relative gap over all scenes, by iterations."""
    relative: dict[int, list[np.ndarray]] = {}
    for ends, optimum in zip(gaps, optima, strict=True):
        best = ends._replace(optimum=optimum)
        for count, energy in (ends.solver if name == SOLVER else ends.refined).items():
            relative.setdefault(count, []).append(np.asarray(best.share(energy)))
    joined = {count: np.concatenate(parts) for count, parts in relative.items()}
    return (
        {str(count): float(np.median(values)) for count, values in joined.items()},
        {str(count): float(np.quantile(values, 0.99)) for count, values in joined.items()},
    )
