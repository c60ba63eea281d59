"""`eslr score`, `eslr evaluate`, `eslr calibrate`: measure a trajectory, a network, a machine."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from eslr_jax.config import EvaluationOptions
from eslr_jax.errors import ConfigError, MeshError, MotionError
from eslr_jax.pipeline.cli.batch import MANIFEST, read_manifest
from eslr_jax.pipeline.cli.console import app, print_report, progress, say, use_compile_cache, waiting
from eslr_jax.pipeline.cli.method import load_actor
from eslr_jax.pipeline.cli.options import Options

if TYPE_CHECKING:
    from eslr_jax.pipeline.formats.garment import GarmentFile
    from eslr_jax.pipeline.formats.mesh_sequence import MeshSequence
    from eslr_jax.pipeline.report.run import Run
    from eslr_jax.types import BodyMotion, Scene, Trajectory

# [m] on average from where the garment is worn, from which a first frame is in other units or axes
_FAR = 0.5
_SAME_RATE = 0.01  # relative


@app.command(name="score")
@dataclasses.dataclass(frozen=True)
class Score:
    """Score anybody's simulation: optimality gap, energies, stretch, penetration, intersections.

    Describe the scene by a run of `eslr simulate`, or by garment, body and motion. The gap is measured in our
    energy. Each frame is compared with the optimum that follows from the trajectory's own previous state.
    """

    # The garment in motion, in metres, Y up, at 30 frames a second, with the vertices of the garment in their
    # order: an .npz with positions [frames, vertices, 3] and faces, a .glb whose shapes move it, an .abc, or a
    # folder of OBJ or PLY files. If a .glb or .abc has several meshes, they are the garments of an outfit, by
    # name; FILE.glb#NAME picks one. A run of `eslr simulate` also works, and holds its own scene;
    # so does the folder of `eslr batch`, of which every scene is scored.
    file: tyro.conf.Positional[str]
    # Folder of a run: its garment, fabric, body, motion, ground and wind, and how it stepped time.
    run: Path | None = None
    # Name of a bundled garment, or a mesh file; tshirt if not given. Give it again for what is worn over it,
    # as for `eslr simulate`.
    garment: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    # Motion as for `eslr simulate`; cmu_016_32 if not given, from its first frame on.
    motion: str | None = None
    # Body as for `eslr simulate`; anny if not given.
    body: str | None = None
    # Resolution of a bundled garment; 1k if not given.
    vertices: Literal["1k", "4k", "10k", "50k", "200k"] | None = None
    # Fabric as for `eslr simulate`; cotton if not given.
    fabric: tuple[str, ...] = ()
    # Measure gap and intersections in every n-th frame.
    every: int = 4
    # Print as JSON.
    json: bool = False

    def __call__(self) -> None:
        """Score, and print the report."""
        from eslr_jax.pipeline.report.report import environment

        use_compile_cache()
        if (Path(self.file) / MANIFEST).is_file():
            return self._score_batch(Path(self.file))
        with waiting("reading"):
            task = self._read_task()
        with waiting("scoring"):
            result = _score(task, self.every)
        result = {"file": self.file, **task.label, **result, **environment()}
        if result["intersections_cloth"] is None:
            say('intersections are not counted: that needs ipctk: pip install "eslr-jax[score]"')
        if self.json:
            print(json.dumps(result, indent=2))
        else:
            print_report({"error": None, "tolerance": None, **result}, _figures(result))

    def _score_batch(self, folder: Path) -> None:
        """Score the scenes of a batch that are done, and print a row for each."""
        from eslr_jax.pipeline.report.run import read_run

        entries = {name: entry for name, entry in read_manifest(folder).items() if entry["status"] == "done"}
        rows = []
        with progress("scoring", len(entries)) as advance:
            for done, (name, entry) in enumerate(sorted(entries.items()), 1):
                score = _score(_own_task(read_run(folder / name)), self.every)
                rows.append({"scene": name, "split": entry["split"], **score})
                advance(done, len(entries))
        if self.json:
            print(json.dumps(rows, indent=2))
            return
        table = Table("scene", "split", "gap, median", "at most", "stretch, 99 %", "inside [mm]", box=None)
        for row in rows:
            shares = (f"{100 * row[key]:.3g} %" for key in ("gap_relative_median", "gap_relative_max"))
            depth = row["penetration_max_mm"]
            figures = f"{row['p99_principal_stretch']:.3f}", "" if depth is None else f"{depth:.2f}"
            table.add_row(row["scene"], row["split"], *shares, *figures)
        Console().print(table, markup=False, highlight=False)

    def _read_task(self) -> _Task:
        """Read the trajectory, and its scene from itself, a run, or the names that are given."""
        from eslr_jax.pipeline.formats.mesh_sequence import read_mesh_sequences
        from eslr_jax.pipeline.report.run import is_run, read_run

        named = ("garment", "motion", "body", "vertices", "fabric")
        given = {name: value for name in named if (value := getattr(self, name))}
        is_own = is_run(self.file)
        if given and (is_own or self.run is not None):
            raise ConfigError(
                f"{self.run or self.file} tells its own scene; leave out --{', --'.join(given)}"
            )
        if is_own and self.run is not None:
            raise ConfigError(f"{self.file} tells its own scene; leave out --run")
        if is_own:
            return _own_task(read_run(self.file))
        sequences = read_mesh_sequences(self.file)
        return _named_task(sequences, given) if self.run is None else _run_task(sequences, read_run(self.run))


class _Task(NamedTuple):
    """A trajectory and what it is of."""

    trajectory: Trajectory | np.ndarray
    scene: Scene
    poses: BodyMotion | None
    stored: GarmentFile | None
    label: dict[str, Any]


def _score(task: _Task, every: int) -> dict[str, Any]:
    """Return the score of a trajectory."""
    from eslr_jax.pipeline.report.score import score_trajectory

    stored = task.stored
    return score_trajectory(
        task.trajectory,
        task.scene,
        poses=task.poses,
        parts=(None, ()) if stored is None else (stored.face_parts, stored.part_names),
        outfit=None if stored is None else stored.outfit,
        every=every,
    )


def _own_task(run: Run) -> _Task:
    """Return a run as the trajectory of its own scene."""
    from eslr_jax.pipeline.report.run import run_poses, run_trajectory

    return _Task(run_trajectory(run), run.scene, run_poses(run), run.garment, {"run": run.name})


def _run_task(sequences: list[MeshSequence], run: Run) -> _Task:
    """Return a trajectory in the scene of a run, cut to its length."""
    from eslr_jax.pipeline.formats.garment import in_outfit_order
    from eslr_jax.pose.motion import first_poses
    from eslr_jax.simulation.plan import first_frames

    task = _own_task(run)
    if run.garment is None:
        raise ConfigError(
            f"{run.name} has no garment.npz, which tells its garment; give a run of `eslr simulate`"
        )
    positions = in_outfit_order(sequences, run.garment)
    count = len(positions)
    if count > task.scene.num_frames:
        raise MotionError(
            f"{sequences[0].name} has {count} frames, {run.name} only {task.scene.num_frames}; cut it"
        )
    scene = first_frames(task.scene, count)
    _check_sequence(sequences[0], positions, scene)
    poses = None if task.poses is None else first_poses(task.poses, count)
    return task._replace(trajectory=positions, scene=scene, poses=poses)


def _named_task(sequences: list[MeshSequence], given: dict[str, Any]) -> _Task:
    """Return a trajectory in the scene of garments, a body and a motion."""
    from eslr_jax.pipeline.assets import load_garment_file, prepare_stored
    from eslr_jax.pipeline.assets.garments import check_resolution, warn_of_fit
    from eslr_jax.pipeline.dressing.outfit import garment_names, wear_together
    from eslr_jax.pipeline.fabrics import garment_material
    from eslr_jax.pipeline.formats.garment import in_outfit_order
    from eslr_jax.simulation.plan import prepare_scene
    from eslr_jax.terms import FAST

    if len(sequences) > 1 and "garment" not in given:
        known = ", ".join(sequence.mesh for sequence in sequences)
        raise ConfigError(
            f"{sequences[0].name} is one of the meshes {known}; give --run, or --garment for every garment and "
            "the innermost first, or score one mesh of the file as FILE#NAME"
        )
    options = Options(**given, frames=len(sequences[0].positions))
    files = options.garments
    check_resolution(files, options.vertices)
    rig, poses, motion, _ = load_actor(options)
    garments = [load_garment_file(file, vertices=options.vertices, body=rig) for file in files]
    for file, worn in zip(files, garments, strict=True):
        warn_of_fit(file, worn)
    stored, label = wear_together(garments, files), "+".join(files)
    by_name = dict(zip(garment_names(files), garments, strict=True))
    positions = in_outfit_order(sequences, stored, by_name)
    cloth = prepare_stored(stored, name=label)
    material = garment_material(options.fabric, cloth, stored)
    scene = prepare_scene(cloth, poses, material=material, terms=FAST)  # no body has yielded to it
    _check_sequence(sequences[0], positions, scene)
    return _Task(positions, scene, poses, stored, {"garment": label, "motion": motion, "body": options.body})


def _check_sequence(sequence: MeshSequence, positions: np.ndarray, scene: Scene) -> None:
    """Raise unless a sequence has the rate of its scene and begins where the garment is worn."""
    rate = 1.0 / float(scene.timestep)
    if abs(sequence.fps - rate) > _SAME_RATE * rate:
        raise MotionError(
            f"{sequence.name} has {sequence.fps:g} frames a second, the scene {rate:g}; write it with {rate:g}"
        )
    away = np.linalg.norm(positions[0] - np.asarray(scene.initial_state.position), axis=1).mean()
    if away > _FAR:
        raise MeshError(
            f"{sequence.name} begins {away:.3g} m from where the garment is worn; give metres, Y up, "
            "on the body"
        )


def _figures(result: dict[str, Any]) -> dict[str, str]:
    """Return what a score has besides a run's report, as text."""
    rows = {
        "optimality gap": (
            f"{100 * result['gap_relative_median']:.3g} % of the initial gap, "
            f"{100 * result['gap_relative_max']:.3g} % at most; {1e3 * result['gap_median_j']:.3g} mJ "
            f"(median of {result['gap_frames']} frames)"
        ),
    }
    if result["intersections_cloth"] is not None:
        rows["intersections"] = (
            f"{result['intersections_cloth']} pairs of cloth and {result['intersections_body']} with the body in "
            f"the last frame, {result['intersections_cloth_max']} and {result['intersections_body_max']} at most"
        )
    return rows


