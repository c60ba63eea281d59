"""Hard cases of obstacles: a needle and a thin edge, two limbs that pinch, a slope."""

from __future__ import annotations

from typing import Any

import numpy as np

from eslr_jax.evaluation.colliders import Capsule, Collider, Plane, RoundedCone
from eslr_jax.evaluation.hard_cases.build import (
    capsule,
    corners_of,
    hanging_sheet,
    join_meshes,
    make_cloth,
    make_scene,
    plane,
    revolve,
    sheet,
)
from eslr_jax.evaluation.hard_cases.case import HardCase, Runs, Scenes
from eslr_jax.evaluation.hard_cases.measures import (
    MM,
    Measure,
    center,
    depths,
    largest_stretch,
    quantile_depth,
    rms_speed,
)
from eslr_jax.evaluation.hard_cases.simulators import Run
from eslr_jax.physics.problem import PhysicsParameters

_COLUMNS = 33  # vertices along a side of the half-metre sheet


# --- a needle and a thin edge ----------------------------------------------------------------------------

_TIP = 2e-3  # [m], radius of the needle's tip and of the edge
_HALF_ANGLE = np.radians(15.0)


def _needle() -> tuple[tuple[np.ndarray, np.ndarray], RoundedCone]:
    """Return a round-tipped cone that points up, its tip at height zero, as a mesh and exactly."""
    height = 0.25
    apex = -_TIP
    angle = np.linspace(_HALF_ANGLE, np.pi / 2, 6)
    tip = np.stack([_TIP * np.cos(angle), apex + _TIP * np.sin(angle)], axis=1)
    levels = -height * np.linspace(0, 1, 24)[::-1] ** 2
    levels = levels[levels < tip[0, 1]]
    flank = np.stack([tip[0, 0] + (tip[0, 1] - levels) * np.tan(_HALF_ANGLE), levels], axis=1)
    profile = np.concatenate([[[0.0, -height]], flank, tip])
    profile[-1, 0] = 0.0
    cone = RoundedCone(np.array([0.0, apex, 0.0]), np.array([0.0, -1.0, 0.0]), _HALF_ANGLE, _TIP)
    return revolve(profile, 24), cone


def _build_needle(options: dict[str, Any]) -> Scenes:
    garment = make_cloth(sheet(_COLUMNS, _COLUMNS, (0.5, 0.5)), options)
    start = np.asarray(garment.rest_positions, np.float64) + np.array([0.003, 0.05, 0.004])
    mesh, cone = _needle()
    edge = capsule(_TIP, 0.7, around=12, rings=60)
    bar = Capsule(np.array([-0.35, 0.0, 0.0]), np.array([0.35, 0.0, 0.0]), _TIP)
    return {
        "needle": make_scene(garment, start, 46, body=mesh, colliders=lambda frame: (cone,), is_sharp=True),
        "thin edge": make_scene(garment, start, 46, body=edge, colliders=lambda frame: (bar,), is_sharp=True),
    }


def _longest_edge(run: Run) -> float:
    """Return the largest ratio of an edge's length to its rest length, over all frames."""
    assert run.stress is not None
    garment = run.stress.scene.garment
    ends = np.asarray(garment.senders), np.asarray(garment.receivers)
    rest = np.asarray(garment.rest_positions, np.float64)
    length = np.linalg.norm(run.positions[:, ends[0]] - run.positions[:, ends[1]], axis=-1)
    return float(np.max(length / np.linalg.norm(rest[ends[0]] - rest[ends[1]], axis=-1)))


def _measure_needle(runs: Runs) -> list[Measure]:
    measures = []
    for label, run in runs.items():
        depth = depths(run, exact=True)
        measures += [
            Measure(f"{label}: depth over whole triangles, largest [mm]", float(max(depth.max(), 0.0)), 5.0),
            Measure(f"{label}: longest edge over its rest length", _longest_edge(run), 1.5),
        ]
    return measures


