"""Systems by name, and free rollouts measured by HOOD's six terms and their Total, as in the paper's tables."""

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple, get_args

import harness
import jax
import numpy as np

from eslr_jax import Network, SimConfig, Trajectory, rollout_scene
from eslr_jax.pipeline.assets.budget import SOLVER
from eslr_jax.pipeline.assets.models import model_record
from eslr_jax.pipeline.report.calibrate import simulator_of
from eslr_jax.pipeline.report.evaluate import (
    EMBEDDING_CONTROLS,
    Control,
    control_garment,
    control_network,
    distance_mm,
)
from eslr_jax.pipeline.report.gap import OptimalityGap, stepped_potentials, trajectory_gap
from eslr_jax.pipeline.report.metrics import extremes, measure_frames
from eslr_jax.pose.lbs import skin_garment
from eslr_jax.simulation.batch import simulate_scenes
from eslr_jax.terms.hood import HoodParameters
from eslr_jax.types import Scene
from paper import mat, posed, ssch
from paper.hood_metrics import hood_metrics
from paper.mat_space import prepare_space
from paper.worn import OPTIMUM_ITERATIONS, Setting, Worn, check_optimum, not_finite, wear

RESULTS = harness.RESULTS / "paper"
OPTIMUM, GUESS, SKINNED = "optimum", "guess", "skinned"
CONTROLS: tuple[Control, ...] = get_args(Control)
CONTROLS_OF_WEIGHTS = tuple(name for name in CONTROLS if name not in EMBEDDING_CONTROLS)
EMBEDDINGS = ("raw", "landmarks")  # modes beside the canonical one, with which networks were trained
TERMS = ("stretch", "bending", "inertia", "collision", "friction", "gravity")
_ORIGIN_ABOVE_ROOT = 0.22  # [m]; SMPL's origin, from which HOOD counts heights, is this far above the pelvis
_GAP_FRAMES = 10  # of every rollout, from whose states the gap is measured
_GAPS = ("gap_mj", "gap_share", "own_gap_mj", "own_gap_share")


class System(NamedTuple):
    """A simulator of the tables."""

    network: Network | None
    config: SimConfig
    cost: Mapping[str, float] = MappingProxyType({})  # parameters, and core-hours where they are known
    garment_options: Mapping[str, Any] = MappingProxyType({})  # of `load_garment`
    control: Control | None = None
    network_on: Callable[[Worn], Network] | None = None  # made for one scene


def read_system(name: str) -> System:
    """Return the system of a name.

    It is `OPTIMUM`; `GUESS`, the solver's own guess untouched; or a bundled network or exported file, as
    NAME[:STEPS][+ITERATIONS][~CHANGE]. STEPS are refinement steps, ITERATIONS the solver's behind it. CHANGE is a
    control of `pipeline.report.evaluate` or another mode of the geodesic embedding. SYSTEM@FOLDER is one of
    `posed.SYSTEMS`, "ssch" or "mat" with the networks that were trained there. Their control is `SKINNED`, the
    garment carried by the joints; mat's is "mat@FOLDER~untrained".
    """
    if name == SKINNED:
        return _replayed(lambda worn: skin_garment(worn.scene.garment, worn.poses.joint_transforms), {})
    if "@" in name:
        return _read_trained(*name.split("@", 1))
    if name in (OPTIMUM, GUESS):
        iterations = OPTIMUM_ITERATIONS if name == OPTIMUM else 0
        return System(*simulator_of(SOLVER, iterations))
    file, _, change = name.partition("~")
    file, _, iterations = file.partition("+")
    network, config = simulator_of(file, int(iterations or 0))
    assert network is not None
    options, control = network.garment_options, None
    if change in EMBEDDINGS:
        options = {**options, "embedding_mode": change}
    elif change in CONTROLS:
        control = change
        network = control_network(control, network)
    elif change:
        raise SystemExit(f"{name}: no change {change!r}; there are {', '.join((*CONTROLS, *EMBEDDINGS))}")
    cost = {"parameters": network.num_parameters}
    hours = model_record(file).get("core_hours")
    if hours is not None and control not in CONTROLS_OF_WEIGHTS:  # those show nothing of the training
        cost["core_hours"] = hours
    return System(network, config, cost, options, control)


def _read_trained(kind: str, folder: str) -> System:
    """Return a system with one network a garment; its training cost is that of all of them."""
    folder, _, change = folder.partition("~")
    if change not in ("", "untrained") or (change and kind != "mat"):
        raise SystemExit(f"{kind}@{folder}~{change}: only mat has a change, and only untrained")
    reader: Any = {"ssch": ssch, "mat": mat}.get(kind, posed)
    found = [reader.read_network(path) for path in sorted(Path(folder).glob(f"{kind}_*.npz"))]
    if not found:
        raise SystemExit(f"{kind}@{folder}: {folder} holds no {kind}_GARMENT.npz; train it first")
    cost = {
        "parameters": sum(leaf.size for leaf in jax.tree.leaves(found[0][0].params)),
        "core_hours": sum(training["core_hours"] for _, training in found),
    }
    simulated = sum(training.get("truth_core_hours", 0.0) for _, training in found)
    if simulated:
        cost["truth_core_hours"] = simulated

    def weights_of(worn: Worn) -> Any:
        return reader.read_network(Path(folder) / f"{kind}_{worn.garment}.npz")[0]

    if kind != "mat":
        return _replayed(
            lambda worn: reader.displace(weights_of(worn), worn.scene.garment, worn.poses.joint_transforms),
            cost,
        )

    def stepper_of(worn: Worn) -> Network:
        weights = weights_of(worn)
        weights = mat.untrained(weights) if change else weights
        return Network(weights.replace(space=prepare_space(worn.scene.garment)), mat.Mat())

    return System(None, SimConfig(iterations=0), {} if change else cost, network_on=stepper_of)


