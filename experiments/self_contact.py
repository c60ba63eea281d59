"""Count where cloth passes through itself, with and without self-contact, and what keeping it apart costs.

    python experiments/self_contact.py [--garments tshirt pants] [--starts 3] [--smoke] [--out DIR]

Garments on the six test clips with what `eslr simulate` models: put on over the rest pose, BDF2, skin contacts, a
tolerance of 1 %. The last row of every clip begins on the first pose instead. The referee of the hard cases
counts intersecting pairs of faces of the cloth. Folds are chaotic: what the command models is also simulated from
starts that differ by 1e-5 m. Writes self_contact_1k.json.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import numpy as np
from harness import keep, machine, parser

from eslr_jax.config import SimConfig
from eslr_jax.pipeline.assets import load_body, load_garment, load_motion, load_splits
from eslr_jax.pipeline.report.referee import judge
from eslr_jax.pose.motion import pose_body
from eslr_jax.pose.timing import SETTLE_FRAMES, with_settling
from eslr_jax.simulation.plan import prepare_scene, shared_surface
from eslr_jax.simulation.simulate import simulate
from eslr_jax.terms import Collision, Repulsion, scene_terms
from eslr_jax.types import Scene

FRAMES = 61  # two seconds
EVERY = 5  # frames between those that are judged
CONFIG = SimConfig(iterations=300, tolerance=0.01)
_STARTS_APART = 1e-5  # [m] standard deviation


def measure(garment: str, clip: str, vertices: str, frames: int, starts: int) -> Iterator[dict[str, Any]]:
    """Yield intersecting pairs of cloth faces over rollouts, and milliseconds a frame."""
    cloth, body = load_garment(garment, vertices=vertices), load_body()
    poses = pose_body(body, load_motion(clip), num_frames=frames)
    surface = shared_surface([cloth], poses)  # all clips then share a program
    kinds = [(True, False, 0), *((True, True, number) for number in range(starts)), (False, False, 0)]
    for is_put_on, has_layers, number in kinds:
        layers = {} if has_layers else {"without": (Repulsion,)}
        terms = scene_terms(Collision(has_skin=True), Repulsion(where="all"), **layers)
        moving = with_settling(poses, SETTLE_FRAMES, body if is_put_on else None)
        scene = moved(prepare_scene(cloth, moving, surface=surface, terms=terms, integrator="bdf2"), number)
        run = simulate(None, scene, config=CONFIG)
        positions = np.asarray(run.trajectory.positions)
        start, *counts = (
            judge(position, np.asarray(cloth.faces)).cloth_cloth
            for position in (positions[0], *positions[SETTLE_FRAMES::EVERY])
        )
        trajectory = run.trajectory
        row = {
            "garment": garment, "clip": clip, "vertices": vertices,
            "put_on": is_put_on, "self_contact": has_layers, "number": number,
            "start": start, "pairs": counts, "mean": float(np.mean(counts)),
            "residual_max": float(np.max(trajectory.residuals)),
            "iterations": float(np.mean(trajectory.iterations)),
            "frame_ms": run.timing.frame_ms,
        }  # fmt: skip
        if trajectory.demands:
            found = int(np.max(trajectory.demands["repulsion"]))
            row |= {"pairs_found": found, "rows": run.scene.term(Repulsion).num_rows}
        yield row


def moved(scene: Scene, number: int) -> Scene:
    """Return a scene that begins a little elsewhere; number zero is where it is."""
    if number == 0:
        return scene
    state = scene.initial_state
    noise = np.random.default_rng(number).normal(scale=_STARTS_APART, size=state.position.shape)
    return scene.replace(initial_state=state.replace(position=state.position + noise.astype(np.float32)))


def main() -> None:
    options = parser(__doc__, "T-shirt at 1k, one clip, six frames")
    options.add_argument("--vertices", default="1k", choices=["1k", "4k", "10k"])
    options.add_argument("--garments", nargs="+", default=["tshirt", "longsleeve", "dress", "pants"])
    options.add_argument("--starts", type=int, default=3, help="of the rollouts with self-contact")
    chosen = options.parse_args()
    clips, garments, frames = load_splits()["motions"]["test"], chosen.garments, FRAMES
    if chosen.smoke:
        clips, garments, frames, chosen.vertices = clips[:1], ["tshirt"], 6, "1k"
        chosen.starts = 1
    rows = []
    for garment in garments:
        for clip in clips:
            for row in measure(garment, clip, chosen.vertices, frames, chosen.starts):
                rows.append(row)
                print(json.dumps(row), flush=True)
    result = {"rows": rows, "frames": frames, "settle": SETTLE_FRAMES, "every": EVERY, **machine()}
    keep(chosen.out / f"self_contact_{chosen.vertices}.json", result)


if __name__ == "__main__":
    main()