@app.command(name="evaluate")
@dataclasses.dataclass(frozen=True, kw_only=True)
class Evaluate(EvaluationOptions):
    """Evaluate a network on a split: optimality gap, and free rollouts."""

    # Name of a bundled network, or an exported file.
    model: str
    # Solver iterations behind the network.
    iterations: int = 0
    # Print as JSON.
    json: bool = False

    def __call__(self) -> None:
        """Evaluate, and print the gaps beside those of the solver."""
        from eslr_jax.pipeline.assets import load_model
        from eslr_jax.pipeline.report.evaluate import evaluate
        from eslr_jax.pipeline.report.report import environment

        network = load_model(self.model)
        use_compile_cache()
        with progress("evaluating", 1) as advance:
            result = evaluate(
                network,
                self,
                iterations=self.iterations,
                on_scene=lambda done, total, label: advance(done, total),
            )
        named = {"model": self.model, "iterations": self.iterations, "control": self.control}
        result = {**named, **result, **environment()}
        if self.json:
            print(json.dumps(result, indent=2))
            return
        if "on_policy" in result:
            _print_gaps(self.model, result)
        print(json.dumps(result["rollout"], indent=2))


def _print_gaps(model: str, result: dict[str, Any]) -> None:
    """Print the gaps of a network beside those of the solver."""
    table = Table(
        "", "gap, median [mJ]", "relative to the initial gap", "on the model's own states [mJ]", box=None
    )
    own = result["on_policy"]
    rows = {model: (result, own)}
    rows |= {f"L-BFGS {count}": (result["lbfgs"][count], own["lbfgs"][count]) for count in result["lbfgs"]}
    for label, (forced, policy) in rows.items():
        table.add_row(
            label,
            f"{forced['gap_median_j'] * 1e3:.3f}",
            f"{forced['gap_relative_median']:.4f}",
            f"{policy['gap_median_j'] * 1e3:.3f}",
        )
    Console().print(table, markup=False)


