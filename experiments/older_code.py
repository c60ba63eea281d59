"""Time to a share of the initial gap, by this code and by an older commit, timed alternately.

    python experiments/older_code.py --commit COMMIT             # 1k, 4k, 10k: half an hour
    python experiments/older_code.py --commit HEAD --smoke --out DIR

Each code solves the frames of its own near-optimal rollouts of T-shirt, dress and trousers, and counts iterations
until the median gap is a share of the initial gap. Frames and iterations are timed on the T-shirt. Contacts and
fabrics changed too, so the two codes do not solve quite the same problem. The older code must have the names that
the scripts below use: it is 0.2.0 or later. The kept result is of an older one. Writes older_code.json.
"""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from harness import EXPERIMENTS, keep, machine, parser

SHARES = (0.01, 0.001)  # of the initial gap
COUNTS = [5, 10, 14, 17, 20, 24, 28, 33, 39, 46, 54, 64, 76, 90, 106]  # of iterations whose gap is measured

# What both codes run. It uses only what has kept its name.
GAPS = """
import json, sys
import numpy as np
from eslr_jax.pipeline.report.calibrate import example_scene, simulator_of
from eslr_jax.pipeline.report.gap import GapOptions, measure_gap
from eslr_jax.simulation.rollout import rollout_scene
size, frames, garments, counts = json.loads(sys.argv[1])
shares = []
for garment in garments:
    scene = example_scene(garment, size, "cmu_016_32", frames)
    truth = rollout_scene(None, scene, simulator_of("solver")[1], 100)
    ends = measure_gap(None, truth, scene, options=GapOptions(3, tuple(counts)))
    shares.append([np.asarray(ends.share(ends.solver[count])) for count in counts])
print(json.dumps([float(np.median(row)) for row in np.concatenate(shares, axis=1)]))
"""
TIMES = """
import json, sys
from eslr_jax.pipeline.report.calibrate import example_scene, fit_costs, simulator_of, time_frames
size, frames = json.loads(sys.argv[1])
scene = example_scene("tshirt", size, "cmu_016_32", frames)
runs = {("solver", count): (*simulator_of("solver"), count) for count in (10, 60)}
fixed, iteration = fit_costs(time_frames(runs, scene))
print(json.dumps([fixed["solver"], iteration]))
"""


def in_turns(
    roots: Mapping[str, Path], program: str, arguments: list, turns: int = 1
) -> dict[str, list[Any]]:
    """Return what a program prints last, as JSON, in every turn of the code at every root.

    Its arguments are JSON in `sys.argv[1]`. Codes run alternately, in processes of their own, so that what else
    runs on the machine disturbs them alike. Errors of a program are on standard error.
    """
    found: dict[str, list[Any]] = {name: [] for name in roots}
    command = [sys.executable, "-c", program, json.dumps(arguments)]
    for _ in range(turns):
        for name, root in roots.items():
            about: dict[str, Any] = {"cwd": root, "env": os.environ | {"PYTHONPATH": str(root)}}
            done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, **about)
            found[name].append(json.loads(done.stdout.splitlines()[-1]))
    return found


def compare(roots: Mapping[str, Path], size: str, is_smoke: bool) -> dict[str, Any]:
    """Return what each code needs to a share of the gap at one size, and the ratio of their times."""
    garments, frames, turns = (["tshirt"], 8, 1) if is_smoke else (["tshirt", "dress", "pants"], 40, 3)
    row: dict[str, Any] = {}
    gaps = in_turns(roots, GAPS, [size, frames, garments, COUNTS])
    for name, costs in in_turns(roots, TIMES, [size, frames], turns).items():
        # Between counts the logarithm of the share is linear; it descends but for noise.
        falling = -np.log(np.minimum.accumulate(gaps[name][0]))
        needed = {f"{share:.1%}": float(np.interp(-np.log(share), falling, COUNTS)) for share in SHARES}
        # The least of all turns: what else runs on the machine only ever adds.
        times = {share: min(fixed + n * each for fixed, each in costs) for share, n in needed.items()}
        by_turn = [{"fixed_ms": fixed, "iteration_ms": iteration} for fixed, iteration in costs]
        row[name] = {"iterations": needed, "ms": times, "turns": by_turn}
    row["ratio"] = {share: ms / row["before"]["ms"][share] for share, ms in row["now"]["ms"].items()}
    return row


def main() -> None:
    options = parser(__doc__, "T-shirt at 1k, few frames, one turn")
    options.add_argument("--commit", required=True, help="the older code")
    options.add_argument("--sizes", nargs="+", default=["1k", "4k", "10k"])
    chosen = options.parse_args()
    result = {"commit": chosen.commit, "sizes": {}, **machine()}
    root = EXPERIMENTS.parent
    git = ["git", "-C", str(root), "worktree"]
    with tempfile.TemporaryDirectory() as folder:
        older = Path(folder) / "older"
        subprocess.run([*git, "add", "--quiet", "--detach", older, chosen.commit], check=True)
        try:
            for size in ["1k"] if chosen.smoke else chosen.sizes:
                row = compare({"before": older, "now": root}, size, chosen.smoke)
                result["sizes"][size] = row
                print(f"{size}: {json.dumps(row)}", flush=True)
        finally:
            subprocess.run([*git, "remove", "--force", older], check=True)
    keep(chosen.out / "older_code.json", result)


if __name__ == "__main__":
    main()
