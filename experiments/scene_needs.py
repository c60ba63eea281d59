"""Measure what each part that a scene leaves out would have cost.

    python experiments/scene_needs.py [--smoke] [--out DIR]

The same solver steps two scenes that differ in one part, and they are timed alternately. Writes scene_needs.json.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from harness import keep, machine, parser

from eslr_jax.config import SimConfig
from eslr_jax.contact.nearest import find_both_sides
from eslr_jax.fabric.materials import COTTON
from eslr_jax.pipeline.assets import load_body, load_garment, load_motion
from eslr_jax.pipeline.report.scene_parts import take_turns
from eslr_jax.pose.motion import pose_body, still_motion
from eslr_jax.pose.retarget import ARM_ABDUCTION
from eslr_jax.simulation.frame import frame_inputs
from eslr_jax.simulation.plan import prepare_scene
from eslr_jax.simulation.rollout import rollout_scene
from eslr_jax.terms import CLOTH, FAST, Air, scene_terms
from eslr_jax.types import Scene

CLIP = "cmu_016_32"
ITERATIONS = 20  # of the solver
Pair = dict[str, Scene]  # two scenes by their labels; the first has more parts


def compare_searches(pair: Pair, turns: int) -> dict[str, Any]:
    """Return the milliseconds of both scenes' contact searches, their ratio, and the faces searched."""

    def search(scene: Scene) -> tuple[Callable, tuple]:
        first = jax.tree.map(lambda leaf: leaf[0], frame_inputs(scene)).body

        def nearest(x: jax.Array) -> jax.Array:
            return find_both_sides(x, *first, scene.body.surface, scene.garment.vertex_blocks)[0].distances

        return nearest, (scene.initial_state.position,)

    faces = [int(scene.body.surface.faces.shape[0]) for scene in pair.values()]
    times = take_turns({name: search(scene) for name, scene in pair.items()}, turns)
    return {"body_faces": faces, **ratio_of(times)}


def ratio_of(times: dict[str, float]) -> dict[str, float]:
    """Return two times with the ratio of the first to the second."""
    first, second = times.values()
    return {**times, "ratio": first / second}


def main() -> None:
    options = parser(__doc__, "1k, three frames, one pair, one turn")
    options.add_argument("--vertices", default="4k", choices=["1k", "4k", "10k"])
    chosen = options.parse_args()
    frames, turns = (3, 1) if chosen.smoke else (12, 7)
    if chosen.smoke:
        chosen.vertices = "1k"
    body = load_body()
    poses = pose_body(body, load_motion(CLIP), num_frames=frames)
    shirt = load_garment("tshirt", vertices=chosen.vertices)
    whole = poses.surface
    by_face = COTTON.replace(
        **{name: jnp.full(shirt.faces.shape[0], getattr(COTTON, name)) for name in ("lame_mu", "lame_lambda")}
    )
    scene = prepare_scene(shirt, poses)
    still = pose_body(body, still_motion(body, frames, arm_angle=ARM_ABDUCTION), num_frames=frames)
    pinned = partial(prepare_scene, load_garment("dress", vertices=chosen.vertices), poses)

    def modelled(**options: Any) -> Scene:
        return prepare_scene(shirt, poses, **options)

    # Each pair is built when its turn comes; the smoke run takes the first.
    pairs: dict[str, Callable[[], Pair]] = {
        "T-shirt: with a body against without": lambda: {"with": scene, "without": modelled(terms=CLOTH)},
        "T-shirt: strict contact against fast": lambda: {
            "strict": scene, "fast": modelled(terms=FAST),
        },
        "T-shirt: BDF2 against implicit Euler": lambda: {"bdf2": modelled(integrator="bdf2"), "euler": scene},
        "T-shirt: air that moves against none": lambda: {
            "with": modelled(terms=scene_terms(Air((3.0, 0.0, 0.0)))), "without": scene,
        },
        "T-shirt: whole body against what it reaches": lambda: {"whole body": everything, "reached": scene},
        "T-shirt: fabric per face against one fabric": lambda: {
            "per face": prepare_scene(shirt, poses, material=by_face), "one": scene,
        },
        "dress: pins that move against none": lambda: {
            "pinned": pinned(), "free": pinned().replace(pin_targets=None),
        },
        "T-shirt: moving body against a still one": lambda: {
            "moving": scene, "still": prepare_scene(shirt, still),
        },
        "T-shirt: all of that against what it needs": lambda: {
            "all": prepare_scene(shirt, poses, surface=whole, material=by_face), "needed": scene,
        },
    }  # fmt: skip
    everything = prepare_scene(shirt, poses, surface=whole)
    if chosen.smoke:
        pairs = dict(list(pairs.items())[:1])
    result: dict[str, Any] = {
        "vertices": int(np.sum(shirt.vertex_mask)),
        "frames": frames - 1,
        "iterations": ITERATIONS,
        "contact search: whole body against what the T-shirt reaches": compare_searches(
            {"whole body": everything, "reached": scene}, turns
        ),
    }
    step = partial(rollout_scene, None, config=SimConfig(iterations=ITERATIONS))
    for name, build in pairs.items():
        calls = {label: (step, (one,)) for label, one in build().items()}
        result[name] = ratio_of(take_turns(calls, turns))
        print(f"{name}: {result[name]['ratio']:.2f}x", flush=True)
    keep(chosen.out / "scene_needs.json", {**result, **machine()})


if __name__ == "__main__":
    main()
