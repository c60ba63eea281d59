"""Hard cases of still obstacles: a needle and a thin edge, and a slope."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from hard_cases.build import Mesh, capsule, make_cloth, make_scene, plane, revolve, sheet
from hard_cases.case import CaseScene, HardCase, Measure, Run, Runs, Scenes
from hard_cases.colliders import Capsule, Plane, RoundedCone
from hard_cases.measures import MM, center, depths, quantile_depth, triangle_depths

_COLUMNS = 33  # vertices along a side of the half-metre sheet
_TIP = 2e-3  # [m], radius of the needle's tip and of the edge
_HALF_ANGLE = np.radians(15.0)


def needle() -> tuple[Mesh, RoundedCone]:
    """Return a cone with a round tip that points up to height zero, as a mesh and in closed form."""
    height = 0.25
    apex = -_TIP
    angle = np.linspace(_HALF_ANGLE, np.pi / 2, 6)
    tip = np.stack([_TIP * np.cos(angle), apex + _TIP * np.sin(angle)], axis=1)
    levels = -height * np.linspace(0, 1, 24)[::-1] ** 2
    levels = levels[levels < tip[0, 1]]
    flank = np.stack([tip[0, 0] + (tip[0, 1] - levels) * np.tan(_HALF_ANGLE), levels], axis=1)
    profile = np.concatenate([[[0.0, -height]], flank, tip])
    profile[-1, 0] = 0.0
    down = np.array([0.0, -1.0, 0.0])
    cone = RoundedCone(np.array([0.0, apex, 0.0]), down, _HALF_ANGLE, _TIP, height + apex)
    return revolve(profile, 24), cone


def _build_needle(options: Mapping[str, Any]) -> Scenes:
    garment = make_cloth(sheet(_COLUMNS, _COLUMNS, (0.5, 0.5)), options)
    start = np.asarray(garment.rest_positions, np.float64) + np.array([0.003, 0.05, 0.004])
    mesh, cone = needle()
    edge = capsule(_TIP, 0.7, around=12, rings=60)
    bar = Capsule(np.array([-0.35, 0.0, 0.0]), np.array([0.35, 0.0, 0.0]), _TIP)
    return {
        "needle": CaseScene(make_scene(garment, start, 46, body=mesh), lambda frame: (cone,)),
        "thin edge": CaseScene(make_scene(garment, start, 46, body=edge), lambda frame: (bar,)),
    }


def _longest_edge(run: Run) -> float:
    """Return the largest ratio of an edge's length to its rest length, over all frames."""
    garment = run.scene.garment
    ends = np.asarray(garment.senders), np.asarray(garment.receivers)
    rest = np.asarray(garment.rest_positions, np.float64)
    length = np.linalg.norm(run.positions[:, ends[0]] - run.positions[:, ends[1]], axis=-1)
    return float(np.max(length / np.linalg.norm(rest[ends[0]] - rest[ends[1]], axis=-1)))


def _measure_needle(runs: Runs) -> list[Measure]:
    measures = []
    for label, run in runs.items():
        depth = max(float(triangle_depths(run).max()), 0.0)
        measures += [
            Measure(f"{label}: depth over whole triangles, largest [mm]", depth, 5.0),
            Measure(f"{label}: longest edge over its rest length", _longest_edge(run), 1.5),
        ]
    return measures


NEEDLE = HardCase(
    "needle",
    "a tip of 2 mm finds the gap between vertices 16 mm apart",
    *(_build_needle, _measure_needle, "needle"),
)


def _build_slope(options: Mapping[str, Any]) -> Scenes:
    tilt = np.radians(20.0)
    mesh = sheet(13, 13, (0.3, 0.3))
    garment = make_cloth(mesh, options)
    turn = np.array([[np.cos(tilt), -np.sin(tilt), 0], [np.sin(tilt), np.cos(tilt), 0], [0, 0, 1]])
    normal = turn @ np.array([0.0, 1.0, 0.0])
    start = mesh[0] @ turn.T + 3e-3 * normal
    scene = make_scene(garment, start, 1801, body=plane(0.6, 13, tilt))
    return {"rest": CaseScene(scene, lambda frame: (Plane(np.zeros(3), normal),))}


def _measure_slope(runs: Runs) -> list[Measure]:
    run = runs["rest"]
    half = len(run.positions) // 2
    path = center(run)
    creep = np.linalg.norm(path[-1] - path[half]) / ((len(path) - 1 - half) * run.timestep)
    steps = np.linalg.norm(np.diff(run.positions[half:], axis=0), axis=-1)
    motion = float(np.sqrt(np.mean(steps**2, axis=1)).max())
    return [
        Measure("creep in the second half minute [mm/s]", MM * float(creep), 1.0),
        Measure("motion in one frame, largest rms [mm]", MM * motion, 0.2),
        Measure("depth in the slope, 99.9 % [mm]", quantile_depth(depths(run)), None),
    ]


SLOPE = HardCase(
    "slope",
    "a minute on a slope of 20 degrees with friction 0.5: cloth at rest must stay at rest",
    *(_build_slope, _measure_slope, "rest"),
)
