"""Other simulators beside ours, same scenes, same run: Newton's VBD, Style3D and XPBD, Blender's cloth.

    python experiments/peers.py                          # T-shirt at 1k, 4k and 10k, 40 frames: half an hour
    python experiments/peers.py --scenes tshirt_10k      # joins the scenes that the file already holds
    python experiments/peers.py --smoke --out DIR

The methods are timed alternately, frame by frame, so that whatever disturbs the machine disturbs all of them.
Times are medians over frames. `frame_cpu_ms` is CPU time: Newton uses one core, and ours uses all that it gets,
so give the process one core to compare them (`taskset -c 0` on Linux). Stretch, penetration and intersections are
those of the free rollout. The gap is relative to the initial gap, of frames from states of our near-optimal
rollout, and of the frames that a method simulated itself. A method with substeps solves a finer problem; the row
of our own solver with substeps shows the gap that they alone cause.

Blender can only run through from a start at rest: it comes after the others, and has no teacher-forced gap.
Newton comes with the extra `peers`; Blender runs where BLENDER_PYTHON names a Python with `bpy`
(`python3.11 -m venv blender && blender/bin/pip install bpy`). What is missing is left out. Writes peers.json.
"""

import importlib.metadata
import os
import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from blender_cloth import blender_python, run_blender
from harness import cores, keep, kept, markdown, parser
from newton_cloth import NewtonCloth, Setting, require_newton

from eslr_jax import MissingExtraError, NonFiniteError, SimConfig, rollout_scene, score_trajectory
from eslr_jax.pipeline.assets.budget import device_name
from eslr_jax.pipeline.report.calibrate import example_scene
from eslr_jax.pipeline.report.gap import reached_potentials, trajectory_gap, trajectory_states
from eslr_jax.pipeline.report.report import environment
from eslr_jax.simulation.frame import FrameInput, frame_inputs, without_tracks
from eslr_jax.simulation.rollout import step_frame
from eslr_jax.simulation.stepper import make_stepper
from eslr_jax.terms import Contact
from eslr_jax.terms.contact import starting_rows
from eslr_jax.types import ClothState, Scene

CLIP = "cmu_016_32"  # of the test split
SETTINGS = (
    *(Setting("vbd", *effort) for effort in ((1, 20), (5, 5), (5, 10), (5, 20))),
    *(Setting("style3d", *effort) for effort in ((1, 20), (2, 5), (2, 10), (2, 20))),
    Setting("xpbd", None, 1),
)
SMOKE_SETTINGS = (Setting("vbd", 5, 5), Setting("style3d", 2, 5), Setting("xpbd", None, 1))
BLENDER = ((5, 2), (15, 2), (45, 2))  # steps per frame, rounds of collision per step
OURS = ((1, 10), (1, 20), (1, 50), (1, 100), (5, 50))  # substeps, iterations of L-BFGS
OUR_STRICT = ((1, 20), (1, 50))  # with strict contact, as `eslr simulate` has it
SCORE = {  # measure of `score_trajectory` -> column
    "pooled_stretch_p99": "pooled_stretch_p99",
    "penetration_p999_mm": "penetration_p999_mm",
    "gap_relative_median": "gap_relative_own",
    "intersections_cloth": "intersections_cloth",
    "intersections_body": "intersections_body",
}
GAPS = ("gap_relative_median", "gap_relative_max", "gap_j_median")
EVERY = 6  # frames between those whose gap is measured
TIMED_FRAMES = 20  # of `peer_points`

Step = Callable[[ClothState, int], ClothState]  # from a state at a frame to the next


class Method(NamedTuple):
    """A way to step one scene."""

    name: str
    effort: str  # substeps x iterations
    step: Step


def our_method(scene: Scene, substeps: int, iterations: int, name: str = "ours") -> Method:
    """Return our solver on a scene."""
    inputs, constant = frame_inputs(scene), without_tracks(scene).replace(substeps=substeps)
    stepper = make_stepper(None, SimConfig(iterations=iterations))

    @jax.jit
    def advance(scene: Scene, state: ClothState, frame: FrameInput) -> ClothState:
        return step_frame(stepper, scene, state, frame)[0]

    def run(state: ClothState, frame: int) -> ClothState:
        return advance(constant, state, jax.tree.map(lambda leaf: leaf[frame], inputs))

    return Method(name, f"{substeps}x{iterations}", run)


