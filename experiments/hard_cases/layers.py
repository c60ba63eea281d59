"""Hard cases of several layers of cloth, which must not pass through each other."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from hard_cases.build import (
    FRAME,
    Mesh,
    capsule,
    icosphere,
    join_meshes,
    make_cloth,
    make_scene,
    plane,
    sheet,
    tube,
    turn_about_x,
)
from hard_cases.case import CaseScene, Colliders, HardCase, Measure, Runs, Scenes
from hard_cases.colliders import Capsule, Plane, Sphere
from hard_cases.measures import count_crossings, depths, largest_stretch, quantile_depth

_FRAMES = 61


def _two_sheets(options: Mapping[str, Any]) -> CaseScene:
    """Two sheets, one over the other, fall on a ball."""
    lower = sheet(25, 25, (0.6, 0.6))
    upper = lower[0] + np.array([0.003, 0.01, 0.004]), lower[1]
    mesh = join_meshes(lower, upper)
    garment = make_cloth(mesh, options, allow_components=True)
    start = mesh[0] + np.array([0.0, 0.17, 0.0])
    scene = make_scene(garment, start, _FRAMES, body=icosphere(4, 0.15), self_contact=True)
    return CaseScene(scene, lambda frame: (Sphere(np.zeros(3), 0.15),))


def _folded(options: Mapping[str, Any]) -> CaseScene:
    """A sheet folded over itself with a round crease lies down on the ground."""
    length, width, gap = 0.5, 0.25, 0.024
    mesh = sheet(43, 22, (length, width))
    garment = make_cloth(mesh, options)
    radius = gap / 2
    straight = (length - np.pi * radius) / 2
    s = mesh[0][:, 0] + length / 2
    turn = np.clip((s - straight) / radius, 0, np.pi)
    x = np.minimum(s, straight) + radius * np.sin(turn) - np.maximum(s - straight - np.pi * radius, 0)
    y = radius * (1 - np.cos(turn))
    start = np.stack([x - straight / 2, y + 0.02, mesh[0][:, 2]], axis=1)
    scene = make_scene(garment, start, _FRAMES, body=plane(1.2, 25, 0.0), self_contact=True)
    return CaseScene(scene, lambda frame: (Plane(np.zeros(3), np.array([0.0, 1.0, 0.0])),))


_HIP = 0.09  # [m] from the middle to each leg's axis
_LEG_RADIUS = 0.07  # [m]
_LEG_LENGTH = 0.55  # [m]


def _legs(frames: int) -> tuple[Mesh, np.ndarray, Colliders]:
    """Return two legs that swing against each other about the hip: mesh, track and colliders."""
    along_x, faces = capsule(_LEG_RADIUS, _LEG_LENGTH, around=24, rings=16)
    leg = along_x[:, [1, 0, 2]] * [1, 1, -1] - np.array([0, _LEG_LENGTH / 2, 0])
    time = np.arange(frames)[:, None] * FRAME
    swing = np.radians(20.0) * np.sin(2 * np.pi * 0.75 * np.maximum(time - 0.3, 0.0))
    hips = {sign: np.array([sign * _HIP, 0.0, 0.0]) for sign in (-1, 1)}
    foot = np.array([[0.0, -_LEG_LENGTH, 0.0]])
    track = [hip + turn_about_x(leg, sign * swing) for sign, hip in hips.items()]
    feet = {sign: (hip + turn_about_x(foot, sign * swing))[:, 0] for sign, hip in hips.items()}

    def colliders(frame: int) -> list[Capsule]:
        return [Capsule(hip, feet[sign][frame], _LEG_RADIUS) for sign, hip in hips.items()]

    return join_meshes((leg, faces), (leg, faces)), np.concatenate(track, axis=1), colliders


def _skirt_over_trousers(options: Mapping[str, Any]) -> CaseScene:
    """A skirt over two trouser legs, all held at the waist, over legs that walk."""
    leg = tube(20, 16, (_LEG_RADIUS + 0.012, _LEG_RADIUS + 0.016), 0.45)
    left, right = ((leg[0] + np.array([sign * _HIP, 0.0, 0.0]), leg[1]) for sign in (-1, 1))
    skirt = tube(40, 14, (1.0, 1.35), 0.34)
    oval = np.array([0.215, 1.0, 0.135])  # wide enough for both legs
    skirt = skirt[0] * oval, skirt[1]
    mesh = join_meshes(left, right, skirt)
    is_waist = mesh[0][:, 1] > -1e-9
    garment = make_cloth(mesh, options, is_pinned=is_waist, allow_components=True)
    body, track, colliders = _legs(_FRAMES)
    scene = make_scene(garment, mesh[0], _FRAMES, body=body, body_positions=track, self_contact=True)
    return CaseScene(scene, colliders)


def _build_layers(options: Mapping[str, Any]) -> Scenes:
    return {
        "two sheets": _two_sheets(options),
        "folded": _folded(options),
        "skirt over trousers": _skirt_over_trousers(options),
    }


def _measure_layers(runs: Runs) -> list[Measure]:
    measures = []
    for label, run in runs.items():
        last = len(run.positions) - 1
        counts = count_crossings(run, [0, last // 3, 2 * last // 3, last])
        measures += [
            Measure(f"{label}: intersecting pairs after 2 s, beyond frame 0", counts[-1] - counts[0], 0),
            Measure(f"{label}: intersecting pairs on the way, largest", max(counts), None),
            Measure(f"{label}: depth in the body, 99.9 % [mm]", quantile_depth(depths(run)), None),
            Measure(f"{label}: stretch, largest", largest_stretch(run), None),
        ]
    return measures


LAYERS = HardCase(
    "layers",
    "layers that lie on each other must not pass through each other",
    *(_build_layers, _measure_layers, "skirt over trousers"),
    limit="layers have to be near each other at the start of a frame: with 2 cm in place of 4 the walls of a "
    "pleat cross, 17 pairs of triangles after 2 s. Few iterations, 20 behind a network, can leave two crumpling "
    "sheets crossed",
)