def _replayed(positions: Callable[[Worn], Any], cost: Mapping[str, float]) -> System:
    """Return the system whose positions are known beforehand."""
    return System(
        None, SimConfig(iterations=0), cost, network_on=lambda worn: Network(positions(worn), posed.Replay())
    )


class Reference(NamedTuple):
    """The near-optimal rollout of a scene."""

    trajectory: Trajectory
    gap: OptimalityGap  # from some of its states


def scenes_of(system: System, setting: Setting) -> Iterator[tuple[Worn, Network | None]]:
    """Yield every garment on every clip with the system's network; all share a compiled rollout."""
    for worn in wear(tuple(system.garment_options.items()), setting):
        network = system.network
        if system.control is not None:
            changed = control_garment(system.control, worn.scene.garment)
            worn = worn._replace(scene=worn.scene.replace(garment=changed))
        if system.network_on is not None:
            network = system.network_on(worn)
        yield worn, network


def roll(system: System, setting: Setting) -> list[tuple[Worn, Network | None, Trajectory]]:
    """Return every garment on every clip with the system's network and its free rollout.

    A network for all scenes goes through them together, see `simulate_scenes`.
    """
    worn = list(scenes_of(system, setting))
    if system.network_on is None:
        found = simulate_scenes(system.network, [one.scene for one, _ in worn], config=system.config)
    else:
        found = [rollout_scene(network, one.scene, system.config) for one, network in worn]
    return [(*pair, trajectory) for pair, trajectory in zip(worn, found, strict=True)]


def find_references(setting: Setting) -> list[Reference]:
    """Return the near-optimal rollout of every scene, checked to be finite, and the optima from its states."""
    system = read_system(OPTIMUM)
    found = []
    for worn, _, trajectory in roll(system, setting):
        check_optimum(trajectory, worn.garment)
        gap = trajectory_gap(trajectory, worn.scene, every=_gap_every(setting))
        found.append(Reference(trajectory, gap))
        print(worn.garment, OPTIMUM, flush=True)
    return found


def measure_system(
    name: str, setting: Setting, references: Sequence[Reference]
) -> dict[str, dict[str, float]]:
    """Return the measures of a system on every garment, and on "all" of them.

    Energies and distances are means over frames, clips and garments; gaps are medians over frames: from the
    states of the near-optimal rollout ("gap"), and from those of the system's own ("own_gap"). "stretch_median"
    is the median over rollouts of their mean stretch energy, on which a single torn rollout has no weight.
    "not_finite" is the share of rollouts with a prediction that was not finite.
    """
    system, every = read_system(name), _gap_every(setting)
    measured: dict[str, list[dict[str, float]]] = {}
    gaps: dict[str, list[np.ndarray]] = {}
    for (worn, network, trajectory), (reference, gap) in zip(roll(system, setting), references, strict=True):
        garment, scene, _ = worn
        row = measure(trajectory, scene, worn.root_height())
        row["distance_mm"] = distance_mm(trajectory, reference, scene)
        row["not_finite"] = not_finite(trajectory)
        left = stepped_potentials(network, reference, scene, system.config, every) - gap.optimum
        own = trajectory_gap(trajectory, scene, every=every)
        own_left = own.reached - own.optimum
        measured.setdefault(garment, []).append(row)
        gaps.setdefault(garment, []).append(
            np.stack([left * 1e3, left / gap.initial_gap, own_left * 1e3, own_left / own.initial_gap])
        )
    measured["all"] = list(itertools.chain.from_iterable(measured.values()))
    gaps["all"] = list(itertools.chain.from_iterable(gaps.values()))
    rows = {}
    for garment, found in measured.items():
        medians = np.median(np.concatenate(gaps[garment], axis=1), axis=1)
        means = {column: float(np.mean([row[column] for row in found])) for column in found[0]}
        means["stretch_median"] = float(np.median([row["stretch"] for row in found]))
        rows[garment] = {**means, **dict(zip(_GAPS, medians.tolist(), strict=True))}
    print(name, {column: round(value, 4) for column, value in rows["all"].items()}, flush=True)
    if share := rows["all"]["not_finite"]:
        print(f"{name}: a frame was not finite in {share:.0%} of the rollouts; the guess may stand in for it")
    return rows


def _gap_every(setting: Setting) -> int:
    """Return at every which frame the gap is measured."""
    return max((setting.frames - 1) // _GAP_FRAMES, 1)


def measure(trajectory: Trajectory, scene: Scene, root_height: float) -> dict[str, float]:
    """Return the terms [J] as means over frames, their Total, and stretch and penetration beside it.

    HOOD counts potential energy from near the height of the root joint in the first frame [m].
    """
    origin = np.array([0.0, root_height + _ORIGIN_ABOVE_ROOT, 0.0], np.float32)
    found = hood_metrics(
        trajectory.positions, scene, origin=origin, parameters=HoodParameters(), criterion="postcvpr"
    )
    terms = {name: float(np.mean(found[name])) for name in TERMS}
    frames = measure_frames(trajectory.positions, scene)
    return {**terms, "total": sum(terms.values()), **extremes(frames, np.asarray(scene.garment.vertex_mask))}
