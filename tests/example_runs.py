"""Runs on disk that no simulation made."""

import json

import numpy as np

from eslr_jax.assets import load_garment_file
from eslr_jax.io.garment import write_garment_npz
from eslr_jax.io.trajectory import BodyTrack, TrajectoryFile, write_trajectory


def write_run(folder, body, name, scale=1.0):
    """Write a run of six frames: a tank top at rest, stretched, raised, at rest, shrunk, and lowered."""
    folder = folder / name
    folder.mkdir()
    garment = load_garment_file("tank")
    rest = garment.rest_positions + np.array([0, 0.82, 0])
    shrunk = rest * [0.9, 1, 0.9]  # into the body
    moved = [rest + np.array([0, 0.02, 0]), rest, shrunk, shrunk - np.array([0, 1e-3, 0])]
    frames = np.stack([rest, rest * [1.1 * scale, 1, 1], *moved])
    body_positions = np.repeat(
        np.asarray(body.rest_positions)[None] + np.array([[0, 0.82, 0]], np.float32), len(frames), 0
    )
    track = BodyTrack(
        positions=body_positions,
        faces=np.asarray(body.faces),
        rest_positions=np.asarray(body.rest_positions),
        contact_faces=np.asarray(body.faces)[np.asarray(body.is_obstacle)],
        contact_boundary=np.empty(0, np.int32),
    )
    velocities = np.gradient(frames, 1 / 30, axis=0)
    write_trajectory(
        folder / "trajectory.npz",
        TrajectoryFile(frames, velocities, garment.faces, timestep=1 / 30, body=track),
    )
    (folder / "report.json").write_text(json.dumps({"self_contact": True}))
    write_garment_npz(folder / "garment.npz", garment)
    return folder
