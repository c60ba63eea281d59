"""Whether `--budget` and `--tolerance` are kept: what they choose from the calibration, on clips it has not seen.

    python experiments/budget_and_tolerance.py [--smoke] [--out DIR]

A tolerance is kept by a frame that leaves at most that share of its drop above the optimum; counted over frames
of free rollouts on the test clips. A budget is kept by the mean time per frame of a rollout, the first ten
frames, which go by the calibration alone, included.
Writes budget_and_tolerance.json.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np

from eslr_jax.assets import load_body, load_garment, load_motion, load_splits
from eslr_jax.body.motion import pose_body
from eslr_jax.evaluation.calibrate import (
    Choice,
    choose,
    device_name,
    keep_budget,
    methods_at,
    read_calibration,
    simulator_of,
)
from eslr_jax.evaluation.gap import trajectory_gap
from eslr_jax.evaluation.report import environment
from eslr_jax.io.atomic import atomic_write
from eslr_jax.physics.problem import PhysicsParameters
from eslr_jax.rollout import rollout_in_chunks
from eslr_jax.scene import prepare_scene, prepare_scenes
from eslr_jax.simulation.scan import simulate_scene
from eslr_jax.types import Scene

RESULTS = Path(__file__).parent / "results"
GARMENTS = ("tshirt", "dress", "pants")
TOLERANCES = (0.01, 0.001)
BUDGETS = (1.5, 3.0, 6.0)  # multiples of the fastest frame that the calibration knows of
EVERY = 5  # frames between those whose gap is measured


def frame_shares(choice: Choice, scene: Scene, every: int) -> tuple[np.ndarray, float]:
    """Return the gap of frames of a free rollout over their drop, and the mean of iterations spent."""
    params, config = simulator_of(choice.method, tolerance=choice.tolerance)
    parameters = PhysicsParameters()
    trajectory = simulate_scene(params, scene, parameters, config, choice.iterations)
    ends = trajectory_gap(trajectory, scene, parameters, every=every)
    shares = np.asarray(ends.share(ends.answer))
    return shares, float(np.mean(np.asarray(trajectory.iterations)[1:]))


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sizes", nargs="+", default=["1k", "4k"])
    parser.add_argument(
        "--calibration", type=Path, help="this device's own, or the shipped one, if not given"
    )
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--smoke", action="store_true")
    arguments = parser.parse_args()
    garments, clips, frames, every = GARMENTS, load_splits()["motions"]["test"], 40, EVERY
    tolerances, budgets = TOLERANCES, BUDGETS
    if arguments.smoke:
        garments, clips, frames, every, arguments.sizes = garments[:1], clips[:1], 6, 2, ["1k"]
        tolerances, budgets = tolerances[:1], budgets[:1]
    body = load_body()
    motions = [pose_body(body, load_motion(clip), num_frames=frames) for clip in clips]
    calibration = read_calibration(arguments.calibration)
    kept: dict[str, list[dict[str, Any]]] = {"tolerance": [], "budget": []}
    for size in arguments.sizes:
        shares: dict[float, list[np.ndarray]] = {tolerance: [] for tolerance in tolerances}
        chosen: dict[float, list[Choice]] = {tolerance: [] for tolerance in tolerances}
        spent: dict[float, list[float]] = {tolerance: [] for tolerance in tolerances}
        for garment in garments:
            cloth = load_garment(garment, vertices=size)
            scenes = prepare_scenes([cloth] * len(clips), motions)  # one body surface, so one compilation
            count = int(np.sum(scenes[0].garment.vertex_mask))
            for tolerance in tolerances:
                choice = choose(calibration, count, tolerance=tolerance)
                chosen[tolerance].append(choice)
                for scene in scenes:
                    left, iterations = frame_shares(choice, scene, every)
                    shares[tolerance].append(left)
                    spent[tolerance].append(iterations)
            least = min(m.fixed_ms + m.iteration_ms for m in methods_at(calibration, count))
            choices = {
                factor * least: choose(calibration, count, budget_ms=factor * least) for factor in budgets
            }
            alone = prepare_scene(cloth, motions[0])  # not padded to the clips' common size
            for budget, choice in choices.items():
                params, config = simulator_of(choice.method, choice.iterations)
                trajectory, timing = rollout_in_chunks(
                    params, alone, config=config, pace=keep_budget(choice, budget)
                )
                took, spent_mean = timing.frame_ms, float(np.mean(np.asarray(trajectory.iterations)[1:]))
                row = {"size": size, "garment": garment, "method": choice.method}
                row |= {"iterations": choice.iterations, "iterations_mean": spent_mean}
                row |= {"budget_ms": budget, "frame_ms": took}
                kept["budget"].append(row)
                print(f"{size} {garment}: budget {budget:.1f} ms, took {took:.1f} ms", flush=True)
            jax.clear_caches()
        for tolerance in tolerances:
            joined = np.concatenate(shares[tolerance])
            row = {
                "size": size,
                "tolerance": tolerance,
                "methods": sorted({choice.method for choice in chosen[tolerance]}),
                "frames": len(joined),
                "kept": float(np.mean(joined <= tolerance)),
                "gap_relative_median": float(np.median(joined)),
                "gap_relative_p99": float(np.quantile(joined, 0.99)),
                "iterations_mean": float(np.mean(spent[tolerance])),
                "iterations_allowed": max(choice.iterations for choice in chosen[tolerance]),
            }
            kept["tolerance"].append(row)
            print(f"{size}: tolerance {tolerance:.1%} kept by {row['kept']:.2%} of {len(joined)} frames")
    ratios = [row["frame_ms"] / row["budget_ms"] for row in kept["budget"]]
    result = {
        "clips": clips,
        **kept,
        "budget_ratio_median": float(np.median(ratios)),
        "calibrated_on": calibration.device,
        "processor": device_name(),
        **environment(),
    }
    print(f"time over budget, median: {result['budget_ratio_median']:.2f}")
    arguments.out.mkdir(parents=True, exist_ok=True)
    with atomic_write(arguments.out / "budget_and_tolerance.json") as temporary:
        temporary.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
