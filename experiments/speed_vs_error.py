"""Speed against error: optimality gap against time per frame, for the solver, networks and both.

    python experiments/speed_vs_error.py                 # 1k and 4k, about half an hour on two cores
    python experiments/speed_vs_error.py --sizes 10k     # joins the sizes that the file already holds
    python experiments/speed_vs_error.py --sizes 50k --models smooth-small --garments tshirt --frames 6
    python experiments/speed_vs_error.py --peers         # with Newton's solvers, which the extra `peers` installs
    python experiments/speed_vs_error.py --smoke --out DIR

Every method starts from the same states: those of a near-optimal rollout on a test clip. A method's time has a
fixed part (contacts, network) and a part per L-BFGS iteration; methods are timed alternately. Free rollouts
follow for a few numbers of iterations. `peers.py` says what the peers are and how they are measured.

Writes speed_vs_error.json and .png after every size.
"""

import dataclasses
from pathlib import Path

import jax
import numpy as np
import peers
from harness import keep, kept, parser, save

from eslr_jax.pipeline.assets import asset_names
from eslr_jax.pipeline.assets.budget import SOLVER, Cost, device_name
from eslr_jax.pipeline.assets.models import START_MODEL
from eslr_jax.pipeline.report.calibrate import example_scene, measure_costs, read_coarse_edges, simulator_of
from eslr_jax.pipeline.report.gap import GapOptions, OptimalityGap, measure_gap
from eslr_jax.pipeline.report.report import environment, trajectory_report
from eslr_jax.simulation.rollout import rollout_scene
from eslr_jax.types import Scene, Trajectory

CLIP = "cmu_016_32"  # of the test split
GARMENTS = ("tshirt", "dress", "pants")
REPORTED = ("finite", "total", "max_principal_stretch", "penetration_p999_mm", "residual_median")
ITERATIONS = (0, 1, 2, 5, 10, 20, 40, 80, 160)
EVERY = 3  # frames between those whose gap is measured
TRUTH_ITERATIONS = 100  # of the rollouts that supply the states
ROLLOUTS = (5, 10, 20, 50, 100), (0, 5, 20)  # iterations of free rollouts, by the solver and behind a network


def measure_methods(names: tuple[str, ...], scenes: list[Scene]) -> tuple[list[Cost], dict[str, list[dict]]]:
    """Return what methods cost on the first scene, and their points, from states of the optimum's own rollouts.

    The optimum of a frame is the lowest potential that any method finds, since a network may lead to a deeper
    minimum. Scenes are of one size.
    """
    _, solver = simulator_of(SOLVER)
    truths = [rollout_scene(None, scene, solver, TRUTH_ITERATIONS) for scene in scenes]
    gaps = {name: [measure_ends(name, *pair) for pair in zip(scenes, truths, strict=True)] for name in names}
    optima = [np.min([ends.optimum for ends in same], axis=0) for same in zip(*gaps.values(), strict=True)]
    costs, points = measure_costs(names, scenes[0]), {}
    for cost in costs:
        shares: dict[int, list[np.ndarray]] = {}  # by iterations, of every scene
        for ends, optimum in zip(gaps[cost.name], optima, strict=True):
            best = ends._replace(optimum=optimum)
            for count, energy in (ends.solver if cost.name == SOLVER else ends.refined).items():
                shares.setdefault(count, []).append(np.asarray(best.share(energy)))
        rows = shares.items()
        points[cost.name] = [peers.point(n, cost.frame_ms(n), np.concatenate(parts)) for n, parts in rows]
    return costs, points


def measure_ends(name: str, scene: Scene, truth: Trajectory) -> OptimalityGap:
    """Return the potentials that a method leaves after every count of `ITERATIONS`, as NumPy arrays."""
    network, _ = simulator_of(name)
    options = GapOptions(EVERY, ITERATIONS[1:] if network is None else (), ITERATIONS)
    return jax.device_get(measure_gap(network, truth, scene, options))


def free_rollouts(
    name: str, garments: list[str], size: str, num_frames: int, counts: tuple[int, ...]
) -> list[dict]:
    """Return the report of garments' free rollouts by number of iterations, behind a network or none."""
    reports, reads_edges = [], read_coarse_edges((name,))
    network, config = simulator_of(name)
    for garment in garments:
        scene = example_scene(garment, size, CLIP, num_frames, has_coarse_edges=reads_edges)
        for count in counts:
            report = trajectory_report(rollout_scene(network, scene, config, count), scene)
            shown = {column: report[column] for column in REPORTED}
            reports.append({"garment": garment, "iterations": count, **shown})
    return reports


