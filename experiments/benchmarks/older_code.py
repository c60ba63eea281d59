"""Time to a share of the initial gap, by this code and by an older commit, timed alternately.

    python experiments/benchmarks/older_code.py                       # 1k, 4k, 10k: half an hour
    python experiments/benchmarks/older_code.py --commit HEAD --smoke --out DIR

The older code is checked out into a temporary folder. Each code solves the frames of its own near-optimal
rollouts of T-shirt, dress and trousers. The iterations that count are those after which the median gap is a
given share of the initial gap. The cost of a frame and of an iteration is timed on the T-shirt, in processes of
both codes that run alternately. Contacts and fabrics changed too, so the two codes do not solve quite the same
problem.

Writes older_code.json.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from eslr_jax.evaluation.report import environment
from eslr_jax.io.atomic import atomic_write

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "experiments" / "results"
COMMIT = "e6478a3"  # of 22 November, before contacts, preconditioner and iterations were made anew
SHARES = (0.01, 0.001)  # of the initial gap
TURNS = 3
COUNTS = [5, 10, 14, 17, 20, 24, 28, 33, 39, 46, 54, 64, 76, 90, 106]  # of iterations whose gap is measured

# What both codes run. It uses only what has kept its name.
GAPS = """
import json, sys
import numpy as np
from eslr_jax.evaluation.calibrate import example_scene, simulator_of
from eslr_jax.evaluation.gap import GapOptions, measure_gap
from eslr_jax.simulation.rollout import rollout_scene
size, frames, garments, counts = json.loads(sys.argv[1])
shares = []
for garment in garments:
    scene = example_scene(garment, size, "cmu_016_32", frames)
    truth = rollout_scene(None, scene, simulator_of("solver")[1], 100)
    ends = measure_gap(None, truth, scene, None, GapOptions(3, tuple(counts)))
    shares.append([np.asarray(ends.share(ends.solver[count])) for count in counts])
print(json.dumps([float(np.median(row)) for row in np.concatenate(shares, axis=1)]))
"""
TIMES = """
import json, sys
from eslr_jax.evaluation.calibrate import example_scene, fit_costs, simulator_of, time_frames
size, frames = json.loads(sys.argv[1])
scene = example_scene("tshirt", size, "cmu_016_32", frames)
runs = {("solver", count): (*simulator_of("solver"), count) for count in (10, 60)}
fixed, iteration = fit_costs(time_frames(runs, scene))
print(json.dumps([fixed["solver"], iteration]))
"""


def run(code: str, folder: Path, arguments: list) -> list[float]:
    """Run a program with the package of a folder, and return the numbers that it prints.

    Args:
        code: The program.
        folder: Root of a checkout.
        arguments: What the program reads, as JSON.

    Raises:
        subprocess.CalledProcessError: The program failed; its errors are on standard error.
    """
    environment = os.environ | {"PYTHONPATH": str(folder)}
    command = [sys.executable, "-c", code, json.dumps(arguments)]
    done = subprocess.run(command, cwd=folder, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def iterations_to(share: float, counts: list[int], medians: list[float]) -> float:
    """Return the iterations that leave a share of the initial gap; its logarithm is linear between counts.

    Args:
        share: Of the initial gap.
        counts: Of iterations, ascending.
        medians: Shares that they leave, descending but for noise.
    """
    falling = np.minimum.accumulate(medians)
    return float(np.interp(-np.log(share), -np.log(falling), counts))


def count_iterations(older: Path, size: str, garments: list[str], frames: int) -> dict[str, dict[str, float]]:
    """Return the iterations that both codes need at one size, by share of the initial gap.

    Args:
        older: Root of the older checkout.
        size: Of the garments.
        garments: Names of bundled garments.
        frames: Of every rollout.
    """
    found = {}
    for name, code in {"before": older, "now": ROOT}.items():
        medians = run(GAPS, code, [size, frames, garments, COUNTS])
        found[name] = {f"{share:.1%}": iterations_to(share, COUNTS, medians) for share in SHARES}
    print(f"{size}: {json.dumps(found)}", flush=True)
    return found


def time_codes(
    older: Path, size: str, needed: dict[str, dict[str, float]], frames: int, turns: int
) -> dict[str, dict]:
    """Return what a frame costs by both codes at one size, and the ratio now / before.

    Args:
        older: Root of the older checkout.
        size: Of the garment.
        needed: Of `count_iterations`.
        frames: Of every rollout.
        turns: Processes of each code that are timed.
    """
    costs: dict[str, list[list[float]]] = {name: [] for name in needed}
    for _ in range(turns):
        for name, code in {"before": older, "now": ROOT}.items():
            costs[name].append(run(TIMES, code, [size, frames]))
    result: dict = {}
    for name, found in costs.items():
        # The least of all turns: what else runs on the machine only ever adds.
        times = {
            share: min(fixed + count * iteration for fixed, iteration in found)
            for share, count in needed[name].items()
        }
        by_turn = [{"fixed_ms": fixed, "iteration_ms": iteration} for fixed, iteration in found]
        result[name] = {"iterations": needed[name], "ms": times, "turns": by_turn}
    result["ratio"] = {share: ms / result["before"]["ms"][share] for share, ms in result["now"]["ms"].items()}
    print(f"{size}: {json.dumps(result['ratio'])}", flush=True)
    return result


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--commit", default=COMMIT, help="the older code")
    parser.add_argument("--sizes", nargs="+", default=["1k", "4k", "10k"])
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--smoke", action="store_true", help="T-shirt at 1k, few frames, one turn")
    arguments = parser.parse_args()
    sizes, garments, frames, turns = arguments.sizes, ["tshirt", "dress", "pants"], 40, TURNS
    if arguments.smoke:
        sizes, garments, frames, turns = ["1k"], ["tshirt"], 8, 1
    arguments.out.mkdir(parents=True, exist_ok=True)
    git = ["git", "-C", str(ROOT)]
    with tempfile.TemporaryDirectory() as folder:
        older = Path(folder) / "older"
        subprocess.run([*git, "worktree", "add", "--quiet", "--detach", older, arguments.commit], check=True)
        try:
            needed = {size: count_iterations(older, size, garments, frames) for size in sizes}
            result = {
                "commit": arguments.commit,
                "sizes": {size: time_codes(older, size, needed[size], frames, turns) for size in sizes},
                "environment": environment(),
            }
        finally:
            subprocess.run([*git, "worktree", "remove", "--force", older], check=True)
    with atomic_write(arguments.out / "older_code.json") as temporary:
        temporary.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
