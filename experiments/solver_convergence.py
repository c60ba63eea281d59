"""Measure how fast the frame solvers converge, and what they cost against the paper's network.

    python experiments/solver_convergence.py                  # all scenes, then the cost
    python experiments/solver_convergence.py tshirt_1k ball_4k
    python experiments/solver_convergence.py cost
    python experiments/solver_convergence.py --smoke --out DIR

Frames are taken from a solved rollout. Of every frame: L-BFGS from the pushed-out start after 5 to 200
iterations, with three preconditioners; projected Newton from the same start, and from a second one, the cloth
where it was, brought near a minimum by L-BFGS. The remaining gap is (E - E*) / (E_0 - E*): E_0 the potential of
the pushed-out inertial guess, E* the lowest of all answers, everything in float64.

Entries of solver_convergence.json that are not measured anew stay as they are.
"""

from __future__ import annotations

import argparse
import json
import time
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from eslr_jax.assets import load_body, load_garment, load_motion
from eslr_jax.body.motion import pose_body
from eslr_jax.config import SimConfig
from eslr_jax.evaluation.gap import trajectory_states
from eslr_jax.evaluation.hard_cases.body import drop_scene
from eslr_jax.evaluation.report import environment
from eslr_jax.models.registry import MODELS, init_model
from eslr_jax.physics.lbfgs import minimize
from eslr_jax.physics.newton import minimize_newton, potential_float64
from eslr_jax.physics.potential import potential
from eslr_jax.physics.preconditioner import hessian_diagonal, stiffness
from eslr_jax.physics.problem import PhysicsParameters, pin, push_out, start_guess
from eslr_jax.physics.start import solver_start
from eslr_jax.scene import prepare_scene
from eslr_jax.simulation.network import network_step
from eslr_jax.simulation.scan import simulate_scene
from eslr_jax.simulation.step import frame_problem

RESULTS = Path(__file__).resolve().parent / "results"
COUNTS = (5, 10, 20, 50, 100, 200)  # L-BFGS iterations
CLIP = "cmu_016_32"
LAST_FRAME = 40  # frames are spread from the second to this one
TRUTH_ITERATIONS = 150  # of the rollout that supplies the states
SECOND_START_ITERATIONS = 600
MODEL = "eslr-15"
TURNS = 7


def mean_diagonal(problem, garment, material, position):
    """Return the same stiffness for every vertex, so that L-BFGS is plain but for its first step's size."""
    diagonal = hessian_diagonal(problem, garment, material, position)
    mean = jnp.sum(jnp.where(garment.vertex_mask, diagonal, 0.0)) / jnp.sum(garment.vertex_mask)
    return jnp.full_like(diagonal, mean)


PRECONDITIONERS = {"plain": mean_diagonal, "diagonal": hessian_diagonal, "springs": stiffness}


@partial(jax.jit, static_argnames="preconditioner")
def lbfgs(start, problem, garment, material, iterations, preconditioner):
    """Return positions after so many iterations; their number is traced, so that all counts share a program."""
    return minimize(
        lambda x: potential(x, problem, garment, material),
        start,
        PRECONDITIONERS[preconditioner](problem, garment, material, start),
        iterations=iterations,
    ).position


def make_scene(name: str):
    """Return a scene by name: garment or ball, and its resolution."""
    what, size = name.split("_")
    if what == "ball":
        return drop_scene({}, columns={"1k": 33, "4k": 65}[size], seconds=(LAST_FRAME + 1) / 30).scene
    body = load_body()
    poses = pose_body(body, load_motion(CLIP), num_frames=LAST_FRAME + 2)
    return prepare_scene(load_garment(what, vertices=size, body=body), poses)


def taught_frames(scene, count: int) -> list:
    """Return the problems of frames spread over a solved rollout, each with the state it starts from."""
    parameters = PhysicsParameters()
    config = SimConfig(simulator="physics", solver_iterations=TRUTH_ITERATIONS)
    trajectory = simulate_scene(None, scene, parameters, config)
    states, inputs = trajectory_states(trajectory, scene, parameters)
    build = jax.jit(
        lambda state, frame: frame_problem(
            scene.garment, state, frame, scene.surface, scene.timestep, parameters
        )
    )
    frames = np.linspace(1, LAST_FRAME, count).round().astype(int)
    taken = [jax.tree.map(lambda leaf, k=k: leaf[k], (states, inputs)) for k in frames]
    return [(build(*part), part[0]) for part in taken]