def draw(result: dict, path: Path) -> None:
    """Draw the frontier, one panel per size."""
    import matplotlib.pyplot as plt
    from matplotlib.ticker import LogLocator, NullFormatter

    sizes = list(result["sizes"])
    names = dict.fromkeys(name for size in sizes for name in result["sizes"][size]["methods"])
    colors = {name: "#1b1b1b" if name == SOLVER else f"C{k % 10}" for k, name in enumerate(names)}
    lines = {}
    figure, axes = plt.subplots(
        1, len(sizes), figsize=(5.2 * len(sizes), 4.8), sharey=True, squeeze=False, layout="constrained"
    )
    for axis, size in zip(axes[0], sizes, strict=True):
        for name, entries in result["sizes"][size]["methods"].items():
            shown = [entry for entry in entries if entry["gap_relative_median"] > 1e-6]
            label = "L-BFGS" if name == SOLVER else name if name in result["peers"] else f"{name} + L-BFGS"
            times, errors = ([entry[key] for entry in shown] for key in ("frame_ms", "gap_relative_median"))
            (lines[label],) = axis.loglog(times, errors, "o-", color=colors[name], markersize=4)
            look = {"fontsize": 7, "textcoords": "offset points", "xytext": (3, 3)}
            for entry, *place in zip(shown, times, errors, strict=True):
                axis.annotate(str(entry["iterations"]), place, **look)
        axis.set_title(f"{size} vertices")
        axis.set_xlabel("time per frame [ms]")
        axis.grid(True, which="both", alpha=0.2)
        axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))  # a panel may span less than a decade
        axis.xaxis.set_major_formatter("{x:g}")
        axis.xaxis.set_minor_formatter(NullFormatter())
    axes[0][0].set_ylabel("optimality gap / the initial gap (median)")
    figure.legend(lines.values(), lines.keys(), loc="outside lower center", ncols=4, fontsize=8)
    save(figure, path)


def main() -> None:
    options = parser(__doc__, "one garment, few frames")
    options.add_argument("--sizes", nargs="+", default=["1k", "4k"])
    options.add_argument("--models", nargs="*", default=list(asset_names("model")))
    options.add_argument("--garments", nargs="+", default=list(GARMENTS))
    options.add_argument("--frames", type=int, default=40, help="of every garment; gaps are measured in all")
    options.add_argument(
        "--peers", action="store_true", help="other simulators too, where they are installed"
    )
    chosen = options.parse_args()
    garments, frames, rollout_frames = chosen.garments, chosen.frames, 60
    solver_counts, network_counts = ROLLOUTS
    if chosen.smoke:
        garments, frames, rollout_frames = garments[:1], 8, 8
        chosen.sizes, chosen.models = ["1k"], [START_MODEL]
        solver_counts = network_counts = (10,)  # which the calibration has compiled
    path = chosen.out / "speed_vs_error.json"
    older = {} if chosen.smoke else kept(path)
    result: dict = {"clip": CLIP, "device": device_name(), "peers": [], "sizes": {}}
    result |= {name: older[name] for name in ("peers", "sizes") if name in older}
    names = (SOLVER, *chosen.models)
    reads_edges = read_coarse_edges(names)
    for size in chosen.sizes:
        scenes = [
            example_scene(garment, size, CLIP, frames, has_coarse_edges=reads_edges) for garment in garments
        ]
        costs, measured = measure_methods(names, scenes)
        print(f"{size}: methods measured", flush=True)
        about = environment()
        if chosen.peers:
            settings = peers.SMOKE_SETTINGS if chosen.smoke else peers.SETTINGS
            of_peers = peers.peer_points(scenes, settings)
            result["peers"] = list(dict.fromkeys([*result["peers"], *of_peers]))
            measured |= of_peers
            about["versions"] |= peers.peer_versions()
            print(f"{size}: peers measured", flush=True)
        rollouts = {}
        for name in (SOLVER, *(model for model in chosen.models if model == START_MODEL)):
            counts = solver_counts if name == SOLVER else network_counts
            rollouts[name] = free_rollouts(name, garments, size, rollout_frames, counts)
        result["sizes"][size] = {
            "garments": garments,
            "frames": frames,
            "methods": measured,
            "costs": [dataclasses.asdict(cost) for cost in costs],
            "rollouts": rollouts,
            "environment": about,
        }
        draw(result, chosen.out / "speed_vs_error.png")
        keep(path, result)
        jax.clear_caches()


if __name__ == "__main__":
    main()
