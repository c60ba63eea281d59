"""The folder that `eslr simulate` writes: trajectory, scene, animation, garment and report."""

from __future__ import annotations

import dataclasses
import functools
import json
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from eslr_jax.errors import AssetError
from eslr_jax.files.atomic import atomic_write, ensure_output_dir, move_files
from eslr_jax.files.npz import read_arrays
from eslr_jax.pipeline.formats.animated import AnimatedMesh, Skin
from eslr_jax.pipeline.formats.export import export_trajectory
from eslr_jax.pipeline.formats.garment import GarmentFile, read_garment_npz, write_garment_npz
from eslr_jax.pipeline.formats.palette import SKIN_COLOR
from eslr_jax.pipeline.formats.trajectory import TrajectoryFile, read_trajectory, write_trajectory
from eslr_jax.pipeline.report.score import foreign_trajectory
from eslr_jax.simulation.archive import read_tree, save_scene
from eslr_jax.types import Body, BodyMotion, Scene, Trajectory

FILES = ("trajectory.npz", "scene.npz", "garment.npz", "report.json")
_LABELS = ("garment", "motion", "motion_start_s")  # of the report, which the trajectory has as well


@dataclasses.dataclass(frozen=True)
class Run:
    """One simulation on disk."""

    name: str
    folder: Path
    trajectory: TrajectoryFile
    garment: GarmentFile | None  # None without garment.npz
    report: dict[str, Any]  # of report.json, for people; empty without it

    @functools.cached_property
    def scene(self) -> Scene:
        """What was simulated, over the frames of the trajectory; read when it is first asked for.

        Raises:
            AssetError: There is no `scene.npz`, it is damaged, or it is not the trajectory's; or it has a term
                whose module can't be imported.
        """
        file = self.folder / "scene.npz"
        if not file.is_file():
            raise AssetError(
                f"{self.name} has no scene.npz, which tells what was simulated: another version wrote it, or a "
                "hand held the cloth; simulate it again"
            )
        scene = read_tree(file, Scene, content="scene", remedy="simulate it again")
        if (scene.num_frames, len(scene.garment.rest_positions)) != self.trajectory.positions.shape[:2]:
            raise AssetError(
                f"{file} is the scene of another trajectory than lies beside it; simulate it again"
            )
        return scene


class ClothTrack(NamedTuple):
    """The cloth, frame by frame: what a run needs of a `Trajectory`."""

    positions: Float[Array, "frames vertices 3"]  # [m]
    velocities: Float[Array, "frames vertices 3"]  # [m/s]
    friction_loads: Float[Array, "frames vertices"]  # [N]
    residuals: Float[Array, " frames"] | None = None  # force norm over weight that each frame ended with


def write_run(
    folder: Path,
    track: ClothTrack | Trajectory,
    scene: Scene | None,
    actor: tuple[Body, BodyMotion, GarmentFile],
    *,
    report: dict[str, Any],
) -> None:
    """Write the folder of a run: all of its files or, if one can't be written, none, and those before stay.

    Args:
        folder: It is made if it is not there.
        track: What was simulated.
        scene: What was simulated, over the same frames; None where no scene tells it, as where a hand pulled:
            then nobody can score the run.
        actor: The body at rest, the body in motion over the same frames, and the garment's file.
        report: What `report.json` says; values of JSON.

    Raises:
        AssetError: A file can't be written.
        ConfigError: The scene holds a function that no file can name; see `save_scene`.
    """
    rig, poses, stored = actor
    folder = ensure_output_dir(folder)
    arrays = (rig.skin_weights, rig.skin_indices, poses.joint_transforms, rig.joint_rest_positions)
    skin = Skin(*map(np.asarray, arrays), parents=rig.parents, joint_names=rig.joint_names)
    moving, faces, rest = map(np.asarray, (poses.positions, poses.faces, poses.rest_positions))
    body = AnimatedMesh("body", moving, faces, SKIN_COLOR, rest_positions=rest, skin=skin)
    file = TrajectoryFile(
        positions=np.asarray(track.positions),
        velocities=np.asarray(track.velocities),
        faces=stored.faces,
        metadata={name: report[name] for name in _LABELS if name in report},
        timestep=float(poses.timestep),
        body=body,
        friction_loads=np.asarray(track.friction_loads),
        residuals=None if track.residuals is None else np.asarray(track.residuals),
    )
    with tempfile.TemporaryDirectory(prefix=".new-", dir=folder) as name:
        new = Path(name)
        with atomic_write(new / "report.json") as temporary:
            temporary.write_text(json.dumps(report, indent=2))
        write_garment_npz(new / "garment.npz", stored)
        write_trajectory(new / "trajectory.npz", file)
        export_trajectory(file, new / "animation.glb", garment=stored)
        if scene is not None:
            save_scene(new / "scene.npz", scene)
        move_files(new, folder, without=() if scene is not None else ("scene.npz",))  # of an earlier run


def is_run(path: str | Path) -> bool:
    """Tell whether a path is the folder of a run or a trajectory file, and not a mesh in motion."""
    path = Path(path)
    if path.is_dir():
        return (path / "trajectory.npz").is_file()
    return path.suffix.lower() == ".npz" and "format" in read_arrays(
        path, content="trajectory", names=("format",)
    )


def load_trajectory(path: str | Path) -> TrajectoryFile:
    """Load the trajectory of a run: garment and body in motion.

    Args:
        path: Folder that `eslr simulate` wrote, or its `trajectory.npz`. The `garment.npz`
            beside it is for `load_garment`, and `scene.npz` for `load_scene`.

    Returns:
        The trajectory, with NumPy arrays in metres and seconds; the floor of the bundled motions is at y = 0.

    Raises:
        AssetError: There is no trajectory, a file is damaged, or the garment is not the trajectory's.
    """
    return read_run(path).trajectory


def read_run(path: str | Path) -> Run:
    """Read the folder of a run, or a trajectory file and what lies beside it.

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
    return Run(folder.resolve().name if path.is_dir() else path.stem, folder, trajectory, garment, report)


def run_trajectory(run: Run) -> Trajectory:
    """Return the trajectory of a run as its scene's, without energies, which no file holds."""
    track = run.trajectory
    # Friction loads and residuals are None in somebody else's run.
    own = foreign_trajectory(
        track.positions, run.scene, velocities=track.velocities, friction_loads=track.friction_loads
    )
    return own if track.residuals is None else own.replace(residuals=jnp.asarray(track.residuals))


def run_poses(run: Run) -> BodyMotion | None:
    """Return the body of a run in motion, all faces obstacles; None where the file lacks it or its joints."""
    track, body = run.trajectory.body, run.scene.body
    if track is None or track.skin is None or body is None:
        return None
    return BodyMotion(
        positions=jnp.asarray(track.positions),
        joint_transforms=jnp.asarray(track.skin.joint_transforms),
        faces=jnp.asarray(track.faces),
        is_obstacle=jnp.ones(len(track.faces), bool),
        timestep=run.scene.timestep,
        rest_positions=jnp.asarray(track.rest_positions),
        surface=body.surface,
    )
