"""Runs on disk that no simulation made."""

import numpy as np

from eslr_jax import pose_body, prepare_scene, save_scene
from eslr_jax.pipeline.assets import load_garment_file, prepare_stored
from eslr_jax.pipeline.formats.animated import AnimatedMesh
from eslr_jax.pipeline.formats.garment import write_garment_npz
from eslr_jax.pipeline.formats.trajectory import TrajectoryFile, write_trajectory
from eslr_jax.pose.motion import still_motion
from eslr_jax.terms import FAST


def write_run(folder, body, name, scale=1.0):
    """Write a run of six frames: a tank top at rest, stretched, raised, at rest, shrunk, and lowered."""
    folder = folder / name
    folder.mkdir()
    garment = load_garment_file("tank")
    poses = pose_body(body, still_motion(body, 6))
    moved = np.asarray(poses.positions[0]) - np.asarray(body.rest_positions)
    rest = garment.rest_positions + moved.mean(axis=0)
    shrunk = rest * [0.9, 1, 0.9]  # into the body
    others = [rest + np.array([0, 0.02, 0]), rest, shrunk, shrunk - np.array([0, 1e-3, 0])]
    frames = np.stack([rest, rest * [1.1 * scale, 1, 1], *others])
    moving, faces, rest = map(np.array, (poses.positions, body.faces, body.rest_positions))
    track = AnimatedMesh("body", moving, faces, rest_positions=rest)
    velocities = np.gradient(frames, 1 / 30, axis=0)
    write_trajectory(
        folder / "trajectory.npz",
        TrajectoryFile(frames, velocities, garment.faces, timestep=1 / 30, body=track),
    )
    scene = prepare_scene(prepare_stored(garment), poses, terms=FAST)
    start = dict(zip(("position", "velocity"), np.float32([frames[0], velocities[0]]), strict=True))
    save_scene(folder / "scene.npz", scene.replace(initial_state=scene.initial_state.replace(**start)))
    (folder / "report.json").write_text("{}")
    write_garment_npz(folder / "garment.npz", garment)
    return folder
