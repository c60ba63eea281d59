"""Count where cloth passes through itself, with and without self-contact, and what keeping it apart costs.

    python experiments/self_contact.py [--smoke] [--out DIR]

A T-shirt on the six test clips, by the solver; the referee of the hard cases counts intersecting pairs of faces,
also without the first frame, which is skinned and crosses anyhow. Writes self_contact_1k.json.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from eslr_jax.assets import load_body, load_garment, load_motion, load_splits
from eslr_jax.body.motion import pose_body
from eslr_jax.config import SimConfig
from eslr_jax.evaluation.referee import judge
from eslr_jax.evaluation.report import environment
from eslr_jax.io.atomic import atomic_write
from eslr_jax.scene.plan import SceneOptions, prepare_scene, shared_surface
from eslr_jax.simulation.budget import device_name
from eslr_jax.simulation.simulate import simulate

RESULTS = Path(__file__).parent / "results"
FRAMES = 61  # two seconds
ITERATIONS = 40  # of the solver
EVERY = 5  # frames between those that are judged
TURNS = 2  # of every rollout; the faster one counts


def measure(garment: str, clip: str, vertices: str, frames: int) -> dict[str, Any]:
    """Return intersecting pairs of cloth faces over a rollout and milliseconds a frame, with and without."""
    cloth = load_garment(garment, vertices=vertices)
    poses = pose_body(load_body(), load_motion(clip), num_frames=frames)
    surface = shared_surface([cloth], poses)  # all clips then share a program
    scenes = {
        label: prepare_scene(cloth, poses, surface=surface, options=SceneOptions(self_contact=has_layers))
        for label, has_layers in (("without", False), ("with", True))
    }
    runs = [
        {
            label: simulate(None, scene, config=SimConfig(iterations=ITERATIONS))
            for label, scene in scenes.items()
        }
        for _ in range(TURNS)
    ]
    result: dict[str, Any] = {"garment": garment, "clip": clip, "vertices": vertices}
    for label, run in runs[0].items():
        positions = np.asarray(run.trajectory.positions)[::EVERY]
        counts = [judge(position, np.asarray(cloth.faces)).cloth_cloth for position in positions]
        result[label] = {
            "first": counts[0],
            "mean": float(np.mean(counts)),
            "later": float(np.mean(counts[1:])),
        }
        result[label]["frame_ms"] = min(turn[label].timing.frame_ms for turn in runs)
        if run.trajectory.pair_demand is not None:
            result[label]["pairs"] = int(np.max(run.trajectory.pair_demand))
            result[label]["rows"] = run.scene.self_contact.pairs
    return result


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--vertices", default="1k", choices=["1k", "4k", "10k"])
    parser.add_argument("--garments", nargs="+", default=["tshirt"])
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--smoke", action="store_true", help="T-shirt at 1k, one clip, six frames")
    arguments = parser.parse_args()
    clips, garments, frames = load_splits()["motions"]["test"], arguments.garments, FRAMES
    if arguments.smoke:
        clips, garments, frames, arguments.vertices = clips[:1], ["tshirt"], 6, "1k"
    rows = []
    for garment in garments:
        for clip in clips:
            rows.append(row := measure(garment, clip, arguments.vertices, frames))
            print(json.dumps(row), flush=True)
    result = {"rows": rows, "frames": frames, "iterations": ITERATIONS}
    result |= {"device": device_name(), "environment": environment()}
    arguments.out.mkdir(parents=True, exist_ok=True)
    with atomic_write(arguments.out / f"self_contact_{arguments.vertices}.json") as temporary:
        temporary.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
