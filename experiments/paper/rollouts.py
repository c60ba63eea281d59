"""Free rollouts, measured by HOOD's six terms and their Total, as in its tables and the paper's."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from hood_metrics import hood_metrics

from eslr_jax.assets import load_body, load_garment, load_motion
from eslr_jax.body.motion import pose_body
from eslr_jax.config import ModelConfig, SimConfig
from eslr_jax.evaluation.calibrate import simulator_of
from eslr_jax.evaluation.evaluate import back_and_forth
from eslr_jax.evaluation.metrics import measure_frames
from eslr_jax.evaluation.report import environment
from eslr_jax.io.atomic import atomic_write
from eslr_jax.physics.hood import HoodParameters
from eslr_jax.physics.materials import COTTON
from eslr_jax.scene.plan import prepare_scenes
from eslr_jax.simulation.budget import SOLVER
from eslr_jax.simulation.rollout import rollout_scene
from eslr_jax.types import Scene, Trajectory

RESULTS = Path(__file__).parents[1] / "results" / "paper"
OPTIMUM = "optimum"
TERMS = ("stretch", "bending", "inertia", "collision", "friction", "gravity")
_ORIGIN_ABOVE_ROOT = 0.22  # [m]; SMPL's origin, from which HOOD counts heights, is this far above the pelvis
_OPTIMUM_ITERATIONS = 60  # of L-BFGS: leaves 0.05 % of the initial gap


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
    """Return weights, configuration and garment options of a network, or of the optimum.

    Args:
        model: Name of a bundled network, NAME+20 for twenty solver iterations behind it, or `OPTIMUM`.
    """
    if model == OPTIMUM:
        return *simulator_of(SOLVER, _OPTIMUM_ITERATIONS), {}
    name, _, iterations = model.partition("+")
    params, config = simulator_of(name, int(iterations or 0))
    return params, config, embedding_options(config.model)


def embedding_options(config: ModelConfig | None) -> dict[str, Any]:
    """Return the options of `load_garment` that a network asks for."""
    names = ("embedding_size", "embedding_mode")
    return {} if config is None else {name: getattr(config, name) for name in names}


def table(
    models: Sequence[str],
    garments: Sequence[str],
    clips: Sequence[str],
    *,
    vertices: str = "1k",
    frames: int = 150,
    **garment_options: Any,
) -> dict[str, dict[str, dict[str, float]]]:
    """Return the measures of every model on every garment, as means over clips.

    Args:
        models: Names as `simulator` takes them.
        garments: Names of bundled garments.
        clips: Names of bundled clips, played back and forth.
        vertices: Resolution of the garments.
        frames: Length of every rollout.
        garment_options: Options of `load_garment` in place of the model's own.
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
        worn = [cloth for cloth in cloths for _ in motions]
        scenes = iter(prepare_scenes(worn, motions * len(cloths), [COTTON] * len(worn)))
        measured[model] = {}
        for garment in garments:
            rows = []
            for poses in motions:
                scene = next(scenes)
                trajectory = rollout_scene(params, scene, config)
                root = poses.joint_transforms[0, 0] @ np.append(np.asarray(body.joint_rest_positions[0]), 1.0)
                rows.append(measure(trajectory, scene, float(root[1])))
            measured[model][garment] = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
            print(garment, model, {name: round(value, 4) for name, value in measured[model][garment].items()})
    return measured


def measure(trajectory: Trajectory, scene: Scene, root_height: float) -> dict[str, float]:
    """Return the terms [J] as means over frames, their Total, and stretch and penetration beside it.

    Args:
        trajectory: A rollout.
        scene: Its scene, with a body.
        root_height: Height of the root joint in the first frame [m]; HOOD counts potential energy from near it.
    """
    origin = np.array([0.0, root_height + _ORIGIN_ABOVE_ROOT, 0.0], np.float32)
    metrics = hood_metrics(
        trajectory.positions, scene, origin=origin, parameters=HoodParameters(), criterion="postcvpr"
    )
    terms = {name: float(np.mean(getattr(metrics.terms, name))) for name in TERMS}
    frames = measure_frames(trajectory, scene)
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
