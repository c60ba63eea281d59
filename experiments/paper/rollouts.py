"""Systems by name, and free rollouts measured by HOOD's six terms and their Total, as in the paper's tables."""

from __future__ import annotations

import argparse
import functools
import itertools
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np
from hood_metrics import hood_metrics

from eslr_jax.assets import load_body, load_garment, load_motion
from eslr_jax.assets.load import model_record
from eslr_jax.body.motion import pose_body
from eslr_jax.config import ModelConfig, SimConfig
from eslr_jax.evaluation.calibrate import simulator_of
from eslr_jax.evaluation.controls import Control, control_garment, control_params
from eslr_jax.evaluation.evaluate import back_and_forth, distance_mm
from eslr_jax.evaluation.gap import OptimalityGap, stepped_potentials, trajectory_gap
from eslr_jax.evaluation.metrics import measure_frames
from eslr_jax.evaluation.report import environment
from eslr_jax.io.atomic import atomic_write
from eslr_jax.models.registry import count_parameters
from eslr_jax.physics.hood import HoodParameters
from eslr_jax.physics.materials import COTTON
from eslr_jax.scene.plan import prepare_scenes
from eslr_jax.simulation.budget import SOLVER
from eslr_jax.simulation.rollout import rollout_scene
from eslr_jax.types import Scene, Trajectory

RESULTS = Path(__file__).parents[1] / "results" / "paper"
OPTIMUM, GUESS = "optimum", "guess"
CONTROLS: tuple[Control, ...] = get_args(Control)
EMBEDDINGS = ("raw", "landmarks")  # modes beside the canonical one, with which networks were trained
TERMS = ("stretch", "bending", "inertia", "collision", "friction", "gravity")
_ORIGIN_ABOVE_ROOT = 0.22  # [m]; SMPL's origin, from which HOOD counts heights, is this far above the pelvis
_OPTIMUM_ITERATIONS = 60  # of L-BFGS: leaves 0.05 % of the initial gap
_GAP_FRAMES = 10  # of every rollout, from whose states the gap is measured


