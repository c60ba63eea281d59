"""Measure how fast the frame solvers converge, and what they cost against the paper's network.

    python experiments/solver_convergence.py                  # all scenes, then the cost
    python experiments/solver_convergence.py tshirt_1k ball_4k
    python experiments/solver_convergence.py cost
    python experiments/solver_convergence.py --smoke --out DIR

Frames are taken from a solved rollout. Each is solved by L-BFGS with 5 to 200 iterations and four
preconditioners, and by projected Newton from two starts: the solver's initial guess, and the result of L-BFGS
from the positions at the beginning of the frame. The relative gap is (E - E*) / (E_0 - E*) in float64, where
E_0 is the potential of the pushed-out inertial guess and E* the lowest potential that any method found.

Scenes of solver_convergence.json that are not measured anew stay as they are.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from eslr_jax.assets import load_body, load_garment, load_motion
from eslr_jax.body.motion import pose_body
from eslr_jax.config import SimConfig
from eslr_jax.evaluation.gap import trajectory_states
from eslr_jax.evaluation.report import environment
from eslr_jax.evaluation.scene_parts import time_in_turns
from eslr_jax.io.atomic import atomic_write
from eslr_jax.models.registry import MODELS, init_model
from eslr_jax.physics.guess import initial_guess, push_out, pushed_out_guess
from eslr_jax.physics.lbfgs import Stop, minimize
from eslr_jax.physics.newton import minimize_newton, potential_float64
from eslr_jax.physics.potential import potential
from eslr_jax.physics.preconditioner import (
    Stiffness,
    hessian_diagonal,
    solve_stiffness,
    stiffness,
    stretched_stiffness,
)
from eslr_jax.scene.plan import prepare_scene
from eslr_jax.simulation.frame import frame_problem
from eslr_jax.simulation.network import predict
from eslr_jax.simulation.rollout import rollout_scene
from eslr_jax.terms.problem import FrameProblem
from eslr_jax.types import ClothState, Scene

RESULTS = Path(__file__).resolve().parent / "results"
COUNTS = (5, 10, 20, 50, 100, 200)  # L-BFGS iterations
CLIP = "cmu_016_32"
LAST_FRAME = 40  # frames are spread from the second to this one
TRUTH_ITERATIONS = 150  # of the rollout that supplies the states
SECOND_START_ITERATIONS = 600
MODEL = "eslr-15"
TURNS = 7

Positions = Float[Array, "vertices 3"]


def without_springs(problem: FrameProblem, diagonal: Float[Array, " vertices"]) -> Stiffness:
    """Return a diagonal matrix [N/m]; the constant by which its approximate inverse is off is divided out."""
    neighbors = problem.garment.neighbors
    matrix = Stiffness(diagonal, neighbors, jnp.zeros(neighbors.shape, diagonal.dtype))
    is_one = solve_stiffness(matrix, jnp.stack([diagonal] * 3, axis=-1))[:, 0]
    return matrix.replace(diagonal=diagonal * is_one)


def mean_diagonal(problem: FrameProblem, position: Positions) -> Stiffness:
    """Return the same stiffness for every vertex: L-BFGS is then plain, apart from its first step's length."""
    diagonal, is_real = hessian_diagonal(problem, position), problem.garment.vertex_mask
    mean = jnp.sum(jnp.where(is_real, diagonal, 0.0)) / jnp.sum(is_real)
    return without_springs(problem, jnp.full_like(diagonal, mean))


def diagonal(problem: FrameProblem, position: Positions) -> Stiffness:
    """Return the diagonal of the Hessian."""
    return without_springs(problem, hessian_diagonal(problem, position))


PRECONDITIONERS = {
    "plain": mean_diagonal,
    "diagonal": diagonal,
    "springs": stiffness,
    "stretched": stretched_stiffness,  # the solver's
}


@partial(jax.jit, static_argnames="preconditioner")
def lbfgs(start: Positions, problem: FrameProblem, iterations: int, preconditioner: str) -> Positions:
    """Return positions [m] after so many iterations; their number is traced, so all share a program."""
    matrix = PRECONDITIONERS[preconditioner](problem, start)
    return minimize(lambda x: potential(x, problem), start, matrix, Stop(iterations)).position


def make_scene(name: str) -> Scene:
    """Return a scene by name: garment or ball, and its resolution."""
    what, size = name.split("_")
    if what == "ball":
        from hard_cases import drop_scene

        return drop_scene({}, columns={"1k": 33, "4k": 65}[size], seconds=(LAST_FRAME + 1) / 30).scene
    poses = pose_body(load_body(), load_motion(CLIP), num_frames=LAST_FRAME + 2)
    return prepare_scene(load_garment(what, vertices=size), poses)


def solved_frames(scene: Scene, count: int) -> list[tuple[FrameProblem, ClothState]]:
    """Return frames spread over a solved rollout: the problem of each, and the state it starts from."""
    trajectory = rollout_scene(None, scene, SimConfig(iterations=TRUTH_ITERATIONS))
    states, inputs = trajectory_states(trajectory, scene)
    build = jax.jit(frame_problem)
    taken = []
    for frame in np.linspace(1, LAST_FRAME, count).round().astype(int):
        state, given = jax.tree.map(lambda leaf, frame=frame: leaf[frame], (states, inputs))
        taken.append((build(scene, state, given), state))
    return taken


