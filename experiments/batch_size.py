"""Time rollouts of many scenes by how many go through a step together.

    python experiments/batch_size.py [--vertices 1k] [--batches 1 8 64] [--out DIR] [--smoke]

A T-shirt walks on the clips of the test split, as often as the largest batch asks for. Every frame takes 20
iterations. Writes batch_size.json with the milliseconds of a frame, and of a frame and scene.
"""

from functools import partial
from typing import get_args

import jax
import jax.numpy as jnp
from harness import keep, kept, machine, parser

from eslr_jax import SimConfig, load_body, load_garment, load_motion, pose_body, prepare_scenes
from eslr_jax.fabric.materials import COTTON
from eslr_jax.pipeline.assets import split_clips
from eslr_jax.pipeline.assets.budget import device_name
from eslr_jax.pipeline.assets.garments import Resolution
from eslr_jax.pipeline.report.scene_parts import time_in_turns
from eslr_jax.simulation.batch import rollout_scenes, stack_scenes
from eslr_jax.terms import FAST

CONFIG = SimConfig(iterations=20)


def measure(vertices: Resolution, batches: list[int], frames: int, turns: int) -> list[dict[str, float]]:
    """Return a row for every batch: the quickest of some turns."""
    body, clips = load_body(), split_clips("test")
    poses = [pose_body(body, load_motion(clip), num_frames=frames + 1) for clip in clips]
    garments = [load_garment("tshirt", vertices=vertices)] * len(clips)
    scenes = stack_scenes(prepare_scenes(garments, poses, [COTTON] * len(clips), terms=FAST))
    calls = {}
    for batch in batches:
        places = jnp.arange(batch, dtype=jnp.int32) % len(clips)
        some = jax.tree.map(lambda leaf, places=places: leaf[places], scenes)
        calls[batch] = (partial(rollout_scenes, None, config=CONFIG, batch_size=batch), (some,))
    rows = []
    for batch, times in time_in_turns(calls, turns).items():
        milliseconds = min(times) / frames
        rows.append({"batch": batch, "frame_ms": milliseconds, "frame_and_scene_ms": milliseconds / batch})
        text = f"{milliseconds:.2f} ms a frame, {milliseconds / batch:.3f} a scene"
        print(f"{vertices}, {batch} scenes: {text}")
    return rows


def main() -> None:
    options = parser(__doc__, "batches of 1 and 2, two frames, one turn")
    options.add_argument("--vertices", choices=get_args(Resolution), default="1k")
    options.add_argument("--batches", type=int, nargs="+", default=[1, 8, 64])
    chosen = options.parse_args()
    path = chosen.out / "batch_size.json"
    result = kept(path)
    batches, frames, turns = ([1, 2], 2, 1) if chosen.smoke else (chosen.batches, 20, 3)
    rows = measure(chosen.vertices, batches, frames, turns)
    result[f"{device_name()}, {chosen.vertices}"] = {"rows": rows, **machine()}
    keep(path, result)


if __name__ == "__main__":
    main()
