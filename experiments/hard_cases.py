"""Run the fifteen hard cases with a simulator and keep the figures, with device and versions.

    python experiments/hard_cases.py physics
    python experiments/hard_cases.py network --model eslr-small
    python experiments/hard_cases.py corrected --model smooth-small --sheet
    python experiments/hard_cases.py vbd                 # or style3d, xpbd: Newton's solvers (extra `peers`)
    python experiments/hard_cases.py blender             # its cloth, see `blender_cloth.py`
    python experiments/hard_cases.py --smoke --out DIR   # one case

Writes `hard_cases_<simulator>.json` after every case (`_<model>` where it is not the default
network) and, with `--sheet`, a picture of all that ran beside it. Entries of an earlier file stay until their
case is run anew.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

RESULTS = Path(__file__).resolve().parent / "results"
PEERS = {
    "vbd": (5, 20),
    "style3d": (2, 20),
    "xpbd": (None, 1),
}  # substeps, iterations: the best of peers.json
BLENDER = (45, 2)  # steps per frame, rounds of collision per step: likewise


def merge(old: dict, new: dict) -> dict:
    """Return the new summary, filled up with the cases that only the old one holds, in the usual order."""
    from eslr_jax.evaluation.hard_cases import CASES

    cases = {**old["cases"], **new["cases"]}
    measures = [row for row in old["measures"] if row["case"] not in new["cases"]] + new["measures"]
    order = list(CASES)
    cases = {name: cases[name] for name in order if name in cases}
    measures.sort(key=lambda row: order.index(row["case"]))
    passed = sum(case["passed"] for case in cases.values())
    return {**new, "passed": passed, "cases": cases, "measures": measures}


def main() -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    choices = ["physics", "network", "corrected", "blender", *PEERS]
    parser.add_argument("simulator", nargs="?", default="corrected", choices=choices)
    parser.add_argument("--model", default="eslr-small")
    parser.add_argument("--iterations", type=int, default=200)
    parser.add_argument("--corrector-steps", type=int, default=20)
    parser.add_argument("--case", nargs="*", default=[])
    parser.add_argument("--sheet", action="store_true")
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--smoke", action="store_true")
    options = parser.parse_args()
    if options.smoke:
        options.model, options.case = "smooth-small", ["pull"]
    options.out.mkdir(parents=True, exist_ok=True)

    from eslr_jax.assets import load_model
    from eslr_jax.evaluation.hard_cases import network_simulator, physics_simulator
    from eslr_jax.evaluation.stress import stress, summary, write_pictures

    if options.simulator == "physics":
        simulator = physics_simulator(iterations=options.iterations)
    elif options.simulator == "blender":
        from blender_cloth import blender_python, blender_simulator

        if blender_python() is None:
            parser.error("BLENDER_PYTHON names no Python with bpy, see peers.py")
        simulator = blender_simulator(BLENDER)
    elif options.simulator in PEERS:
        from newton_cloth import Setting, newton_simulator

        simulator = newton_simulator(Setting(options.simulator, *PEERS[options.simulator]))
    else:
        steps = options.corrector_steps if options.simulator == "corrected" else 0
        name = f"{options.model}, {steps} corrector iterations" if steps else options.model
        simulator = network_simulator(*load_model(options.model), name=name, corrector_steps=steps)

    other = f"_{options.model}" if options.model != parser.get_default("model") else ""
    path = options.out / f"hard_cases_{options.simulator}{other}.json"

    def keep(name, outcome, seconds):
        result = summary(simulator, [outcome])
        if path.exists():
            result = merge(json.loads(path.read_text()), result)
        path.write_text(json.dumps(result, indent=1) + "\n")
        print(f"{name}: {'passed' if outcome.is_passed else 'FAILED'} in {seconds:.0f} s", flush=True)
        for row in outcome.rows():
            if not row["passed"]:
                print(f"    {row['measure']}: {row['value']} > {row['bar']}", flush=True)

    outcomes = stress(simulator, options.case, on_case=keep)
    if options.sheet:
        with tempfile.TemporaryDirectory() as folder:
            write_pictures(outcomes, Path(folder))
            path.with_suffix(".png").write_bytes((Path(folder) / "sheet.png").read_bytes())


if __name__ == "__main__":
    main()
