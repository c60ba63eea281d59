"""`eslr score`: anybody's trajectory, measured as our own."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import numpy as np
import tyro

from eslr_jax.cli.actor import load_actor
from eslr_jax.cli.console import app, print_report, say, use_compile_cache, waiting
from eslr_jax.cli.options import DEFAULT_GARMENT, Options
from eslr_jax.errors import ConfigError, MeshError, MotionError

if TYPE_CHECKING:
    from eslr_jax.io.garment import GarmentFile
    from eslr_jax.io.mesh_sequence import MeshSequence
    from eslr_jax.io.run import Run
    from eslr_jax.types import BodyMotion, Scene, Trajectory

_FAR = (
    0.5  # [m] on average from where the garment is worn, from which a first frame is in other units or axes
)
_SAME_RATE = 0.01  # relative


@app.command
def score(
    file: tyro.conf.Positional[str],
    run: Path | None = None,
    garment: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    motion: str | None = None,
    body: str | None = None,
    vertices: Literal["1k", "4k", "10k", "50k", "200k"] | None = None,
    fabric: tuple[str, ...] = (),
    every: int = 4,
    json_: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> None:
    """Score anybody's simulation: optimality gap, energies, stretch, penetration, intersections.

    Describe the scene by a run of `eslr simulate`, or by garment, body and motion. The gap is measured in our
    energy. Each frame is compared with the optimum that follows from the trajectory's own previous state.

    Args:
        file: The garment in motion, in metres, Y up, at 30 frames a second, with the vertices of the garment in
            their order: an .npz with positions [frames, vertices, 3] and faces, a .glb whose shapes move it, or a
            folder of OBJ or PLY files. If a .glb has several meshes, they are the garments of an outfit, by name;
            FILE.glb#NAME picks one. A run of `eslr simulate` also works, and holds its own scene.
        run: Folder of a run: its garment, fabric, body, motion, ground and wind, and how it stepped time.
        garment: Name of a bundled garment, or a mesh file; tshirt if not given. Give it again for what is worn
            over it, as for `eslr simulate`.
        motion: Motion as for `eslr simulate`; cmu_016_32 if not given, from its first frame on.
        body: Body as for `eslr simulate`; anny if not given.
        vertices: Resolution of a bundled garment; 1k if not given.
        fabric: Fabric as for `eslr simulate`; cotton if not given.
        every: Measure gap and intersections in every n-th frame.
        json_: Print as JSON.
    """
    from eslr_jax.evaluation.report import environment
    from eslr_jax.evaluation.score import score_trajectory
    from eslr_jax.io.mesh_sequence import read_mesh_sequences
    from eslr_jax.io.run import is_run, read_run

    use_compile_cache()
    names = {"garment": garment, "motion": motion, "body": body, "vertices": vertices, "fabric": fabric}
    given = {name: value for name, value in names.items() if value}
    with waiting("reading"):
        is_own = is_run(file)
        if given and (is_own or run is not None):
            raise ConfigError(f"{run or file} tells its own scene; leave out --{', --'.join(given)}")
        if is_own and run is not None:
            raise ConfigError(f"{file} tells its own scene; leave out --run")
        if is_own:
            task = _own_task(read_run(file))
        else:
            sequences = read_mesh_sequences(file)
            task = _named_task(sequences, given) if run is None else _run_task(sequences, read_run(run))
    with waiting("scoring"):
        stored = task.stored
        result = score_trajectory(
            task.trajectory,
            task.scene,
            poses=task.poses,
            parts=(None, ()) if stored is None else (stored.face_parts, stored.part_names),
            outfit=None if stored is None else stored.outfit,
            every=every,
        )
    result = {"file": file, **task.label, **result, **environment()}
    if result["intersections_cloth"] is None:
        say('intersections are not counted: that needs ipctk: pip install "eslr-jax[score]"')
    if json_:
        print(json.dumps(result, indent=2))
    else:
        print_report({"error": None, "tolerance": None, **result}, _figures(result))


class _Task(NamedTuple):
    """A trajectory and what it is of."""

    trajectory: Trajectory | np.ndarray
    scene: Scene
    poses: BodyMotion | None
    stored: GarmentFile | None
    label: dict[str, Any]


def _own_task(run: Run) -> _Task:
    """Return a run as the trajectory of its own scene."""
    from eslr_jax.evaluation.run_scene import run_garment, run_poses, run_scene, run_trajectory

    scene = run_scene(run, *run_garment(run))
    return _Task(run_trajectory(run, scene), scene, run_poses(run, scene), run.garment, {"run": run.name})


def _run_task(sequences: list[MeshSequence], run: Run) -> _Task:
    """Return a trajectory in the scene of a run, cut to its length."""
    from eslr_jax.body.motion import first_poses
    from eslr_jax.io.garment import in_outfit_order
    from eslr_jax.scene.plan import first_frames

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
    import inspect

    from eslr_jax.assets import load_garment_file, prepare_stored
    from eslr_jax.assets.garments import check_resolution, warn_of_fit
    from eslr_jax.cli.simulate import simulate
    from eslr_jax.fabric import garment_material
    from eslr_jax.fit.outfit import garment_names, wear_together
    from eslr_jax.io.garment import in_outfit_order
    from eslr_jax.scene.plan import prepare_scene

    if len(sequences) > 1 and "garment" not in given:
        known = ", ".join(sequence.mesh for sequence in sequences)
        raise ConfigError(
            f"{sequences[0].name} is one of the meshes {known}; give --run, or --garment for every garment and "
            "the innermost first, or score one mesh of the file as FILE#NAME"
        )
    files = given.get("garment", (DEFAULT_GARMENT,))
    usual = inspect.signature(simulate).parameters
    values: dict[str, Any] = {field.name: usual[field.name].default for field in dataclasses.fields(Options)}
    values.update(given, garment=files, frames=len(sequences[0].positions))
    options = Options(**values)
    check_resolution(files, options.vertices)
    rig, poses, motion, _ = load_actor(options)
    garments = [load_garment_file(file, vertices=options.vertices, body=rig) for file in files]
    for file, worn in zip(files, garments, strict=True):
        warn_of_fit(file, worn)
    stored, label = wear_together(garments, files), "+".join(files)
    by_name = dict(zip(garment_names(files), garments, strict=True))
    positions = in_outfit_order(sequences, stored, by_name)
    cloth = prepare_stored(stored, name=label)
    scene = prepare_scene(cloth, poses, material=garment_material(options.fabric, cloth, stored))
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