NEEDLE = HardCase(
    name="needle",
    reason="a tip of 2 mm finds the gap between vertices 16 mm apart",
    build=_build_needle,
    measure=_measure_needle,
    picture="needle",
    limit="the needle holds the sheet for 0.2 s; then the sheet closes around it like an umbrella, no face is "
    "left over the tip, and it comes through by 85 mm. Asking less of the direction to a face (cosine 0.3 in "
    "place of 0.8) tore the sheet instead: 106 mm, edges 5.5 times their length. The thin edge passes",
)


# --- pinched between two limbs ---------------------------------------------------------------------------


def _build_pinch(options: dict[str, Any]) -> Scenes:
    size, radius = 0.4, 0.05
    mesh = hanging_sheet(21, 21, (size, size))
    garment = make_cloth(mesh, options, is_pinned=corners_of(mesh[0], (-1, 1), (1, 1), axes=(0, 1)))
    start = mesh[0] + np.array([0.0, size / 2, 0.0])
    limb = capsule(radius, 0.6)
    body = join_meshes(limb, limb)
    frames = 76
    gap = np.interp(np.arange(frames), [0, 10, 40], [0.07, 0.07, -0.01])  # [m], then still
    centers = np.stack([np.zeros(frames), np.zeros(frames), radius + gap / 2], axis=1)
    count = len(limb[0])
    tracks = body[0] + np.concatenate(
        [np.repeat(sign * centers[:, None], count, axis=1) for sign in (-1, 1)], axis=1
    )

    def colliders(frame: int) -> tuple[Collider, ...]:
        end = np.array([0.3, 0.0, 0.0])
        middles = (-centers[frame], centers[frame])
        return tuple(Capsule(middle - end, middle + end, radius) for middle in middles)

    return {
        "pinch": make_scene(garment, start, frames, body=body, body_positions=tracks, colliders=colliders)
    }


def _measure_pinch(runs: Runs) -> list[Measure]:
    run = runs["pinch"]
    return [
        Measure("speed with the limbs still, rms [m/s]", rms_speed(run, len(run.positions) - 16), 0.1),
        Measure("stretch, largest", largest_stretch(run), 1.5),
        Measure("depth in the limbs, 99.9 % [mm]", quantile_depth(run), None),
    ]


PINCH = HardCase(
    name="pinch",
    reason="cloth between an arm and a chest that overlap has nowhere to go, and must not tremble",
    build=_build_pinch,
    measure=_measure_pinch,
    picture="pinch",
)


# --- a long rest on a slope ------------------------------------------------------------------------------


def _build_slope(options: dict[str, Any]) -> Scenes:
    tilt = np.radians(20.0)
    mesh = sheet(13, 13, (0.3, 0.3))
    garment = make_cloth(mesh, options)
    turn = np.array([[np.cos(tilt), -np.sin(tilt), 0], [np.sin(tilt), np.cos(tilt), 0], [0, 0, 1]])
    normal = turn @ np.array([0.0, 1.0, 0.0])
    start = mesh[0] @ turn.T + 3e-3 * normal
    return {
        "rest": make_scene(
            garment,
            start,
            1801,
            body=plane(0.6, 13, tilt),
            colliders=lambda frame: (Plane(np.zeros(3), normal),),
            parameters=PhysicsParameters(friction_coefficient=0.5),
        )
    }


def _measure_slope(runs: Runs) -> list[Measure]:
    run = runs["rest"]
    half = len(run.positions) // 2
    path = center(run)
    creep = np.linalg.norm(path[-1] - path[half]) / ((len(path) - 1 - half) * run.timestep)
    steps = np.linalg.norm(np.diff(run.positions[half:], axis=0), axis=-1)
    return [
        Measure("creep in the second half minute [mm/s]", MM * float(creep), 1.0),
        Measure(
            "motion in one frame, largest rms [mm]",
            MM * float(np.sqrt(np.mean(steps**2, axis=1)).max()),
            0.2,
        ),
        Measure("depth in the slope, 99.9 % [mm]", quantile_depth(run), None),
    ]


SLOPE = HardCase(
    name="slope",
    reason="a minute on a slope of 20 degrees with friction 0.5: cloth at rest must stay at rest",
    build=_build_slope,
    measure=_measure_slope,
    picture="rest",
)
