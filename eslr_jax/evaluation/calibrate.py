"""Measure what a device can do in how much time, for the choice by budget or tolerance (host)."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import numpy as np

from eslr_jax.assets import load_body, load_garment, load_model, load_motion
from eslr_jax.body.motion import pose_body
from eslr_jax.config import ModelConfig, SimConfig
from eslr_jax.evaluation.gap import GapOptions, OptimalityGap, measure_gap
from eslr_jax.evaluation.scene_parts import Name, time_in_turns
from eslr_jax.scene.plan import first_frames, prepare_scene
from eslr_jax.simulation.budget import ITERATIONS, SOLVER, Calibration, Method, device_name
from eslr_jax.simulation.rollout import rollout_scene
from eslr_jax.types import Scene, Trajectory

_CLIP = "cmu_016_22"  # of the training split, so that the choice has not seen the test clips
_GARMENTS = ("tshirt", "dress")
_FRAMES = 60
_EVERY = 3  # frames between those whose gap is measured
_TRUTH_ITERATIONS = 100  # of the rollouts that supply the states
_TIMED_FRAMES = 20
_TIMED_ITERATIONS = (10, 60)
_TURNS = 9  # timings of each, in turns; medians count


def calibrate(models: tuple[str, ...], sizes: tuple[str, ...] = ("1k", "4k")) -> Calibration:
    """Measure the solver, and the solver behind each network, on this device.

    Args:
        models: Names of bundled networks.
        sizes: Resolutions of the garments.
    """
    methods: list[Method] = []
    has_coarse_edges = read_coarse_edges(models)
    for size in sizes:
        scenes = [example_scene(name, size, _CLIP, has_coarse_edges=has_coarse_edges) for name in _GARMENTS]
        methods += measure_methods((SOLVER, *models), scenes)
    return Calibration(device_name(), tuple(methods))


def example_scene(
    garment: str, size: str, clip: str, num_frames: int = _FRAMES, *, has_coarse_edges: bool = False
) -> Scene:
    """Prepare a bundled garment on a bundled clip, with the coarse edges that a hierarchical network reads."""
    poses = pose_body(load_body(), load_motion(clip), num_frames=num_frames)
    cloth = load_garment(garment, vertices=size, has_coarse_edges=has_coarse_edges)  # type: ignore[arg-type]
    return prepare_scene(cloth, poses)


def read_coarse_edges(names: tuple[str, ...]) -> bool:
    """Return whether any of some methods reads coarse edges; the argument is that of `measure_methods`."""
    architectures = [simulator_of(name)[1].model for name in names]
    return any(isinstance(model, ModelConfig) and model.hierarchical for model in architectures)


def measure_methods(names: tuple[str, ...], scenes: list[Scene]) -> list[Method]:
    """Measure error and cost of methods, on states of the optimum's own rollouts.

    The optimum of a frame is the lowest potential that any method finds, since a network may lead to a deeper
    minimum. The methods are timed alternately, since a machine's speed changes within minutes.

    Args:
        names: Of networks; SOLVER is the solver alone.
        scenes: Of one size; the first is timed.
    """
    _, solver = simulator_of(SOLVER)
    truths = [rollout_scene(None, scene, solver, _TRUTH_ITERATIONS) for scene in scenes]
    measured = {
        name: [_measure_gap(name, scene, truth) for scene, truth in zip(scenes, truths, strict=True)]
        for name in names
    }
    optima = [
        np.min([ends.optimum for ends in same], axis=0) for same in zip(*measured.values(), strict=True)
    ]
    runs = {(name, count): (*simulator_of(name), count) for name in names for count in _TIMED_ITERATIONS}
    fixed_ms, iteration_ms = fit_costs(time_frames(runs, scenes[0]))
    num_vertices = int(np.sum(scenes[0].garment.vertex_mask))
    return [
        Method(name, num_vertices, fixed_ms[name], iteration_ms, *_quantiles(name, gaps, optima))
        for name, gaps in measured.items()
    ]


def fit_costs(times: Mapping[tuple[str, int], list[float]]) -> tuple[dict[str, float], float]:
    """Return every method's fixed cost per frame, and the cost of an iteration [ms].

    An iteration is the same for every method, so all share one cost. The fixed cost of a method is that of the
    first one plus their difference, which is taken within turns: a machine that changes its speed during the
    measurement then favours none.

    Args:
        times: Milliseconds per frame, turn by turn, by method and number of iterations.
    """
    names = list(dict.fromkeys(name for name, _ in times))
    low, high = _TIMED_ITERATIONS
    slopes = [np.subtract(times[name, high], times[name, low]) / (high - low) for name in names]
    iteration_ms = float(np.median(slopes))
    rests = {
        name: np.array([np.subtract(times[name, count], count * iteration_ms) for count in (low, high)])
        for name in names
    }
    first = rests[names[0]]
    return {
        name: max(float(np.median(first) + np.median(rest - first)), 0.0) for name, rest in rests.items()
    }, iteration_ms


def _measure_gap(name: str, scene: Scene, truth: Trajectory) -> OptimalityGap:
    """Return the potentials that a method leaves after every count of `ITERATIONS`, as NumPy arrays."""
    params, config = simulator_of(name)
    options = GapOptions(_EVERY, ITERATIONS[1:] if config.model is None else (), ITERATIONS)
    return jax.device_get(measure_gap(params, truth, scene, config.model, options))


def _quantiles(
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


def simulator_of(name: str, iterations: int = 0, tolerance: float = 0.0) -> tuple[Any, SimConfig]:
    """Return weights and configuration of a method: the solver, or a network with the solver behind it.

    Args:
        name: SOLVER, whose weights are None, or the name of a bundled network.
        iterations: Of the solver, per frame.
        tolerance: See `SimConfig`.
    """
    if name == SOLVER:
        return None, SimConfig(iterations=iterations, tolerance=tolerance)
    params, model = load_model(name)
    return params, SimConfig(model=model, iterations=iterations, tolerance=tolerance)


def time_frames(
    runs: Mapping[Name, tuple[Any, SimConfig, int | None]], scene: Scene, turns: int = _TURNS
) -> dict[Name, list[float]]:
    """Return milliseconds per frame of rollouts, one number per turn.

    Args:
        runs: Weights, configuration and iterations by name, see `rollout_scene`; all are rolled out in turns.
        scene: Its first frames are simulated.
        turns: Rollouts of each.
    """
    short = first_frames(scene, _TIMED_FRAMES)
    parts = {
        name: (partial(rollout_scene, config=config, iterations=iterations), (params, short))
        for name, (params, config, iterations) in runs.items()
    }
    return {
        name: [whole / (short.num_frames - 1) for whole in values]
        for name, values in time_in_turns(parts, turns).items()
    }
