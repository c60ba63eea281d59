"""Hard cases of cloth alone: falling, hanging, pulled, twisted, badly started."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from eslr_jax.mesh.topology import face_cross_products
from eslr_jax.terms import Gravity
from eslr_jax.types import Garment
from hard_cases.build import FRAME, corners_of, hanging_sheet, make_cloth, make_scene, sheet, turn_about_x
from hard_cases.case import CaseScene, HardCase, Measure, Run, Runs, Scenes
from hard_cases.measures import (
    MM,
    center,
    count_crossings,
    energy_at_rest,
    largest_rise,
    largest_stretch,
    mechanical_energy,
    rms,
    settle,
    speeds,
    weight,
)

_SIDE = 21  # vertices along the side of the small square cloth
_SIZE = 0.5  # [m], its side


def _build_free_fall(options: Mapping[str, Any]) -> Scenes:
    garment = make_cloth(sheet(_SIDE, _SIDE, (_SIZE, _SIZE)), options)
    tilt = np.radians(30)
    turn = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    return {"fall": CaseScene(make_scene(garment, np.asarray(garment.rest_positions) @ turn.T, 31))}


def _measure_free_fall(runs: Runs) -> list[Measure]:
    run = runs["fall"]
    drop = _own_parabola(run)
    rest = run.positions + drop[:, None, None] * np.array([0.0, 1.0, 0.0])
    moved = np.linalg.norm(rest - rest[0], axis=-1)
    fallen = center(run)[0, 1] - center(run)[-1, 1]
    return [
        Measure("displacement beyond free fall, largest [mm]", MM * float(moved.max()), 20.0),
        Measure("fall of the centre against backward Euler [%]", 100 * abs(fallen / drop[-1] - 1), 1.0),
    ]


def _own_parabola(run: Run) -> np.ndarray:
    """Return how far the integrator of a run falls by every frame [m]; BDF2 begins with a step of Euler's."""
    gravity, count = float(run.scene.term(Gravity).acceleration), len(run.positions)
    steps = np.arange(count)
    if run.scene.initial_state.past is None:
        return gravity * FRAME**2 * steps * (steps + 1) / 2
    fallen, speed = np.zeros(count), gravity * FRAME * steps
    for k in range(1, count):
        before = fallen[0] if k == 1 else (4 * fallen[k - 1] - fallen[k - 2]) / 3
        fallen[k] = before + (1.0 if k == 1 else 2.0 / 3.0) * FRAME * speed[k]
    return fallen


FREE_FALL = HardCase(
    "free_fall",
    "nothing but gravity acts: whatever else moves is the simulator's own invention",
    *(_build_free_fall, _measure_free_fall, "fall"),
)


def _hung_cloth(options: Mapping[str, Any]) -> tuple[Garment, np.ndarray]:
    """Return a square cloth pinned at its upper corners, and its rest positions."""
    mesh = hanging_sheet(_SIDE, _SIDE, (_SIZE, _SIZE))
    is_pinned = corners_of(mesh[0], (-1, 1), (1, 1), axes=(0, 1))
    return make_cloth(mesh, options, is_pinned=is_pinned), mesh[0]


def _build_hang(options: Mapping[str, Any]) -> Scenes:
    garment, rest = _hung_cloth(options)
    frames = 151
    closing = np.clip(np.arange(frames) * FRAME / 0.5, 0, 1)  # in half a second, to 80 % of the width
    pins = np.broadcast_to(rest, (frames, *rest.shape)).copy()
    pins[..., 0] *= (1 - 0.2 * closing)[:, None]
    return {"hang": CaseScene(make_scene(garment, rest, frames, pin_targets=pins))}


