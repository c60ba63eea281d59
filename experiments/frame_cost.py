"""Time the parts of a frame of the solver, by size, with strict and with fast contact.

    python experiments/frame_cost.py [--sizes 1k 4k 10k] [--out DIR] [--smoke]
    python experiments/frame_cost.py --sizes 50k 200k --fast  # joins the sizes in the file

A T-shirt in the middle of a walk. The parts are timed alternately, and their least times are also given
relative to one iteration of the solver, so that figures of a busy machine compare with those of an idle one.
Writes frame_cost.json.
"""

import json
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from harness import keep, kept, machine, parser

from eslr_jax.config import SimConfig
from eslr_jax.contact.nearest import find_both_sides
from eslr_jax.pipeline.assets import load_body, load_garment, load_motion
from eslr_jax.pipeline.report.gap import trajectory_states
from eslr_jax.pipeline.report.scene_parts import time_in_turns
from eslr_jax.pose.motion import pose_body
from eslr_jax.simulation.frame import frame_problem
from eslr_jax.simulation.plan import prepare_scene
from eslr_jax.simulation.simulate import simulate
from eslr_jax.simulation.stepper import make_stepper
from eslr_jax.solver.guess import initial_guess
from eslr_jax.solver.potential import corrected
from eslr_jax.solver.preconditioner import stretched_stiffness
from eslr_jax.solver.solve import solve
from eslr_jax.terms import FAST, Contact, scene_terms
from eslr_jax.types import Scene

SIZES = ("1k", "4k", "10k", "50k", "200k")
CASES = {"fast contact": FAST, "strict contact": scene_terms()}
RATIO = "whole frame with strict contact / with fast"
CLIP = "cmu_016_32"
FRAMES = 12  # simulated before the one that is timed
ITERATIONS = 20  # of the whole frame, as in scene_needs.py
FEW, MANY = 5, 25  # iterations between which one is timed


def frame_parts(scene: Scene, iterations: int) -> dict[str, tuple]:
    """Return the parts of the frame after a short rollout of some iterations, as functions with arguments."""
    run = simulate(None, scene, config=SimConfig(iterations=iterations))
    scene = run.scene  # with buffers that sufficed
    states, inputs = trajectory_states(run.trajectory, scene)
    state, step = jax.tree.map(lambda leaf: jnp.asarray(leaf[-1]), (states, inputs))
    problem = jax.jit(frame_problem)(scene, state, step)
    start = jax.jit(initial_guess)(problem)
    surface, blocks = scene.body.surface, scene.garment.vertex_blocks

    @jax.jit
    def minimise(problem, start, iterations):
        return solve(problem, start, iterations=iterations).position

    @jax.jit
    def before(scene, state, step):
        problem = frame_problem(scene, state, step)
        guess = initial_guess(problem)
        return guess, stretched_stiffness(problem, guess.position)

    @jax.jit
    def whole(scene, state, step):
        return make_stepper(None, SimConfig(iterations=ITERATIONS))(frame_problem(scene, state, step), state)

    body = (state.position, step.body.start, step.body.end, surface, blocks)
    parts = {
        "both contacts": (jax.jit(find_both_sides), body),
        "guess": (jax.jit(initial_guess), (problem,)),
        "preconditioner": (jax.jit(stretched_stiffness), (problem, start.position)),
        "all before the first iteration": (before, (scene, state, step)),
        "few": (minimise, (problem, start, FEW)),
        "many": (minimise, (problem, start, MANY)),
        f"whole frame, {ITERATIONS} iterations": (whole, (scene, state, step)),
    }
    if scene.term(Contact) is not None:
        parts["what nothing passes"] = (jax.jit(corrected), (minimise(problem, start, MANY), problem))
    return parts


def measure(size: str, turns: int, frames: int, cases: Sequence[str]) -> dict[str, Any]:
    """Return the milliseconds of every part by case, after some frames, and their ratios to an iteration."""
    poses = pose_body(load_body(), load_motion(CLIP), num_frames=frames + 1)
    garment = load_garment("tshirt", vertices=size)
    calls = {case: frame_parts(prepare_scene(garment, poses, terms=CASES[case]), MANY) for case in cases}
    timed = time_in_turns(
        {(case, part): call for case, parts in calls.items() for part, call in parts.items()}, turns
    )
    # The least of all calls: what else runs on the machine only ever adds.
    times = {case: {part: min(timed[case, part]) for part in parts} for case, parts in calls.items()}
    result: dict[str, Any] = {"vertices": int(np.sum(garment.vertex_mask))}
    for case, parts in times.items():
        parts["one iteration"] = (parts.pop("many") - parts.pop("few")) / (MANY - FEW)
        result[case] = {"ms": parts, "iterations": {k: v / parts["one iteration"] for k, v in parts.items()}}
    if len(cases) == len(CASES):
        without, whole = (times[case][f"whole frame, {ITERATIONS} iterations"] for case in CASES)
        result[RATIO] = whole / without
    return result


def main() -> None:
    options = parser(__doc__, "1k, two frames, one turn")
    options.add_argument("--sizes", nargs="+", default=list(SIZES[:3]), choices=SIZES)
    options.add_argument("--fast", action="store_true", help="leave out the frame with strict contact")
    options.add_argument("--turns", type=int, default=15)
    chosen = options.parse_args()
    sizes, turns, frames = (["1k"], 1, 2) if chosen.smoke else (chosen.sizes, chosen.turns, FRAMES)
    cases = list(CASES)[:1] if chosen.fast else list(CASES)
    path = chosen.out / "frame_cost.json"
    result = {} if chosen.smoke else kept(path)
    for size in sizes:
        row = measure(size, turns, frames, cases)
        print(size, json.dumps(row), flush=True)
        result[size] = {**row, "clip": CLIP, **machine()}
        keep(path, result)


if __name__ == "__main__":
    main()
