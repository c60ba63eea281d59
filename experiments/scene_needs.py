"""Only what a scene needs: what each thing that a scene leaves out would have cost.

    python experiments/scene_needs.py [--smoke] [--out DIR]

Pairs of scenes that differ in one thing, stepped in turns by the same solver. Writes scene_needs.json.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from eslr_jax.assets import load_body, load_garment, load_motion
from eslr_jax.body.motion import pose_body, still_motion
from eslr_jax.config import SimConfig
from eslr_jax.contact.nearest import find_both_sides
from eslr_jax.geometry.surface import prepare_surface
from eslr_jax.evaluation.calibrate import device_name
from eslr_jax.evaluation.hard_cases import StressScene, find_case
from eslr_jax.evaluation.hard_cases.simulators import shorten
from eslr_jax.evaluation.report import environment
from eslr_jax.evaluation.scene_parts import take_turns
from eslr_jax.io.atomic import atomic_write
from eslr_jax.physics.materials import COTTON
from eslr_jax.physics.problem import PhysicsParameters
from eslr_jax.scene import SceneOptions, prepare_scene
from eslr_jax.simulation.scan import frame_inputs, simulate_scene
from eslr_jax.types import Scene

RESULTS = Path(__file__).parent / "results"
CLIP = "cmu_016_32"
ITERATIONS = 20  # of the solver


def steps(scene: Scene, config: SimConfig):
    """Return a function that steps through a scene, and its argument."""
    return lambda scene: simulate_scene(None, scene, PhysicsParameters(), config).positions, (scene,)


def compare(pairs: dict[str, tuple], turns: int) -> dict[str, float]:
    """Return medians [ms] of calls in turns, and the ratio of the first to the last."""
    times = take_turns(pairs, turns)
    values = list(times.values())
    return {**times, "ratio": values[0] / values[-1]}


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--vertices", default="4k", choices=["1k", "4k", "10k"])
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--smoke", action="store_true")
    arguments = parser.parse_args()
    frames, turns = (12, 7) if not arguments.smoke else (3, 1)
    if arguments.smoke:
        arguments.vertices = "1k"
    body = load_body()
    poses = pose_body(body, load_motion(CLIP), num_frames=frames)
    shirt = load_garment("tshirt", vertices=arguments.vertices)
    config = SimConfig(simulator="physics", solver_iterations=ITERATIONS)
    whole = prepare_surface(np.asarray(poses.rest_positions), np.asarray(poses.faces))
    scene = prepare_scene(shirt, poses)
    everything = prepare_scene(shirt, poses, surface=whole)
    num_faces = shirt.faces.shape[0]
    by_face = COTTON.replace(
        **{name: jnp.full(num_faces, getattr(COTTON, name)) for name in ("lame_mu", "lame_lambda")}
    )

    def search(scene: Scene):
        frame = jax.tree.map(lambda leaf: leaf[0], frame_inputs(scene))
        return (
            lambda x: find_both_sides(x, frame.body, frame.next_body, scene.surface)[0].distances,
            (scene.start.position,),
        )

    layered = SimConfig(simulator="physics", solver_iterations=ITERATIONS, self_contact=True)

    def skirt() -> Scene:
        """Return the hard case's skirt over trousers, which collide."""
        case = find_case("layers").build({})["skirt over trousers"]
        assert isinstance(case, StressScene)
        return shorten(case, frames).scene

    def still() -> Scene:
        """Return the shirt on a body that does not move."""
        return prepare_scene(shirt, pose_body(body, still_motion(body, frames), num_frames=frames))

    def dress() -> Scene:
        """Return a garment with pins."""
        return prepare_scene(load_garment("dress", vertices=arguments.vertices), poses)

    needed = (scene, config)
    # What is compared with what, as scenes and configurations; the smoke run takes the first of them.
    pairs: dict[str, Callable[[], dict[str, tuple[Scene, SimConfig]]]] = {
        "T-shirt: with a body against without": lambda: {
            "with": needed,
            "without": (prepare_scene(shirt, poses, options=SceneOptions(has_body=False)), config),
        },
        "T-shirt: self-contact against none": lambda: {"with": (scene, layered), "without": needed},
        "T-shirt: whole body against what it reaches": lambda: {
            "whole body": (everything, config),
            "reached": needed,
        },
        "T-shirt: fabric per face against one fabric": lambda: {
            "per face": (prepare_scene(shirt, poses, material=by_face), config),
            "one": needed,
        },
        "dress: pins that move against none": lambda: {
            "pinned": (pinned := dress(), config),
            "free": (pinned.replace(pin_targets=None), config),
        },
        "skirt over trousers: layers that collide against layers that don't": lambda: {
            "with": (short := skirt(), layered),
            "without": (short, config),
        },
        "T-shirt: moving body against a still one": lambda: {"moving": needed, "still": (still(), config)},
        "T-shirt: all of that against what it needs": lambda: {
            "all": (prepare_scene(shirt, poses, surface=whole, material=by_face), layered),
            "needed": needed,
        },
    }
    if arguments.smoke:
        pairs = dict(list(pairs.items())[:1])
    result: dict[str, Any] = {
        "vertices": int(np.sum(shirt.vertex_mask)),
        "frames": frames - 1,
        "solver_iterations": ITERATIONS,
        "contact search: whole body against what the T-shirt reaches": {
            "body_faces": [int(whole.faces.shape[0]), int(scene.surface.faces.shape[0])],
            **compare({"whole body": search(everything), "reached": search(scene)}, turns),
        },
    }
    for name, scenes in pairs.items():
        result[name] = compare({label: steps(*pair) for label, pair in scenes().items()}, turns)
        print(f"{name}: {result[name]['ratio']:.2f}x", flush=True)
    result |= {"device": device_name(), "environment": environment()}
    arguments.out.mkdir(parents=True, exist_ok=True)
    with atomic_write(arguments.out / "scene_needs.json") as temporary:
        temporary.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
