"""Run the fifteen hard cases with a simulator and keep the figures, with device and versions.

    python experiments/hard_cases physics --starts 10          # as `eslr simulate` has the solver
    python experiments/hard_cases physics --integrator euler
    python experiments/hard_cases network --model eslr-small
    python experiments/hard_cases corrected --model smooth-small --sheet
    python experiments/hard_cases vbd                 # or style3d, xpbd: Newton's solvers (extra `peers`)
    python experiments/hard_cases blender             # Blender's cloth, see `blender_cloth.py`
    python experiments/hard_cases --smoke --out DIR   # one case

Writes `hard_cases_<simulator>.json` after every case (`hard_cases_<simulator>_<model>.json` for another network
than the default one) and, with `--sheet`, a picture of all that ran beside it. A case of an earlier file stays
until it is run again. `python -m hard_cases` does the same from within `experiments/`.

Needs the IPC Toolkit (extra `score`); `--sheet` needs the extra `render`.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

EXPERIMENTS = Path(__file__).resolve().parents[1]
PEERS = ("vbd", "style3d", "xpbd", "blender")
ITERATIONS = {"physics": None, "corrected": 20, "network": 0}  # of the solver, per frame; None: to 1 %
NETWORKS = ("corrected", "network")
DEFAULT_MODEL = "eslr-small"


def parse_arguments() -> argparse.Namespace:
    """Return what the command line asks for."""
    import harness

    parser = harness.parser(__doc__, "one case")
    parser.add_argument("simulator", nargs="?", default="corrected", choices=[*ITERATIONS, *PEERS])
    parser.add_argument("--model", default=DEFAULT_MODEL)
    parser.add_argument("--iterations", type=int, help="of the solver per frame; physics: to a gap of 1 %%")
    parser.add_argument("--integrator", choices=["euler", "bdf2"], default="bdf2", help="of physics")
    parser.add_argument("--substeps", type=int, default=1, help="physics: of every frame")
    parser.add_argument("--starts", type=int, default=1, help="that differ by 0.01 mm; the worst counts")
    parser.add_argument("--case", nargs="*", default=[])
    parser.add_argument("--sheet", action="store_true")
    arguments = parser.parse_args()
    if arguments.smoke:
        arguments.case = ["pull"]
        if arguments.simulator in NETWORKS:
            arguments.model = "smooth-small"
    if arguments.iterations is None:
        arguments.iterations = ITERATIONS.get(arguments.simulator)
    return arguments


def find_simulator(arguments: argparse.Namespace):
    """Return the simulator that was asked for.

    Raises:
        EslrError: It is not installed, or the network is unknown.
    """
    from eslr_jax.errors import ConfigError
    from eslr_jax.pipeline.assets import load_model
    from hard_cases.case import network_simulator, solver_simulator

    name = arguments.simulator
    stepping = {
        "--integrator": arguments.integrator != "bdf2",
        "--substeps": arguments.substeps > 1,
    }
    if name != "physics" and any(stepping.values()):
        given = ", ".join(option for option, is_given in stepping.items() if is_given)
        raise ConfigError(f"{given} is for the simulator physics; leave it out for {name}")
    if name not in NETWORKS and arguments.model != DEFAULT_MODEL:
        raise ConfigError(f"--model is for networks; leave it out for {name}")
    if name == "physics":
        return solver_simulator(
            arguments.iterations,
            arguments.integrator,
            substeps=arguments.substeps,
        )
    if name in ITERATIONS:
        return network_simulator(arguments.model, load_model(arguments.model), arguments.iterations)
    if arguments.iterations is not None:
        raise ConfigError(f"--iterations is for this package's simulators; {name} has its own effort")
    if name == "blender":
        from blender_cloth import BEST, blender_simulator

        return blender_simulator(BEST)
    import newton_cloth

    return newton_cloth.newton_simulator(next(one for one in newton_cloth.BEST if one.solver == name))


def run(arguments: argparse.Namespace) -> None:
    """Run cases one after the other and keep what comes of them.

    Raises:
        EslrError: Something is not installed, or a name is unknown.
    """
    from eslr_jax.pipeline.extras import require

    require("ipctk", extra="dev", purpose="the referee of the hard cases")
    if arguments.sheet:
        for module in ("mitsuba", "PIL"):
            require(module, extra="render", purpose="--sheet")

    import harness

    from eslr_jax.pipeline.pictures import write_png
    from hard_cases import CASES, find_case, run_case, worst
    from hard_cases.report import draw_sheet, merge_summaries, summarize

    cases = [find_case(name) for name in arguments.case or CASES]
    simulator = find_simulator(arguments)
    other = f"_{arguments.model}" if arguments.model != DEFAULT_MODEL else ""
    other += f"_{arguments.integrator}" if arguments.integrator != "bdf2" else ""
    other += f"_{arguments.substeps}_substeps" if arguments.substeps > 1 else ""
    path = arguments.out / f"hard_cases_{arguments.simulator}{other}.json"
    outcomes = []
    for case in cases:
        began = time.perf_counter()
        outcome = worst([run_case(case, simulator, start) for start in range(arguments.starts)])
        outcomes.append(outcome)
        result = summarize(simulator.name, outcome)
        if older := harness.kept(path):
            result = merge_summaries(older, result)
        harness.keep(path, result)
        verdict = "passed" if outcome.is_passed else "FAILED"
        print(f"{case.name}: {verdict} in {time.perf_counter() - began:.0f} s", flush=True)
        for row in outcome.rows():
            if not row["passed"]:
                print(f"    {row['measure']}: {row['value']} > {row['bar']}", flush=True)
    if arguments.sheet and (sheet := draw_sheet(outcomes)) is not None:
        write_png(path.with_suffix(".png"), sheet)


def main() -> None:
    from eslr_jax.errors import EslrError

    arguments = parse_arguments()
    try:
        run(arguments)
    except EslrError as error:
        print(f"hard_cases: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    sys.path[0] = str(EXPERIMENTS)  # Python puts this folder there, but its modules belong to a package
    main()