def newton_methods(scene: Scene, settings: tuple[Setting, ...]) -> list[Method]:
    """Return Newton's solvers on a scene; none, and a line that says what to install, without Newton."""
    try:
        require_newton()
    except MissingExtraError as error:
        print(f"peers left out: {error}", file=sys.stderr)
        return []
    cloths = [(setting, NewtonCloth(scene, setting)) for setting in settings]
    return [Method(s.name, f"{cloth.substeps}x{s.iterations}", cloth) for s, cloth in cloths]


def take_turns(methods: list[Method], scene: Scene, num_frames: int) -> tuple[list[np.ndarray], np.ndarray]:
    """Roll all methods out, frame by frame in turns, to a number of frames with the start.

    Returns:
        Per method positions [m], shape [frames, vertices, 3]; wall and processor time [ms], shape [2, methods,
        frames - 1].
    """
    for method in methods:  # compiles
        jax.block_until_ready(method.step(scene.initial_state, 0))
    states = [scene.initial_state] * len(methods)
    positions = [[np.asarray(scene.initial_state.position)] for _ in methods]
    times = np.empty((2, len(methods), num_frames - 1))
    for frame in range(num_frames - 1):
        for k, method in enumerate(methods):
            began = time.perf_counter(), time.process_time()
            states[k] = jax.block_until_ready(method.step(states[k], frame))
            times[:, k, frame] = time.perf_counter() - began[0], time.process_time() - began[1]
            positions[k].append(np.asarray(states[k].position))
    return [np.stack(rows) for rows in positions], 1e3 * times


def teach(methods: list[Method], scene: Scene) -> tuple[list[np.ndarray], np.ndarray]:
    """Return every method's gap [J] a frame after near-optimal states, and the initial gaps [J]."""
    truth = rollout_scene(None, scene, SimConfig(iterations=500))
    ends = trajectory_gap(truth, scene, every=EVERY)
    states, inputs = trajectory_states(truth, scene)
    taken = jax.tree.map(lambda leaf: leaf[1::EVERY], (states, inputs))
    frames = range(1, scene.num_frames - 1, EVERY)
    gap = []
    for method in methods:
        reached = [
            method.step(jax.tree.map(lambda leaf, f=frame: leaf[f], states), frame).position
            for frame in frames
        ]
        reached = reached_potentials(jnp.stack(reached), *taken, scene)
        gap.append(np.asarray(reached - ends.optimum))
    return gap, np.asarray(ends.initial_gap)


def describe_rollout(positions: np.ndarray, scene: Scene, every: int = EVERY) -> dict[str, Any]:
    """Return the measures of a free rollout, gap every so many frames; None where it did not stay finite."""
    try:
        score = score_trajectory(positions, scene, every=every)
    except NonFiniteError:
        return {"finite": False, **dict.fromkeys(SCORE.values())}
    return {"finite": True, **{column: score[name] for name, column in SCORE.items()}}


def row_of(
    method: str, effort: str, wall: np.ndarray, processor: np.ndarray, positions: np.ndarray, scene: Scene
) -> dict[str, Any]:
    """Return a method's row of a table."""
    times = {"frame_ms": float(np.median(wall)), "frame_cpu_ms": float(np.median(processor))}
    return {"method": method, "effort": effort, **times, **describe_rollout(positions, scene)}


def measure_scene(scene: Scene, is_smoke: bool) -> list[dict[str, Any]]:
    """Return a row of plain values per method and effort: ours, with strict contact, Newton's, Blender's."""
    methods = [our_method(scene, *effort) for effort in (OURS[-1:] if is_smoke else OURS)]
    rows = starting_rows(scene.garment.vertex_mask.shape[0])
    strict = scene.replace(terms=(*scene.terms, Contact(rows=rows)))
    methods += [our_method(strict, *effort, "ours, strict") for effort in (() if is_smoke else OUR_STRICT)]
    methods += newton_methods(scene, SMOKE_SETTINGS if is_smoke else SETTINGS)
    positions, (wall, processor) = take_turns(methods, scene, scene.num_frames)
    gap, initial = teach(methods, scene)
    rows = [
        row_of(method.name, method.effort, wall[k], processor[k], positions[k], scene)
        | summarize_gap(gap[k], initial)
        for k, method in enumerate(methods)
    ]
    return rows + blender_rows(scene, BLENDER[:1] if is_smoke else BLENDER)