def measure_frame(problem: FrameProblem, newton_iterations: int) -> dict[str, Any]:
    """Return the potentials [J] after every number of iterations, those of Newton, and how Newton ended."""
    energy = partial(potential_float64, problem=problem)
    start = initial_guess(problem).position
    curves = {
        name: [energy(lbfgs(start, problem, count, name)) for count in COUNTS] for name in PRECONDITIONERS
    }
    newton = partial(minimize_newton, problem, max_iterations=newton_iterations)
    began = time.process_time()
    first = newton(np.asarray(start, np.float64))
    seconds = time.process_time() - began
    near = lbfgs(push_out(problem, problem.position), problem, SECOND_START_ITERATIONS, "stretched")
    second = newton(np.asarray(near, np.float64))
    return {
        "guess": energy(pushed_out_guess(problem)),
        "curves": curves,
        "newton": [first.value, second.value],
        "residuals": [first.residual, second.residual],
        "iterations": [first.iterations, second.iterations],
        "cpu_s": seconds,
    }


def measure_scene(name: str, frames: int, newton_iterations: int) -> dict:
    """Return the figures of one scene."""
    scene = make_scene(name)
    measured = []
    for number, (problem, _) in enumerate(solved_frames(scene, frames)):
        entry = measure_frame(problem, newton_iterations)
        measured.append(entry)
        print(f"{name} frame {number}: Newton {entry['iterations']}, {entry['residuals']}", flush=True)
    best = np.array([min(min(map(min, entry["curves"].values())), *entry["newton"]) for entry in measured])
    initial_gap = np.array([entry["guess"] for entry in measured]) - best
    ends = np.array([entry["newton"] for entry in measured])
    residuals = np.array([entry["residuals"] for entry in measured])
    gaps = {
        kind: (np.array([entry["curves"][kind] for entry in measured]) - best[:, None]) / initial_gap[:, None]
        for kind in PRECONDITIONERS
    }

    def by_count(values: np.ndarray) -> dict[str, float]:
        return {str(count): float(f"{value:.3g}") for count, value in zip(COUNTS, values, strict=True)}

    result: dict = {
        "vertices": int(np.sum(scene.garment.vertex_mask)),
        "frames": len(measured),
        "initial_gap_j": {"median": float(np.median(initial_gap)), "least": float(initial_gap.min())},
        "gap_median": {kind: by_count(np.median(gap, axis=0)) for kind, gap in gaps.items()},
        "gap_largest": {kind: by_count(np.max(gap, axis=0)) for kind, gap in gaps.items()},
    }
    if newton_iterations:
        apart = np.abs(ends[:, 0] - ends[:, 1]) / initial_gap
        result |= {
            "newton_share_at_1e-6": float(np.mean(residuals[:, 0] <= 1e-6)),
            "newton_share_at_1e-6_second_start": float(np.mean(residuals[:, 1] <= 1e-6)),
            "newton_iterations_median": float(np.median([entry["iterations"][0] for entry in measured])),
            "newton_cpu_s_median": float(np.median([entry["cpu_s"] for entry in measured])),
            "two_starts_differ_median": float(np.median(apart)),
            "two_starts_differ_largest": float(np.max(apart)),
        }
    return result


def measure_cost() -> dict:
    """Time 100 iterations of each kind, and a forward pass of the paper's network, on one 4k mesh in turns."""
    scene = make_scene("tshirt_4k")
    problem, state = solved_frames(scene, 4)[2]
    start = initial_guess(problem).position
    model = MODELS[MODEL]
    forward = jax.jit(lambda params, problem, state: predict(params, problem, state, model).position)
    functions: dict[str, tuple[Callable, tuple]] = {
        "forward": (forward, (init_model(model), problem, state)),
        **{kind: (partial(lbfgs, preconditioner=kind), (start, problem, 100)) for kind in PRECONDITIONERS},
    }
    times = {name: np.array(values) for name, values in time_in_turns(functions, TURNS).items()}
    ratios = {kind: times[kind] / times["forward"] for kind in PRECONDITIONERS}
    return {
        "vertices": int(np.sum(scene.garment.vertex_mask)),
        "turns": TURNS,
        "network": f"one exact float32 forward of {MODEL}, graph included, contacts given",
        "ms_median": {name: round(float(np.median(values)), 1) for name, values in times.items()},
        "ratio_median": {kind: round(float(np.median(values)), 3) for kind, values in ratios.items()},
        "ratio_range": {
            kind: [round(float(values.min()), 3), round(float(values.max()), 3)]
            for kind, values in ratios.items()
        },
    }


def main() -> None:
    """Measure what the command line asks for, and merge it into the result."""
    names = [f"{what}_{size}" for size in ("1k", "4k") for what in ("tshirt", "dress", "ball")]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("what", nargs="*", default=[*names, "cost"], metavar="scene", help=", ".join(names))
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument(
        "--newton-iterations", type=int, default=300, help="0: the optimum is the best of L-BFGS"
    )
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--smoke", action="store_true", help="one frame of one scene, without Newton")
    options = parser.parse_args()
    if options.smoke:
        options.what, options.frames, options.newton_iterations = names[:1], 1, 0
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / "solver_convergence.json"
    result = json.loads(path.read_text()) if path.exists() else {"scenes": {}}
    for what in options.what:
        if what == "cost":
            result["cost_of_100_iterations"] = measure_cost()
        else:
            result["scenes"][what] = measure_scene(what, options.frames, options.newton_iterations)
        result["scenes"] = {name: result["scenes"][name] for name in names if name in result["scenes"]}
        result |= environment()
        with atomic_write(path) as temporary:
            temporary.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
