"""The folder that `eslr simulate` writes: trajectory, animation, garment and report."""

from __future__ import annotations

import dataclasses
import json
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from eslr_jax.errors import AssetError
from eslr_jax.io.animated import Skin
from eslr_jax.io.atomic import atomic_write, ensure_output_dir, move_files
from eslr_jax.io.export import export_trajectory
from eslr_jax.io.garment import GarmentFile, read_garment_npz, write_garment_npz
from eslr_jax.io.npz import read_arrays
from eslr_jax.io.trajectory import BodyTrack, TrajectoryFile, read_trajectory, write_trajectory
from eslr_jax.types import Body, BodyMotion, Scene

_LABELS = ("garment", "motion", "motion_start_s")  # of the report, which the trajectory has as well


@dataclasses.dataclass(frozen=True)
class Run:
    """One simulation on disk."""

    name: str
    trajectory: TrajectoryFile
    garment: GarmentFile | None  # None without garment.npz: then frame 0 is the rest shape
    report: dict[str, Any]  # of report.json; empty without it


class ClothTrack(NamedTuple):
    """The cloth, frame by frame."""

    positions: Float[Array, "frames vertices 3"]  # [m]
    velocities: Float[Array, "frames vertices 3"]  # [m/s]
    friction_loads: Float[Array, "frames vertices"]  # [N]
    residuals: Float[Array, " frames"] | None = None  # force norm over weight that each frame ended with


def write_run(
    folder: Path,
    track: ClothTrack,
    scene: Scene,
    actor: tuple[Body, BodyMotion, GarmentFile],
    *,
    report: dict[str, Any],
) -> None:
    """Write the folder of a run; files are moved there when all are written, so that those of two runs don't mix.

    Args:
        folder: It is made if it is not there.
        track: What was simulated.
        scene: Of `prepare_scene`; its body's faces, its ground and its fabric are kept.
        actor: The body at rest, the body in motion over the same frames, and the garment's file.
        report: What `report.json` says; values of JSON.

    Raises:
        AssetError: A file can't be written.
    """
    rig, poses, stored = actor
    folder = ensure_output_dir(folder)
    file = TrajectoryFile(
        positions=np.asarray(track.positions),
        velocities=np.asarray(track.velocities),
        faces=np.asarray(scene.garment.faces),
        metadata={name: report[name] for name in _LABELS if name in report},
        timestep=float(poses.timestep),
        body=_body_track(scene, rig, poses),
        friction_loads=np.asarray(track.friction_loads),
        residuals=None if track.residuals is None else np.asarray(track.residuals),
        ground=None if scene.ground is None else float(scene.ground),
        material=jax.tree.map(_stored_number, scene.material),
    )
    with tempfile.TemporaryDirectory(prefix=".new-", dir=folder) as name:
        new = Path(name)
        with atomic_write(new / "report.json") as temporary:
            temporary.write_text(json.dumps(report, indent=2))
        write_garment_npz(new / "garment.npz", stored)
        write_trajectory(new / "trajectory.npz", file)
        export_trajectory(file, new / "animation.glb", garment=stored)
        move_files(new, folder)


def scene_record(scene: Scene) -> dict[str, Any]:
    """Return the part of a report that describes its scene, from which `evaluation.run_scene` rebuilds it."""
    return {
        "self_contact": scene.self_contact is not None and ("all" if scene.pieces is None else "pieces"),
        "self_contact_pairs": None if scene.self_contact is None else scene.self_contact.pairs,
        "integrator": "euler" if scene.initial_state.past is None else "bdf2",
        "substeps": scene.substeps,
        "skin_contacts": scene.body is not None and scene.body.has_skin,
        "tips": scene.body is not None and scene.body.has_tips,
        "constants": {name: float(value) for name, value in vars(scene.constants).items()},
        "terms": [term.name for term in scene.terms],
        "ground_m": None if scene.ground is None else float(scene.ground),
    }


def _stored_number(leaf: Any) -> np.ndarray:
    """Return an array of indices as it is, and one of numbers in float32."""
    array = np.asarray(leaf)
    return array if array.dtype.kind in "iu" else array.astype(np.float32)


def _body_track(scene: Scene, rig: Body, poses: BodyMotion) -> BodyTrack:
    """Return a body in motion with its joints, and the faces that its scene searched."""
    contact_faces, contact_boundary = np.empty((0, 3), np.int32), np.empty(0, np.int32)
    if scene.body is not None:
        surface = scene.body.surface
        vertex_ids = np.asarray(surface.vertex_ids)
        contact_faces = vertex_ids[np.asarray(surface.faces)]
        contact_boundary = vertex_ids[np.asarray(surface.is_boundary)]
    skin = Skin(
        skin_weights=np.asarray(rig.skin_weights),
        skin_indices=np.asarray(rig.skin_indices),
        joint_transforms=np.asarray(poses.joint_transforms),
        joint_rest_positions=np.asarray(rig.joint_rest_positions),
        parents=rig.parents,
        joint_names=rig.joint_names,
    )
    return BodyTrack(
        positions=np.asarray(poses.positions),
        faces=np.asarray(poses.faces),
        rest_positions=np.asarray(poses.rest_positions),
        contact_faces=contact_faces,
        contact_boundary=contact_boundary,
        skin=skin,
    )


def is_run(path: str | Path) -> bool:
    """Tell whether a path is the folder of a run or a trajectory file, and not a mesh in motion."""
    path = Path(path)
    if path.is_dir():
        return (path / "trajectory.npz").is_file()
    return path.suffix.lower() == ".npz" and "format" in read_arrays(
        path, content="trajectory", names=("format",)
    )


def load_trajectory(path: str | Path) -> TrajectoryFile:
    """Load the trajectory of a run: garment and body in motion, and the fabric.

    Args:
        path: Folder that `eslr simulate` wrote, or its `trajectory.npz`. Its `garment.npz` is for `load_garment`.

    Returns:
        The trajectory, with NumPy arrays in metres and seconds; the floor of the bundled motions is at y = 0.

    Raises:
        AssetError: There is no trajectory, a file is damaged, or the garment is not the trajectory's.
    """
    return read_run(path).trajectory


def read_run(path: str | Path) -> Run:
    """Read the folder of a run, or a trajectory and what lies beside it.

    Args:
        path: Path of the folder, or of a trajectory file.

    Returns:
        The run.

    Raises:
        AssetError: There is no trajectory, a file is damaged, or the garment is not the trajectory's.
    """
    path = Path(path)
    folder = path if path.is_dir() else path.parent
    file = path / "trajectory.npz" if path.is_dir() else path
    if not file.is_file():
        raise AssetError(f"{path} is no run: {file} doesn't exist; give a folder that `eslr simulate` wrote")
    trajectory = read_trajectory(file)
    garment = None
    if (folder / "garment.npz").is_file():
        garment = read_garment_npz(folder / "garment.npz")
        if len(garment.rest_positions) != trajectory.positions.shape[1]:
            raise AssetError(
                f"{folder}: garment.npz has {len(garment.rest_positions)} vertices and the trajectory "
                f"{trajectory.positions.shape[1]}; simulate it again"
            )
    report: dict[str, Any] = {}
    if (folder / "report.json").is_file():
        try:
            report = json.loads((folder / "report.json").read_text())
            if not isinstance(report, dict):
                raise ValueError("no table")
        except (OSError, ValueError) as error:
            raise AssetError(f"{folder / 'report.json'} is damaged; simulate it again") from error
    return Run(folder.resolve().name if path.is_dir() else path.stem, trajectory, garment, report)
