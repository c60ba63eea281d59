"""The drape test of Cusick: how much of a disc's shadow is left when its rim hangs over a round table.

Source: Cusick 1968, The Measurement of Fabric Drape, Journal of the Textile Institute 59; ISO 9073-9: a disc
of 30 cm over a table of 18 cm.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from hard_cases.build import make_cloth, make_scene

from eslr_jax.config import SimConfig
from eslr_jax.mesh.plate import warp_directions
from eslr_jax.pipeline.fabrics import describe_fabric, on_threads
from eslr_jax.simulation.rollout import rollout_scene
from known_answers.sheets import irregular, triangulate

DISC, TABLE = 0.15, 0.09  # radii [m]
_PIXEL = 1e-3  # [m], of the shadow
_ITERATIONS = 400  # of a frame; with 60 the discs still crept by 3 to 8 mm/s after eight seconds
_SETTLING = 1 / 15  # [s], frames of implicit Euler, which takes the swing out


class Drape(NamedTuple):
    """A disc that hangs over its table."""

    fabric: str
    coefficient: float  # share of the rim's area that the shadow still covers
    folds: int
    speed: float  # of the last frame, rms [mm/s]
    outline: np.ndarray  # height field's shadow, for pictures


def disc(spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a flat disc of irregular triangles, facing up [m]."""
    points, _ = irregular(2.4 * DISC, 2.4 * DISC, spacing)
    flat = points[:, [0, 2]] - 1.2 * DISC
    flat = flat[np.linalg.norm(flat, axis=1) < DISC - 0.55 * spacing]
    angle = np.linspace(0, 2 * np.pi, round(2 * np.pi * DISC / spacing), endpoint=False)
    flat = np.concatenate([flat, DISC * np.stack([np.cos(angle), np.sin(angle)], axis=1)])
    return triangulate(flat, 1e-2 * spacing**2)


@partial(jax.jit, static_argnums=1)
def _settle(scene: Any, config: SimConfig) -> tuple[jax.Array, jax.Array]:
    """Return where the cloth comes to rest, and how fast it still is."""
    trajectory = rollout_scene(None, scene, config)
    return trajectory.positions[-1], trajectory.velocities[-1]


def hang(
    fabric: str, *, spacing: float = 0.01, frames: int = 121
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Lay a disc of a fabric, with edges of a spacing [m], over the table and let go of its rim.

    Returns:
        Where it comes to rest [m], where it lay flat [m], its faces, and the speed of the last frame, rms [mm/s].
    """
    positions, faces = disc(spacing)
    garment = make_cloth((positions, faces), {}, is_pinned=np.hypot(*positions[:, [0, 2]].T) <= TABLE)
    described = describe_fabric(fabric)
    warp = warp_directions(garment, direction=(0.0, 0.0, 1.0))
    material = described.sheet
    if described.weave is not None:
        material = on_threads(material, garment, warp, [(np.ones(len(warp), bool), described)])
    start = positions.copy()
    start[:, 1] += 1e-3 * np.random.default_rng(0).standard_normal(len(start))  # else it stays round
    start[np.asarray(garment.is_pinned)] = positions[np.asarray(garment.is_pinned)]
    scene = make_scene(garment, start, frames, timestep=_SETTLING, material=material)
    end, velocity = (np.asarray(part) for part in _settle(scene, SimConfig(iterations=_ITERATIONS)))
    return end, positions, faces, 1e3 * float(np.sqrt(np.mean(np.sum(velocity**2, axis=1))))


def drape(fabric: str, *, spacing: float = 0.01, frames: int = 121) -> Drape:
    """Measure how a fabric hangs; the arguments are those of `hang`."""
    end, positions, faces, speed = hang(fabric, spacing=spacing, frames=frames)
    shadow = _shadow(end, faces)
    rim = np.pi * (DISC**2 - TABLE**2)
    coefficient = (shadow.sum() * _PIXEL**2 - np.pi * TABLE**2) / rim
    is_rim = np.hypot(*positions[:, [0, 2]].T) > DISC - 1e-6
    order = np.argsort(np.arctan2(positions[is_rim, 2], positions[is_rim, 0]))
    reach = np.hypot(*end[is_rim][order][:, [0, 2]].T)
    waves = np.abs(np.fft.rfft(reach - reach.mean()))
    return Drape(fabric, float(coefficient), int(np.argmax(waves)), speed, shadow)


def _shadow(positions: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return which pixels of the ground a sheet shades from straight above."""
    count = round(2.2 * DISC / _PIXEL)
    shadow = np.zeros((count, count), bool)
    corners = (positions[faces][:, :, [0, 2]] + 1.1 * DISC) / _PIXEL
    for a, b, c in corners:
        low = np.maximum(np.floor(np.min([a, b, c], axis=0)).astype(int), 0)
        high = np.minimum(np.ceil(np.max([a, b, c], axis=0)).astype(int) + 1, count)
        x, z = np.meshgrid(np.arange(low[0], high[0]) + 0.5, np.arange(low[1], high[1]) + 0.5, indexing="ij")
        sides = [(q[0] - p[0]) * (z - p[1]) - (q[1] - p[1]) * (x - p[0]) for p, q in ((a, b), (b, c), (c, a))]
        inside = (np.min(sides, axis=0) >= 0) | (np.max(sides, axis=0) <= 0)
        shadow[low[0] : high[0], low[1] : high[1]] |= inside
    return shadow
