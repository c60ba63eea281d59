"""Measure what a frame costs on a device, for budgets and expected times (host)."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np

from eslr_jax.config import SimConfig
from eslr_jax.networks.network import Network
from eslr_jax.pipeline.assets import load_body, load_garment, load_model, load_motion
from eslr_jax.pipeline.assets.budget import SOLVER, Calibration, Cost, device_name
from eslr_jax.pipeline.report.scene_parts import Name, time_in_turns
from eslr_jax.pose.motion import pose_body
from eslr_jax.simulation.plan import first_frames, prepare_scene
from eslr_jax.simulation.rollout import rollout_scene
from eslr_jax.terms import FAST, Term, scene_terms
from eslr_jax.types import Scene

_TIMED = ("tshirt", "cmu_016_22")  # a garment, and a clip of the training split
_TIMED_FRAMES = 20
_TIMED_ITERATIONS = (20, 60)  # cloth that fewer ones crumple is pushed, and its frames are solved again
_TURNS = 9  # timings of each, in turns; medians count


def calibrate(models: tuple[str, ...], sizes: tuple[str, ...] = ("1k", "4k")) -> Calibration:
    """Time the solver, and the solver behind each bundled network, at some sizes of a garment.

    The scene has what `eslr simulate` models.
    """
    has_coarse_edges = read_coarse_edges(models)
    garment, clip = _TIMED
    costs: list[Cost] = []
    for size in sizes:
        scene = example_scene(
            garment, size, clip, _TIMED_FRAMES, terms=scene_terms(), has_coarse_edges=has_coarse_edges
        )
        costs += measure_costs((SOLVER, *models), scene)
    return Calibration(device_name(), tuple(costs))


def example_scene(
    garment: str,
    size: str,
    clip: str,
    num_frames: int = 60,
    *,
    terms: tuple[Term, ...] = FAST,
    has_coarse_edges: bool = False,
) -> Scene:
    """Prepare a bundled garment on a bundled clip, with the coarse edges that a hierarchical network reads.

    By default nothing is pushed: so a gap is measured.
    """
    poses = pose_body(load_body(), load_motion(clip), num_frames=num_frames)
    cloth = load_garment(garment, vertices=size, has_coarse_edges=has_coarse_edges)  # type: ignore[arg-type]
    return prepare_scene(cloth, poses, terms=terms)


def read_coarse_edges(names: tuple[str, ...]) -> bool:
    """Return whether any of some methods reads coarse edges, which its garment then needs."""
    networks = [load_model(name) for name in names if name != SOLVER]
    return any(network.garment_options.get("has_coarse_edges") for network in networks)


def measure_costs(names: tuple[str, ...], scene: Scene) -> list[Cost]:
    """Time the first frames of a scene by the solver (SOLVER) or networks, in turns: machine speeds change."""
    runs = {(name, count): (*simulator_of(name), count) for name in names for count in _TIMED_ITERATIONS}
    fixed_ms, iteration_ms = fit_costs(time_frames(runs, scene))
    num_vertices = int(np.sum(scene.garment.vertex_mask))
    return [Cost(name, num_vertices, fixed_ms[name], iteration_ms) for name in names]


def fit_costs(times: Mapping[tuple[str, int], list[float]]) -> tuple[dict[str, float], float]:
    """Return every method's fixed cost per frame, and the cost of an iteration [ms].

    `times` are milliseconds per frame, turn by turn, by method and one of two numbers of iterations. An
    iteration is the same for every method, so all share one cost. The fixed cost of a method is that of the first
    one plus their difference, which is taken within turns: a machine that changes its speed during the
    measurement then favours none.
    """
    names = list(dict.fromkeys(name for name, _ in times))
    low, high = sorted({count for _, count in times})
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


def simulator_of(name: str, iterations: int = 0, tolerance: float = 0.0) -> tuple[Network | None, SimConfig]:
    """Return network and configuration of a method: the solver (SOLVER), or a network with it behind."""
    network = None if name == SOLVER else load_model(name)
    return network, SimConfig(iterations=iterations, tolerance=tolerance)


def time_frames(
    runs: Mapping[Name, tuple[Network | None, SimConfig, int | None]], scene: Scene, turns: int = _TURNS
) -> dict[Name, list[float]]:
    """Return milliseconds per frame of rollouts of a scene's first frames, one number per turn.

    `runs` are network, configuration and iterations by name, see `rollout_scene`; all are rolled out in turns.
    """
    short = first_frames(scene, _TIMED_FRAMES)
    parts = {
        name: (partial(rollout_scene, config=config, iterations=iterations), (network, short))
        for name, (network, config, iterations) in runs.items()
    }
    return {
        name: [whole / (short.num_frames - 1) for whole in values]
        for name, values in time_in_turns(parts, turns).items()
    }
