"""Hard cases of cloth on limbs: a body turned, a limb that moves fast, two limbs that pinch."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from eslr_jax import load_body, load_garment, pose_body, prepare_garment, prepare_scene
from eslr_jax.mesh.surface import prepare_surface
from eslr_jax.pose.motion import still_motion
from eslr_jax.pose.retarget import ARM_ABDUCTION
from eslr_jax.simulation.plan import first_frames
from eslr_jax.types import Garment, Scene
from hard_cases.build import (
    FRAME,
    capsule,
    corners_of,
    hanging_sheet,
    join_meshes,
    make_cloth,
    make_scene,
    tube,
)
from hard_cases.case import CaseScene, HardCase, Measure, Run, Runs, Scenes
from hard_cases.colliders import Capsule
from hard_cases.measures import MM, center, depths, largest_stretch, quantile_depth, rms, speeds


def _turned(scene: Scene, matrix: np.ndarray) -> Scene:
    """Return a scene with everything in the world turned or mirrored; the rest mesh is mirrored at most."""
    turn = jnp.asarray(matrix.T, jnp.float32)
    state, body, garment = scene.initial_state, scene.body, scene.garment
    body = body.replace(positions=body.positions @ turn)
    if np.linalg.det(matrix) < 0:  # normals must still point out
        garment = _mirrored(garment, turn)
        faces = np.asarray(body.surface.faces)[:, ::-1]
        body = body.replace(surface=prepare_surface(body.positions[0], faces))
    state = state.replace(position=state.position @ turn, velocity=state.velocity @ turn)
    return scene.replace(garment=garment, initial_state=state, body=body)


def _mirrored(garment: Garment, turn: Float[Array, "3 3"]) -> Garment:
    """Return the mirror image of a garment, vertex by vertex."""
    skin = {
        "skin_weights": np.asarray(garment.skin_weights),
        "skin_indices": np.asarray(garment.skin_indices),
    }
    mesh = np.asarray(garment.rest_positions @ turn), np.asarray(garment.faces)[:, ::-1].copy()
    return prepare_garment(*mesh, **skin, embedding_size=garment.geodesic_embedding.shape[1])


def _yaw(degrees: float) -> np.ndarray:
    """Return the rotation about y; exact for multiples of 90 degrees."""
    cosine, sine = np.round(np.cos(np.radians(degrees)), 15), np.round(np.sin(np.radians(degrees)), 15)
    return np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])


_TURNS = {"90": _yaw(90), "180": _yaw(180), "270": _yaw(270), "mirrored": np.diag([-1.0, 1, 1])}


def _build_turned(options: Mapping[str, Any]) -> Scenes:
    rig = load_body()
    garment = load_garment("tshirt", body=rig, **options)
    poses = pose_body(rig, still_motion(rig, 61, arm_angle=ARM_ABDUCTION))
    scene = prepare_scene(garment, poses, starts_at_rest=True)
    short = first_frames(scene, 31)
    turned = {label: CaseScene(_turned(short, matrix)) for label, matrix in _TURNS.items()}
    return {"0": CaseScene(scene), **turned}


def _measure_turned(runs: Runs) -> list[Measure]:
    straight = runs["0"].positions
    measures = []
    for label, matrix in _TURNS.items():
        back = runs[label].positions[-1] @ matrix  # the inverse of a turn is its transpose
        difference = np.linalg.norm(back - straight[len(runs[label].positions) - 1], axis=-1)
        measures.append(Measure(f"turned {label}: difference after 1 s, rms [mm]", MM * rms(difference), 5.0))
    path = center(runs["0"])
    drift = abs(path[-1, 0] - path[len(path) // 2, 0]) / (len(path) // 2 * FRAME)
    return [*measures, Measure("sideways drift in the second second [mm/s]", MM * drift, 5.0)]


TURNED = HardCase(
    "turned",
    "physics knows no north and no left: the same scene turned or mirrored must give the same cloth",
    *(_build_turned, _measure_turned, "0"),
)


_SPEEDS = (1, 2, 4, 8)  # [m/s]
_LIMB_RADIUS = 0.045  # [m]
_BEFORE, _AFTER = 8, 15  # frames at rest before and after the move
_MOVE = 8  # frames of the move
_AROUND, _ALONG = 22, 16  # vertices of the sleeve
_CURTAIN = 17  # vertices along the side of the curtain
_RUN_UP = 0.15  # [m] between the limb and the curtain
_HALF = np.array([0.3, 0.0, 0.0])  # [m], half the axis of every limb


def _limb_scene(garment: Garment, start: np.ndarray, path: np.ndarray, z: float) -> CaseScene:
    """Return a scene of cloth and a limb along x at height zero, which begins at z and moves along a path [m]."""
    limb = capsule(_LIMB_RADIUS, 0.6)
    track = np.stack([np.zeros(len(path)), np.zeros(len(path)), z + path], axis=1)
    scene = make_scene(garment, start, len(path), body=limb, body_positions=limb[0] + track[:, None])
    return CaseScene(
        scene, lambda frame: (Capsule(track[frame] - _HALF, track[frame] + _HALF, _LIMB_RADIUS),)
    )


def _build_fast_limb(options: Mapping[str, Any]) -> Scenes:
    upright, faces = tube(_AROUND, _ALONG, (0.06, 0.06), 0.3)
    along_x = upright[:, [1, 0, 2]] * [-1, 1, 1] - np.array([0.15, 0.0, 0.0])
    sleeve = make_cloth((along_x, faces), options)
    mesh = hanging_sheet(_CURTAIN, _CURTAIN, (0.4, 0.4))
    curtain = make_cloth(mesh, options, is_pinned=mesh[0][:, 1] > -1e-9)
    frames = np.arange(1 + _BEFORE + _MOVE + _AFTER)
    scenes: Scenes = {}
    for speed in _SPEEDS:
        path = speed * FRAME * np.clip(frames - _BEFORE, 0, _MOVE)
        scenes[f"sleeve, {speed} m/s"] = _limb_scene(sleeve, along_x - np.array([0, 0.01, 0]), path, 0.0)
        strike = np.minimum(path, _RUN_UP + 0.12)  # 12 cm beyond the curtain, which gives way
        start = mesh[0] + np.array([0.0, 0.2, 0.0])
        scenes[f"curtain, {speed} m/s"] = _limb_scene(curtain, start, strike, -_RUN_UP)
    return scenes


def _angles(run: Run, lines: np.ndarray) -> np.ndarray:
    """Return the angle of lines of vertices about the limb, in turns, shape [frames, lines, line_vertices]."""
    axis = np.array([run.colliders(frame)[0].start for frame in range(len(run.positions))])
    offset = run.positions[:, lines] - axis[:, None, None]
    return np.arctan2(offset[..., 2], offset[..., 1]) / (2 * np.pi)


def _windings(angles: np.ndarray) -> np.ndarray:
    """Return by how much lines turn about the axis, from their first vertex to their last, in turns."""
    unwrapped = np.unwrap(angles, period=1, axis=-1)
    return unwrapped[..., -1] - unwrapped[..., 0]


def _crossings(angles: np.ndarray) -> np.ndarray:
    """Return how often the axis went through lines, vertices moving straight from frame to frame.

    Along a line the angle grows by as much as its ends have turned since the start; each time that the axis goes
    through it, by a whole turn more or less. Cloth that swings over or under the limb is not gone through.
    """
    ends = np.unwrap(angles[..., [0, -1]], period=1, axis=0)
    turned = (ends - ends[0])[-1]
    winding = _windings(angles)
    return np.round(winding[-1] - winding[0] - (turned[:, 1] - turned[:, 0]))


def _measure_fast_limb(runs: Runs) -> list[Measure]:
    measures = []
    ring = np.arange(_AROUND * _ALONG).reshape(_AROUND, _ALONG).T
    closed = np.concatenate([ring, ring[:, :1]], axis=1)
    columns = np.arange(_CURTAIN**2).reshape(_CURTAIN, _CURTAIN)
    for label, run in runs.items():
        speed = float(label.split()[1])
        depth = depths(run)
        late = np.flatnonzero(depth.max(axis=1)[_BEFORE + _MOVE :] > 5.0)
        clear = float(late[-1] + 1) if len(late) else 0.0
        if label.startswith("sleeve"):
            is_lost = np.abs(_windings(_angles(run, closed)[-1])) < 0.5
        else:
            is_lost = _crossings(_angles(run, columns)) != 0
        depth_bar, clear_bar = 5.0 if speed <= 2 else None, 5.0 if speed <= 4 else None
        measures += [
            Measure(f"{label}: depth in the limb, 99.9 % [mm]", quantile_depth(depth), depth_bar),
            Measure(f"{label}: frames to clear after the stop", clear, clear_bar),
            Measure(f"{label}: cloth the limb went through [%]", 100 * float(np.mean(is_lost)), 0),
            Measure(f"{label}: stretch, largest", largest_stretch(run), None),
        ]
    return measures


FAST_LIMB = HardCase(
    "fast_limb",
    "an arm jerks its sleeve, or strikes a curtain, at up to 27 cm a frame",
    *(_build_fast_limb, _measure_fast_limb, "curtain, 8 m/s"),
)


def _build_pinch(options: Mapping[str, Any]) -> Scenes:
    size, radius = 0.4, 0.05
    mesh = hanging_sheet(21, 21, (size, size))
    garment = make_cloth(mesh, options, is_pinned=corners_of(mesh[0], (-1, 1), (1, 1), axes=(0, 1)))
    start = mesh[0] + np.array([0.0, size / 2, 0.0])
    limb = capsule(radius, 0.6)
    frames = 76
    gap = np.interp(np.arange(frames), [0, 10, 40], [0.07, 0.07, -0.01])  # [m], then still
    centers = np.stack([np.zeros(frames), np.zeros(frames), radius + gap / 2], axis=1)
    tracks = np.concatenate([limb[0] + sign * centers[:, None] for sign in (-1, 1)], axis=1)

    def colliders(frame: int) -> list[Capsule]:
        middles = (-centers[frame], centers[frame])
        return [Capsule(middle - _HALF, middle + _HALF, radius) for middle in middles]

    scene = make_scene(garment, start, frames, body=join_meshes(limb, limb), body_positions=tracks)
    return {"pinch": CaseScene(scene, colliders)}


def _measure_pinch(runs: Runs) -> list[Measure]:
    run = runs["pinch"]
    return [
        Measure("speed with the limbs still, rms [m/s]", rms(speeds(run)[-15:]), 0.1),
        Measure("stretch, largest", largest_stretch(run), 1.5),
        Measure("depth in the limbs, 99.9 % [mm]", quantile_depth(depths(run)), None),
    ]


PINCH = HardCase(
    "pinch",
    "cloth between an arm and a chest that overlap has nowhere to go, and must not tremble",
    *(_build_pinch, _measure_pinch, "pinch"),
)
