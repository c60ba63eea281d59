"""Free rollouts measured as HOOD's and the paper's tables are: six terms and their Total, set `hood`."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from eslr_jax.assets import load_body, load_garment, load_motion
from eslr_jax.body.motion import pose_body
from eslr_jax.config import SimConfig
from eslr_jax.evaluation.calibrate import SOLVER, simulator_of
from eslr_jax.evaluation.evaluate import back_and_forth
from eslr_jax.evaluation.metrics import measure_frames
from eslr_jax.evaluation.report import environment
from eslr_jax.io.atomic import atomic_write
from eslr_jax.physics.hood import HoodParameters, hood_metrics
from eslr_jax.physics.problem import PhysicsParameters
from eslr_jax.scene import prepare_scenes
from eslr_jax.simulation.scan import simulate_scene
from eslr_jax.types import Scene, Trajectory

RESULTS = Path(__file__).parents[1] / "results" / "paper"
OPTIMUM = "optimum"
TERMS = ("stretch", "bending", "inertia", "collision", "friction", "gravity")
_ORIGIN_ABOVE_ROOT = 0.22  # [m]; SMPL's origin, from which HOOD counts heights, is this far above the pelvis
_OPTIMUM_ITERATIONS = 60  # of L-BFGS: 0.05 % of the drop


def arguments(description: str | None, *, frames: int = 150) -> argparse.Namespace:
    """Read the options that every script of this folder has."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--frames", type=int, default=frames, help="of every rollout")
    parser.add_argument("--vertices", default="1k", choices=["1k", "4k", "10k"])
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--smoke", action="store_true", help="few frames of one garment on one clip")
    chosen = parser.parse_args()
    if chosen.smoke:
        chosen.frames = 5
    return chosen


def simulator(model: str) -> tuple[Any, SimConfig, dict[str, Any]]:
    """Return weights, configuration and garment options of a network or the optimum; NAME+20 adds iterations."""
    if model == OPTIMUM:
        return *simulator_of(SOLVER, _OPTIMUM_ITERATIONS), {}
    name, _, iterations = model.partition("+")
    params, config = simulator_of(name, int(iterations or 0))
    assert config.model is not None
    names = ("embedding_size", "embedding_mode")
    return params, config, {name: getattr(config.model, name) for name in names}


def table(
    models: Sequence[str],
    garments: Sequence[str],
    clips: Sequence[str],
    *,
    vertices: str = "1k",
    frames: int = 150,
    **garment_options: Any,
) -> dict[str, dict[str, dict[str, float]]]:
    """Return the measures of every model on every garment, means over clips.

    Args:
        models: As for `simulator`; `OPTIMUM` is the solver run near convergence.
        garments: Names of bundled garments.
        clips: Names of bundled clips, played back and forth.
        vertices: Resolution.
        frames: Of every rollout.
        garment_options: Passed on to `load_garment`, over the model's own.
    """
    body = load_body()
    motions = [
        pose_body(body, back_and_forth(load_motion(clip), frames), num_frames=frames) for clip in clips
    ]
    measured: dict[str, dict[str, dict[str, float]]] = {}
    for model in models:
        params, config, options = simulator(model)
        cloths = [load_garment(name, vertices=vertices, **(options | garment_options)) for name in garments]  # type: ignore[arg-type]
        # One size and one body surface for all: one compilation per model.
        scenes = iter(prepare_scenes([cloth for cloth in cloths for _ in motions], motions * len(cloths)))
        measured[model] = {}
        for garment in garments:
            rows = []
            for poses in motions:
                scene = next(scenes)
                trajectory = simulate_scene(params, scene, PhysicsParameters(), config)
                root = poses.joint_transforms[0, 0] @ np.append(np.asarray(body.joint_rest_positions[0]), 1.0)
                rows.append(measure(trajectory, scene, float(root[1])))
            measured[model][garment] = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
            print(garment, model, {name: round(value, 4) for name, value in measured[model][garment].items()})
    return measured


def measure(trajectory: Trajectory, scene: Scene, root_height: float) -> dict[str, float]:
    """Return the terms [J] as means over frames, their Total, and what the Total does not see.

    Args:
        trajectory: A rollout.
        scene: Its scene.
        root_height: Of the root joint in the first frame [m]: potential energy counts from near it (HOOD).
    """
    assert scene.surface is not None
    assert scene.body_positions is not None
    origin = np.array([0.0, root_height + _ORIGIN_ABOVE_ROOT, 0.0], np.float32)
    metrics = hood_metrics(
        trajectory.positions - origin,
        scene.body_positions - origin,
        scene.surface.faces,
        scene.garment,
        scene.material,
        scene.timestep,
        parameters=HoodParameters(),
        criterion="postcvpr",
    )
    terms = {name: float(np.mean(np.asarray(getattr(metrics.terms, name)))) for name in TERMS}
    frames = measure_frames(trajectory, scene, PhysicsParameters())
    depth = -np.asarray(frames.distances)
    return {
        **terms,
        "total": sum(terms.values()),
        "stretch_p99": float(np.quantile(frames.max_stretch, 0.99)),
        "penetration_p999_mm": float(max(np.quantile(depth, 0.999), 0.0) * 1e3),
    }


def mean_over_garments(measured: dict[str, dict[str, dict[str, float]]]) -> dict[str, dict[str, float]]:
    """Return the mean row of every model."""
    return {
        model: {
            name: float(np.mean([row[name] for row in rows.values()])) for name in next(iter(rows.values()))
        }
        for model, rows in measured.items()
    }


def write(result: dict[str, Any], path: Path) -> None:
    """Write a result with the versions that made it, and print its mean rows."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps({**result, "environment": environment()}, indent=1) + "\n")
    for model, row in result.get("mean", {}).items():
        print(model, " ".join(f"{name} {value:.3g}" for name, value in row.items()))