@app.command(name="calibrate")
@dataclasses.dataclass(frozen=True)
class Calibrate:
    """Measure what a frame costs on this device, for `eslr simulate --budget` and expected times.

    Takes a few minutes on an otherwise idle machine. The result is kept with the compiled programs.
    """

    # Bundled networks to measure beside the solver; if not given, the default network and the one that was
    # trained as a start for the solver.
    models: tuple[str, ...] = ()
    # File to write to, instead of the one that `eslr simulate` reads.
    out: Path | None = None

    def __call__(self) -> None:
        """Measure, write the calibration, and print it."""
        from eslr_jax.files.atomic import ensure_output_dir
        from eslr_jax.pipeline.assets.budget import cache_path, write_calibration
        from eslr_jax.pipeline.assets.models import DEFAULT_MODEL, START_MODEL
        from eslr_jax.pipeline.report.calibrate import calibrate
        from eslr_jax.pipeline.report.report import environment

        use_compile_cache()
        path = self.out or cache_path()
        ensure_output_dir(path.parent)  # before minutes are spent
        with waiting("measuring"):
            measured = calibrate(self.models or (START_MODEL, DEFAULT_MODEL))
        write_calibration(measured, path, environment())
        table = Table("", "vertices", "per frame [ms]", "per iteration [ms]", box=None)
        for cost in measured.costs:
            table.add_row(cost.name, str(cost.vertices), f"{cost.fixed_ms:.1f}", f"{cost.iteration_ms:.2f}")
        Console().print(table, markup=False)
        print(path)