def arguments(description: str | None) -> argparse.ArgumentParser:
    """Return the parser of the options that every script of this folder has."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--vertices", default="1k", choices=["1k", "4k", "10k"])
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--smoke", action="store_true", help="few frames of one garment on one clip")
    return parser


class System(NamedTuple):
    """A simulator of the tables."""

    params: Any  # weights; None without a network
    config: SimConfig
    garment_options: dict[str, Any]  # of `load_garment`
    control: Control | None
    cost: dict[str, float]  # parameters, and core-hours of the training where they are known


def read_system(name: str) -> System:
    """Return the system of a name.

    Args:
        name: `OPTIMUM`; `GUESS`, the solver's own guess untouched; or a bundled network or exported file, as
            NAME[:STEPS][+ITERATIONS][~CHANGE]. STEPS are refinement steps, ITERATIONS the solver's behind it.
            CHANGE is a control of `evaluation.controls` or another mode of the geodesic embedding.
    """
    if name in (OPTIMUM, GUESS):
        iterations = _OPTIMUM_ITERATIONS if name == OPTIMUM else 0
        return System(*simulator_of(SOLVER, iterations), ModelConfig().garment_options, None, {})
    network, _, change = name.partition("~")
    network, _, iterations = network.partition("+")
    params, config = simulator_of(network, int(iterations or 0))
    assert isinstance(config.model, ModelConfig)
    options, control = config.model.garment_options, None
    if change in EMBEDDINGS:
        options = {**options, "embedding_mode": change}
    elif change in CONTROLS:
        control = change
        params = control_params(control, params, config.model)
    elif change:
        raise SystemExit(f"{name}: no change {change!r}; there are {', '.join((*CONTROLS, *EMBEDDINGS))}")
    cost = {"parameters": count_parameters(params)}
    hours = model_record(network).get("core_hours")
    return System(params, config, options, control, cost if hours is None else {**cost, "core_hours": hours})


class Setting(NamedTuple):
    """What the rows of a table share."""

    garments: tuple[str, ...]  # names of bundled garments
    clips: tuple[str, ...]  # names of bundled clips, played back and forth
    frames: int  # of every rollout
    vertices: str


class Reference(NamedTuple):
    """The near-optimal rollout of a scene."""

    trajectory: Trajectory
    gap: OptimalityGap  # from some of its states


def scenes_of(system: System, setting: Setting) -> Iterator[tuple[str, Scene, float]]:
    """Yield garment, scene and height of the root joint in the first frame [m]; all share a compiled rollout."""
    for name, scene, height in _prepare(tuple(system.garment_options.items()), setting):
        if system.control is not None:
            scene = scene.replace(garment=control_garment(system.control, scene.garment))
        yield name, scene, height


@functools.lru_cache(maxsize=1)
def _prepare(
    garment_options: tuple[tuple[str, Any], ...], setting: Setting
) -> list[tuple[str, Scene, float]]:
    """Return what `scenes_of` yields; most systems ask for the same."""
    body = load_body()
    motions = [
        pose_body(body, back_and_forth(load_motion(clip), setting.frames), num_frames=setting.frames)
        for clip in setting.clips
    ]
    names = [name for name in setting.garments for _ in motions]
    worn = [load_garment(name, vertices=setting.vertices, **dict(garment_options)) for name in names]  # type: ignore[arg-type]
    poses = motions * len(setting.garments)
    scenes = prepare_scenes(worn, poses, [COTTON] * len(worn))
    root = np.append(np.asarray(body.joint_rest_positions[0]), 1.0)
    heights = [float((moving.joint_transforms[0, 0] @ root)[1]) for moving in poses]
    return list(zip(names, scenes, heights, strict=True))


def find_references(setting: Setting) -> list[Reference]:
    """Return the near-optimal rollout of every scene, and the optima from its states."""
    system = read_system(OPTIMUM)
    found = []
    for name, scene, _ in scenes_of(system, setting):
        trajectory = rollout_scene(system.params, scene, system.config)
        found.append(Reference(trajectory, trajectory_gap(trajectory, scene, every=_gap_every(setting))))
        print(name, OPTIMUM, flush=True)
    return found


def measure_system(
    name: str, setting: Setting, references: Sequence[Reference]
) -> dict[str, dict[str, float]]:
    """Return the measures of a system on every garment, and on "all" of them.

    Energies and distances are means over frames, clips and garments; gaps are medians over frames.
    """
    system, every = read_system(name), _gap_every(setting)
    measured: dict[str, list[dict[str, float]]] = {}
    gaps: dict[str, list[np.ndarray]] = {}
    for (garment, scene, height), (reference, gap) in zip(
        scenes_of(system, setting), references, strict=True
    ):
        trajectory = rollout_scene(system.params, scene, system.config)
        row = measure(trajectory, scene, height) | {"distance_mm": distance_mm(trajectory, reference, scene)}
        left = stepped_potentials(system.params, reference, scene, system.config, every) - gap.optimum
        measured.setdefault(garment, []).append(row)
        gaps.setdefault(garment, []).append(np.stack([left * 1e3, left / gap.initial_gap]))
    measured["all"] = list(itertools.chain.from_iterable(measured.values()))
    gaps["all"] = list(itertools.chain.from_iterable(gaps.values()))
    rows = {}
    for garment, found in measured.items():
        energy, share = np.median(np.concatenate(gaps[garment], axis=1), axis=1)
        means = {column: float(np.mean([row[column] for row in found])) for column in found[0]}
        rows[garment] = {**means, "gap_mj": float(energy), "gap_share": float(share)}
    print(name, {column: round(value, 4) for column, value in rows["all"].items()}, flush=True)
    return rows


def _gap_every(setting: Setting) -> int:
    """Return at every which frame the gap is measured."""
    return max((setting.frames - 1) // _GAP_FRAMES, 1)


def measure(trajectory: Trajectory, scene: Scene, root_height: float) -> dict[str, float]:
    """Return the terms [J] as means over frames, their Total, and stretch and penetration beside it.

    Args:
        trajectory: A rollout.
        scene: Its scene, with a body.
        root_height: Height of the root joint in the first frame [m]; HOOD counts potential energy from near it.
    """
    origin = np.array([0.0, root_height + _ORIGIN_ABOVE_ROOT, 0.0], np.float32)
    metrics = hood_metrics(
        trajectory.positions, scene, origin=origin, parameters=HoodParameters(), criterion="postcvpr"
    )
    terms = {name: float(np.mean(getattr(metrics.terms, name))) for name in TERMS}
    frames = measure_frames(trajectory, scene)
    depth = -np.asarray(frames.distances)
    return {
        **terms,
        "total": sum(terms.values()),
        "stretch_p99": float(np.quantile(frames.max_stretch, 0.99)),
        "penetration_p999_mm": float(max(np.quantile(depth, 0.999), 0.0) * 1e3),
    }


def write(result: dict[str, Any], path: Path) -> None:
    """Write a result with the versions that made it, and print its mean rows."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps({**result, "environment": environment()}, indent=1) + "\n")
    for model, row in result.get("mean", {}).items():
        print(model, " ".join(f"{name} {value:.3g}" for name, value in row.items()))