def blender_rows(scene: Scene, efforts: tuple[tuple[int, int], ...]) -> list[dict[str, Any]]:
    """Return a row per effort of Blender's; none, and a line that says what is missing, without it."""
    if blender_python() is None:
        print("Blender left out: BLENDER_PYTHON names no Python with bpy", file=sys.stderr)
        return []
    runs = {"{}x{}".format(*effort): run_blender(scene, effort) for effort in efforts}
    return [
        row_of(f"Blender {run.version}", effort, run.wall, run.processor, run.positions, scene)
        for effort, run in runs.items()
    ]


def summarize_gap(gap: np.ndarray, initial: np.ndarray) -> dict[str, float | None]:
    """Return medians and largest values; None where a position was not finite."""
    gap = np.maximum(gap, 0.0)
    share = gap / initial
    values = dict(zip(GAPS, (np.median(share), np.max(share), np.median(gap)), strict=True))
    return {name: float(value) if np.isfinite(value) else None for name, value in values.items()}


def peer_points(scenes: list[Scene], settings: tuple[Setting, ...]) -> dict[str, list[dict[str, Any]]]:
    """Return what Newton's solvers take and leave as `speed_vs_error` does; the first of the scenes is timed."""
    methods, relative = [newton_methods(scenes[0], settings)], []
    if not methods[0]:
        return {}
    methods += [newton_methods(scene, settings) for scene in scenes[1:]]
    _, (wall, _) = take_turns(methods[0], scenes[0], min(TIMED_FRAMES, scenes[0].num_frames))
    for scene, of_scene in zip(scenes, methods, strict=True):
        gap, initial = teach(of_scene, scene)
        relative.append([np.maximum(values, 0.0) / initial for values in gap])
    points: dict[str, list[dict[str, Any]]] = {}
    for k, method in enumerate(methods[0]):
        shares = np.concatenate([values[k] for values in relative])
        if np.isfinite(shares).all():
            row = point(method.effort, float(np.median(wall[k])), shares)
            points.setdefault(method.name, []).append(row)
    return points


def point(iterations: int | str, frame_ms: float, shares: np.ndarray) -> dict[str, Any]:
    """Return a point of speed against error; shares are gaps relative to the initial gap."""
    return {
        "iterations": iterations,
        "frame_ms": frame_ms,
        "gap_relative_median": float(np.median(shares)),
        "gap_relative_p99": float(np.quantile(shares, 0.99)),
    }


COLUMNS = {
    "method": "method", "effort": "substeps x iterations", "frame_ms": "ms a frame",
    "frame_cpu_ms": "CPU ms", "gap_relative_median": "gap, median [%]",
    "gap_relative_own": "on its own rollout [%]", "pooled_stretch_p99": "stretch, 99 % of faces",
    "penetration_p999_mm": "penetration, 99.9 % [mm]", "intersections_body": "pairs with the body",
    "intersections_cloth": "pairs of cloth",
}  # fmt: skip


def peer_versions() -> dict[str, str]:
    """Return the versions of the peers' packages that are installed."""
    installed = {package.name: package.version for package in importlib.metadata.distributions()}
    return {name: installed[name] for name in ("newton", "warp-lang", "ipctk") if name in installed}


def main() -> None:
    options = parser(__doc__, "one scene, one setting per solver, few frames")
    options.add_argument("--scenes", nargs="+", default=["tshirt_1k", "tshirt_4k", "tshirt_10k"])
    options.add_argument("--frames", type=int, default=40)
    chosen = options.parse_args()
    if chosen.smoke:
        chosen.scenes, chosen.frames = ["tshirt_1k"], 8
    result: dict[str, Any] = {
        "clip": CLIP, "frames": chosen.frames, "processor": device_name(), "cores": cores(),
        "date": time.strftime("%Y-%m-%d"), **environment(),
        "scenes": kept(chosen.out / "peers.json").get("scenes", {}),
    }  # fmt: skip
    result["versions"] |= peer_versions()
    for name in chosen.scenes:
        scene = example_scene(*name.split("_"), CLIP, chosen.frames)
        result["scenes"][name] = rows = measure_scene(scene, chosen.smoke)
        result["load"] = os.getloadavg()[0] if hasattr(os, "getloadavg") else None  # 1: nothing else runs
        keep(chosen.out / "peers.json", result)
        percent = [
            {k: 100 * v if v and k.startswith("gap_relative") else v for k, v in row.items()} for row in rows
        ]
        print(f"\n{name}\n\n{markdown(COLUMNS, percent)}", flush=True)
        jax.clear_caches()


if __name__ == "__main__":
    main()