def measure_frame(problem, garment, material, newton_iterations: int) -> dict:
    """Return the potentials [J] after every count, of both Newton answers, and how Newton ended."""
    energy = partial(potential_float64, problem=problem, garment=garment, material=material)
    start = solver_start(problem, garment, material)
    curves = {
        name: [energy(lbfgs(start, problem, garment, material, count, name)) for count in COUNTS]
        for name in PRECONDITIONERS
    }
    began = time.process_time()
    first = minimize_newton(
        problem, garment, material, np.asarray(start, np.float64), max_iterations=newton_iterations
    )
    seconds = time.process_time() - began
    still = push_out(problem, garment, pin(problem, garment, problem.position))
    near = lbfgs(still, problem, garment, material, SECOND_START_ITERATIONS, "springs")
    second = minimize_newton(
        problem, garment, material, np.asarray(near, np.float64), max_iterations=newton_iterations
    )
    return {
        "guess": energy(start_guess(problem, garment)),
        "curves": curves,
        "newton": [first.value, second.value],
        "residuals": [first.residual, second.residual],
        "iterations": [first.iterations, second.iterations],
        "cpu_s": seconds,
    }


def measure_scene(name: str, frames: int, newton_iterations: int) -> dict:
    """Return the figures of one scene."""
    scene = make_scene(name)
    garment, material = scene.garment, scene.material
    measured = []
    for number, (problem, _) in enumerate(taught_frames(scene, frames)):
        measured.append(measure_frame(problem, garment, material, newton_iterations))
        entry = measured[-1]
        print(f"{name} frame {number}: Newton {entry['iterations']}, {entry['residuals']}", flush=True)
    best = np.array([min(min(map(min, entry["curves"].values())), *entry["newton"]) for entry in measured])
    drop = np.array([entry["guess"] for entry in measured]) - best
    ends = np.array([entry["newton"] for entry in measured])
    residuals = np.array([entry["residuals"] for entry in measured])
    gaps = {
        kind: (np.array([entry["curves"][kind] for entry in measured]) - best[:, None]) / drop[:, None]
        for kind in PRECONDITIONERS
    }

    def by_count(values: np.ndarray) -> dict[str, float]:
        return {str(count): float(f"{value:.3g}") for count, value in zip(COUNTS, values, strict=True)}

    result: dict = {
        "vertices": int(np.sum(np.asarray(garment.vertex_mask))),
        "frames": len(measured),
        "initial_gap_j": {"median": float(np.median(drop)), "least": float(drop.min())},
        "gap_median": {kind: by_count(np.median(gap, axis=0)) for kind, gap in gaps.items()},
        "gap_largest": {kind: by_count(np.max(gap, axis=0)) for kind, gap in gaps.items()},
    }
    if newton_iterations:
        result |= {
            "newton_share_at_1e-6": float(np.mean(residuals[:, 0] <= 1e-6)),
            "newton_share_at_1e-6_second_start": float(np.mean(residuals[:, 1] <= 1e-6)),
            "newton_iterations_median": float(np.median([entry["iterations"][0] for entry in measured])),
            "newton_cpu_s_median": float(np.median([entry["cpu_s"] for entry in measured])),
            "two_starts_differ_median": float(np.median(np.abs(ends[:, 0] - ends[:, 1]) / drop)),
            "two_starts_differ_largest": float(np.max(np.abs(ends[:, 0] - ends[:, 1]) / drop)),
        }
    return result


def measure_cost() -> dict:
    """Time 100 iterations of each kind, and a forward pass of the paper's network, on one 4k mesh in turns."""
    scene = make_scene("tshirt_4k")
    garment, material = scene.garment, scene.material
    problem, state = taught_frames(scene, 4)[2]
    start = solver_start(problem, garment, material)
    model = MODELS[MODEL]
    params = init_model(model)
    forward = jax.jit(lambda *args: network_step(*args, model)[0])
    functions = {
        "forward": (forward, (params, garment, material, problem, state)),
        **{
            kind: (partial(lbfgs, preconditioner=kind), (start, problem, garment, material, 100))
            for kind in PRECONDITIONERS
        },
    }
    times = {name: [] for name in functions}
    for turn in range(TURNS + 1):
        for name, (function, args) in functions.items():
            began = time.perf_counter()
            jax.block_until_ready(function(*args))
            if turn:  # the first compiles
                times[name].append(time.perf_counter() - began)
    seconds = {name: np.array(values) for name, values in times.items()}
    ratios = {kind: seconds[kind] / seconds["forward"] for kind in PRECONDITIONERS}
    return {
        "vertices": int(np.sum(np.asarray(garment.vertex_mask))),
        "turns": TURNS,
        "network": f"one exact float32 forward of {MODEL}, contacts and graph included",
        "ms_median": {name: round(1e3 * float(np.median(values)), 1) for name, values in seconds.items()},
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
        path.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
