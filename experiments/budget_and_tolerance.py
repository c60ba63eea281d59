"""Measure whether `--budget` and `--tolerance` are kept on clips that the calibration has not seen.

    python experiments/budget_and_tolerance.py [--parts tolerance budget] [--sizes 1k 4k] [--smoke] [--out DIR]

A frame keeps a tolerance if its optimality gap is at most that share of its initial gap; frames are those of
free rollouts on the test clips. A rollout keeps a budget if its mean time per frame does. That includes the
first ten frames, whose iterations come from the calibration alone.

Writes budget_and_tolerance.json; a part that is not measured anew stays in it. Budgets need an idle machine.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from harness import kept, machine, parser, put

from eslr_jax import SimConfig, load_body, load_garment, load_motion, pose_body, prepare_scene, simulate
from eslr_jax.config import MOST_ITERATIONS
from eslr_jax.fabric.materials import COTTON
from eslr_jax.pipeline.assets import split_clips
from eslr_jax.pipeline.assets.budget import Calibration, first_iterations, keep_budget, read_calibration
from eslr_jax.pipeline.report.gap import trajectory_gap
from eslr_jax.simulation.plan import prepare_scenes
from eslr_jax.simulation.rollout import rollout_scene
from eslr_jax.terms import FAST
from eslr_jax.types import Scene

GARMENTS = ("tshirt", "dress", "pants")
TOLERANCES = (0.01, 0.001)
PARTS = ("tolerance", "budget")
BUDGETS = (1.5, 3.0, 6.0)  # multiples of the fastest frame that the calibration knows of
EVERY = 2  # frames between those whose gap is measured


def measure_tolerance(scenes: Sequence[Scene], tolerance: float) -> dict[str, Any]:
    """Return how many of the frames keep a relative gap; scenes are of one resolution."""
    config = SimConfig(iterations=MOST_ITERATIONS, tolerance=tolerance)
    shares, spent = [], []
    for scene in scenes:
        trajectory = rollout_scene(None, scene, config)
        gap = trajectory_gap(trajectory, scene, every=EVERY)
        shares.append(np.asarray(gap.share(gap.reached)))
        spent.append(float(np.mean(trajectory.iterations[1:])))
    joined = np.concatenate(shares)
    return {
        "tolerance": tolerance,
        "frames": len(joined),
        "kept": float(np.mean(joined <= tolerance)),
        "gap_relative_median": float(np.median(joined)),
        "gap_relative_p99": float(np.quantile(joined, 0.99)),
        "iterations_mean": float(np.mean(spent)),
        "iterations_allowed": MOST_ITERATIONS,
    }


def measure_budget(calibration: Calibration, scene: Scene, factor: float) -> dict[str, Any]:
    """Return how long frames take with a budget, a multiple of the fastest frame that the calibration knows."""
    cost = calibration.cost(int(np.sum(scene.garment.vertex_mask)))
    budget = factor * cost.frame_ms(1)
    iterations = first_iterations(cost, budget)
    config = SimConfig(iterations=iterations, tolerance=0.0)
    simulation = simulate(None, scene, config=config, pace=keep_budget(cost, budget))
    return {
        "iterations": iterations,
        "iterations_mean": float(np.mean(simulation.trajectory.iterations[1:])),
        "budget_ms": budget,
        "frame_ms": simulation.timing.frame_ms,
    }


def main() -> None:
    options = parser(__doc__, "one garment, clip, tolerance and budget")
    options.add_argument("--parts", nargs="+", default=PARTS, choices=PARTS)
    options.add_argument("--sizes", nargs="+", default=["1k", "4k"])
    options.add_argument(
        "--calibration", type=Path, help="calibration to choose by; by default that of `eslr simulate`"
    )
    chosen = options.parse_args()
    garments, clips, frames, tolerances, budgets = GARMENTS, split_clips("test"), 40, TOLERANCES, BUDGETS
    if chosen.smoke:
        garments, clips, frames, chosen.sizes = garments[:1], clips[:1], 6, ["1k"]
        tolerances, budgets = tolerances[:1], budgets[:1]
    body = load_body()
    motions = [pose_body(body, load_motion(clip), num_frames=frames) for clip in clips]
    calibration = read_calibration(chosen.calibration)
    path = chosen.out / "budget_and_tolerance.json"
    about = {"clips": clips, "calibrated_on": calibration.device, **machine()}
    for size in chosen.sizes:
        cloths = {garment: load_garment(garment, vertices=size) for garment in garments}
        tasks = tolerances if "tolerance" in chosen.parts else ()
        scenes = []
        for cloth in cloths.values() if tasks else ():  # one body surface for all clips, so one compilation
            scenes += prepare_scenes([cloth] * len(clips), motions, [COTTON] * len(clips), terms=FAST)
        for tolerance in tasks:
            row = {"size": size, **measure_tolerance(scenes, tolerance)}
            put(path, "tolerance", row, ("size", "tolerance"), about)
            print(f"{size}: {tolerance:.1%} kept by {row['kept']:.2%} of {row['frames']} frames", flush=True)
        for garment, cloth in cloths.items() if "budget" in chosen.parts else ():
            scene = prepare_scene(cloth, motions[0], terms=FAST)  # not padded to a common size
            for factor in budgets:
                row = {"size": size, "garment": garment, "factor": factor}
                row |= measure_budget(calibration, scene, factor)
                put(path, "budget", row, ("size", "garment", "factor"), about)
                text = f"budget {row['budget_ms']:.1f} ms, took {row['frame_ms']:.1f} ms"
                print(f"{size} {garment}: {text}", flush=True)
        jax.clear_caches()
    if ratios := [row["frame_ms"] / row["budget_ms"] for row in kept(path).get("budget", [])]:
        print(f"time over budget, median: {np.median(ratios):.2f}")


if __name__ == "__main__":
    main()