def _sag(position: np.ndarray) -> float:
    """Return how far the middle of the upper edge hangs below its ends [m]."""
    upper = position[: _SIDE**2].reshape(_SIDE, _SIDE, 3)[:, -1]
    return float(upper[0, 1] - upper[_SIDE // 2, 1])


def _measure_hang(runs: Runs) -> list[Measure]:
    run = runs["hang"]
    energy, last = mechanical_energy(run), run.trajectory.positions[-1]
    rest = settle(run.scene, last, run.scene.pin_targets[-1])
    lowest = energy_at_rest(run.scene, rest)
    moving = np.sqrt(np.mean(speeds(run) ** 2, axis=1))
    after = np.flatnonzero(moving > 0.05)
    first_still = max(int(after[-1]) + 1 if len(after) else 0, 16)  # the pins stand from frame 15 on
    calm = energy[first_still:]
    rise = largest_rise(calm) if len(calm) else np.inf
    drop = float(energy.max() - lowest)
    sag = 100 * abs(_sag(np.asarray(last)) / _sag(np.asarray(rest)) - 1)
    return [
        Measure("sag against the equilibrium [%]", sag, 2.0),
        Measure("speed after 5 s, rms [m/s]", rms(speeds(run)[-3:]), 0.05),
        Measure(
            "energy above the equilibrium, of the drop [%]", 100 * float(energy[-1] - lowest) / drop, 2.0
        ),
        Measure("rise of energy once still, of the drop [%]", 100 * rise / drop, 1.0),
    ]


HANG = HardCase(
    "hang",
    "cloth that hangs must come to rest at its equilibrium, not short of it and not trembling",
    *(_build_hang, _measure_hang, "hang"),
)


def _build_bad_start(options: Mapping[str, Any]) -> Scenes:
    garment, rest = _hung_cloth(options)
    random = np.random.default_rng(0)
    edge = _SIZE / (_SIDE - 1)
    pinned = np.asarray(garment.is_pinned)
    scrambled = rest + edge * random.normal(size=rest.shape)
    flattened = rest * np.array([1.0, 0.0, 1.0])  # onto the line between the pins
    flipped = rest.copy()
    faces = np.asarray(garment.faces)
    for face in random.choice(len(faces), len(faces) // 20, replace=False):  # 5 %
        tip, *base = rest[faces[face]]
        along = (base[1] - base[0]) / np.linalg.norm(base[1] - base[0])
        foot = base[0] + ((tip - base[0]) @ along) * along
        flipped[faces[face][0]] = 2 * foot - tip  # the mirror image across the other edge
    starts = {"scrambled": scrambled, "flattened": flattened, "flipped": flipped}
    return {
        label: CaseScene(
            make_scene(garment, np.where(pinned[:, None], rest, start), 61, pin_targets=rest[None])
        )
        for label, start in starts.items()
    }


def _measure_bad_start(runs: Runs) -> list[Measure]:
    measures = []
    for label, run in runs.items():
        energy = mechanical_energy(run)
        settled = settle(run.scene, run.scene.garment.rest_positions, run.scene.pin_targets[-1])
        lowest = energy_at_rest(run.scene, settled)
        # Heights count from the pins, so the settled energy is that of the whole sag.
        above, drop = energy[-1] - lowest, energy[0] - lowest
        measures += [
            Measure(f"{label}: energy above the settled one after 2 s [%]", 100 * above / abs(lowest), 10.0),
            Measure(f"{label}: rise of energy, of the drop [%]", 100 * largest_rise(energy) / drop, 0.1),
            Measure(f"{label}: triangles inside out at the end [%]", 100 * _flipped_share(run), None),
        ]
    return measures


def _flipped_share(run: Run) -> float:
    """Return the share of faces that look against the mean of their neighbours."""
    normal = face_cross_products(run.positions[-1], run.faces)
    around = np.zeros((run.positions.shape[1], 3))
    for k in range(3):
        np.add.at(around, run.faces[:, k], normal)
    return float(np.mean(np.einsum("fi,fi->f", normal, around[run.faces].sum(axis=1)) < 0))


BAD_START = HardCase(
    "bad_start",
    "crumpled, flat or inside-out starts: forces are huge and must lead home without a burst",
    *(_build_bad_start, _measure_bad_start, "scrambled"),
    limit="by BDF2 the energy of the flattened start may rise, by 0.03 % of the drop in ten starts",
)


def _build_pull(options: Mapping[str, Any]) -> Scenes:
    mesh = sheet(_SIDE, _SIDE, (_SIZE, _SIZE))
    is_pinned = corners_of(mesh[0], (-1, -1), (-1, 1), (1, -1), (1, 1), axes=(0, 2))
    held = make_cloth(mesh, options, is_pinned=is_pinned)
    free = make_cloth(mesh, options)
    scenes: Scenes = {}
    for percent in (150, 200):
        stretched = mesh[0] * np.array([percent / 100, 1.0, percent / 100])
        corners = jnp.asarray(stretched, jnp.float32)
        pulled = settle(make_scene(held, stretched, 2), corners, corners)
        scenes[f"{percent} %"] = CaseScene(make_scene(free, np.asarray(pulled), 31))
    return scenes


def _measure_pull(runs: Runs) -> list[Measure]:
    measures = []
    for label, run in runs.items():
        energy = mechanical_energy(run)
        gain = energy.max() - energy[0]
        stored = energy[0] - center(run)[0, 1] * weight(run.scene)
        measures += [
            Measure(f"{label}: stretch after 1 s", largest_stretch(run, 30), 1.1),
            Measure(f"{label}: energy gained, of the stored [%]", 100 * gain / stored, 0.1),
        ]
    return measures


PULL = HardCase(
    "pull",
    "a cloth pulled to twice its size and let go: all the stored energy is set free at once",
    *(_build_pull, _measure_pull, "200 %"),
)


def _build_twist(options: Mapping[str, Any]) -> Scenes:
    width, length, rows, columns = 0.25, 1.0, 41, 11
    mesh = sheet(rows, columns, (length, width))
    x = mesh[0][:, 0]
    garment = make_cloth(mesh, options, is_pinned=np.abs(x) > 0.5 * length - 1e-6)
    frames = 301
    pins = turn_about_x(mesh[0], np.pi / 3 * FRAME * np.arange(frames)[:, None] * (x > 0))
    return {"twist": CaseScene(make_scene(garment, mesh[0], frames, pin_targets=pins, self_contact=True))}


def _measure_twist(runs: Runs) -> list[Measure]:
    run = runs["twist"]
    size = np.ptp(run.positions, axis=1).max()
    frames = [len(run.positions) * k // 4 - 1 for k in range(1, 5)]
    return [
        Measure("speed of a vertex, largest [m/s]", float(speeds(run)[1:].max()), 1.5),
        Measure("side of the bounding box, largest [m]", float(size), 2.0),
        *(
            Measure(f"intersecting pairs after {(frame + 1) * FRAME:.1f} s", count, None)
            for frame, count in zip(frames, count_crossings(run, frames), strict=True)
        ),
    ]


TWIST = HardCase(
    "twist",
    "a strip wrung for ten seconds: contact everywhere under rising tension",
    *(_build_twist, _measure_twist, "twist"),
)
