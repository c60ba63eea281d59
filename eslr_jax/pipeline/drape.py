"""Cusick's drape test: how much of a disc's shadow is left when its rim hangs over a round table.

Source: Cusick 1968, doi 10.1080/00405006808659985; ISO 9073-9: a disc of 30 cm, held between plates of 18 cm.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import Delaunay

from eslr_jax.config import SimConfig
from eslr_jax.errors import ConfigError
from eslr_jax.fabric.materials import rigidity_of
from eslr_jax.mesh.plate import warp_directions
from eslr_jax.mesh.prepare import prepare_garment
from eslr_jax.pipeline.fabrics import Described, describe_fabric, on_threads
from eslr_jax.simulation.rollout import rollout_scene
from eslr_jax.simulation.scene import initial_state
from eslr_jax.terms import CLOTH, Gravity
from eslr_jax.types import Scene

DISC, TABLE = 0.15, 0.09  # radii [m]
SPACING = 0.01  # [m] of edges
PER_LENGTH = 2  # edges in a bending length, at least: folds of light silk (1 cm) show at 5 mm, not at 10 mm
SHEARS = (3.0, 300.0)  # [N/m], about the least and the largest of woven cloth
STRETCH = 1000.0  # [N/m] along the threads of a fabric of which it was not measured; a class: woven cotton
_CLOSE = 0.005  # of a drape coefficient that is searched for: less than two cuts of a fabric differ by
_MOST_TRIES = 8
_PIXEL = 1e-3  # [m], of the shadow
_TIMESTEP = 1 / 15  # [s], of implicit Euler, which takes the swing out
_FRAMES = 16  # in one go
_MOST_FRAMES = 151
_AT_REST = 1e-3  # [m/s], rms; discs that were left alone till 0.1 mm/s had the same coefficient to 0.002
_SOLVED = SimConfig(iterations=400, tolerance=1e-3)


class Hung(NamedTuple):
    """A disc at rest over its table; the part of it that hangs."""

    positions: Float[np.ndarray, "vertices 3"]  # [m]
    flat: Float[np.ndarray, "vertices 3"]  # where it lay [m]
    faces: Int[np.ndarray, "faces 3"]
    speed: float  # rms [m/s]

    @property
    def coefficient(self) -> float:
        """The share of the rim's area that its shadow covers."""
        return float(np.sum(self.shadow()) * _PIXEL**2 / (np.pi * (DISC**2 - TABLE**2)))

    def shadow(self) -> Bool[np.ndarray, "pixels pixels"]:
        """Return which pixels of the ground outside the table it shades from straight above."""
        count = round(2.2 * DISC / _PIXEL)
        shadow = np.zeros((count, count), bool)
        for corners in (self.positions[self.faces][:, :, [0, 2]] + 1.1 * DISC) / _PIXEL:
            low = np.maximum(np.floor(corners.min(axis=0)).astype(int), 0)
            high = np.minimum(np.ceil(corners.max(axis=0)).astype(int) + 1, count)
            x, z = np.meshgrid(
                *(np.arange(a, b) + 0.5 for a, b in zip(low, high, strict=True)), indexing="ij"
            )
            sides = [
                (q[0] - p[0]) * (z - p[1]) - (q[1] - p[1]) * (x - p[0])
                for p, q in zip(corners, np.roll(corners, -1, axis=0), strict=True)
            ]
            inside = (np.min(sides, axis=0) >= 0) | (np.max(sides, axis=0) <= 0)
            shadow[low[0] : high[0], low[1] : high[1]] |= inside
        place = (np.arange(count) + 0.5) * _PIXEL - 1.1 * DISC
        return shadow & (np.hypot(place[:, None], place) > TABLE)


def disc(spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the part of a flat disc that hangs [m], irregular triangles that face up, and what holds it.

    A mesh bends over half an edge behind its last held vertices. So the two held rings lie half an edge off the
    table's rim, on either side.
    """
    random = np.random.default_rng(0)
    inner = TABLE + spacing / 2
    count = round((DISC - inner) / (0.87 * spacing)) + 1
    rings = []
    for place, radius in enumerate((TABLE - spacing / 2, *np.linspace(inner, DISC, count))):
        turns = round(2 * np.pi * radius / spacing)
        angle = (np.arange(turns) + random.uniform()) * 2 * np.pi / turns
        ring = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        is_free = 1 < place < count
        rings.append(ring + 0.15 * spacing * random.standard_normal(ring.shape) * is_free)
    points = np.concatenate(rings)
    faces = Delaunay(points).simplices
    faces = faces[(faces >= len(rings[0])).any(axis=1)]  # not those over the table
    edges = points[faces[:, 1:]] - points[faces[:, :1]]
    is_up = np.linalg.det(edges) < 0
    faces = np.where(is_up[:, None], faces, faces[:, [0, 2, 1]])
    return np.stack([points[:, 0], np.zeros(len(points)), points[:, 1]], axis=1), faces


@partial(jax.jit, static_argnums=1)
def _settle(scene: Scene, config: SimConfig) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return where the cloth is after the scene's frames [m], its velocities, and their rms [m/s]."""
    trajectory = rollout_scene(None, scene, config)
    velocity = trajectory.velocities[-1]
    return trajectory.positions[-1], velocity, jnp.sqrt(jnp.mean(jnp.sum(velocity**2, axis=1)))


def hang(
    described: Described,
    *,
    spacing: float = SPACING,
    start: int = 0,
    frames: int = _MOST_FRAMES,
    lowering: Sequence[float] = (1.0,),
) -> Hung:
    """Lay a disc of a fabric over the table and let go of its rim, at once or slowly.

    Args:
        described: Fabric, of `describe_fabric`; its warp runs along z.
        spacing: Of the edges [m].
        start: Starts differ by a micrometre, as by rounding; which folds form differs with them.
        frames: At most, of 1/15 s, in each part of `lowering`.
        lowering: Shares of gravity, one after the other; with each the disc comes to rest.
    """
    flat, faces = disc(spacing)
    ones = np.ones((len(flat), 1))
    garment = prepare_garment(
        flat,
        faces,
        skin_weights=ones,
        skin_indices=np.zeros_like(ones, int),
        is_pinned=np.hypot(flat[:, 0], flat[:, 2]) < TABLE + 0.6 * spacing,
    )
    warp = warp_directions(garment, direction=(0.0, 0.0, 1.0))
    every = np.ones(len(warp), bool)
    lifted = 1e-3 * np.random.default_rng(0).standard_normal(len(flat))  # else it stays round
    lifted += 1e-6 * np.random.default_rng(start).standard_normal(len(flat))
    position = jnp.asarray(flat, jnp.float32)
    started = position.at[:, 1].set(jnp.where(garment.is_pinned, 0.0, lifted))
    length = min(frames, _FRAMES)
    scene = Scene(
        garment=garment,
        material=on_threads(described.sheet, garment, warp, [(every, described)]),
        timestep=jnp.float32(_TIMESTEP),
        initial_state=initial_state(started, jnp.zeros_like(position)),
        body=None,
        pin_targets=jnp.broadcast_to(position, (length, *position.shape)),
        terms=CLOTH,
        num_frames=length,
    )
    state, speed = scene.initial_state, np.inf
    for share in lowering:
        weight = Gravity(share * Gravity().acceleration)
        terms = tuple(weight if isinstance(term, Gravity) else term for term in CLOTH)
        for _ in range(0, frames - 1, length - 1):
            end, velocity, speed = _settle(scene.replace(initial_state=state, terms=terms), _SOLVED)
            state = initial_state(end, velocity)
            if speed < _AT_REST:
                break
    return Hung(np.asarray(state.position), flat, faces, float(speed))


class Fitted(NamedTuple):
    """A fabric of measurements."""

    fabric: str  # as `describe_fabric` takes it
    drape: float  # that its disc has
    shears: tuple[float, float]  # [N/m] between which it was searched for
    drapes: tuple[float, float]  # that their discs have


def fit_drape(drape: float, density: float, bending_length: float) -> Fitted:
    """Return the fabric that has a weight, a bending length and, by its stiffness in shear, a drape coefficient.

    Weight and bending length, alike along warp and weft, are exact. Stretch along the threads is that of a class.

    Args:
        drape: Cusick's coefficient, a share.
        density: [kg/m^2].
        bending_length: Peirce's [m].

    Raises:
        ConfigError: No such fabric drapes so; the message says between which it would.
    """
    rigidity = rigidity_of(bending_length, density)
    spacing = min(SPACING, bending_length / PER_LENGTH)

    def text(shear: float) -> str:
        numbers = {"density": density, "flexural_rigidity": rigidity, "warp_stretch": STRETCH, "shear": shear}
        return ",".join(f"{name}={value:.6g}" for name, value in numbers.items())

    def found(shear: float) -> float:
        return hang(describe_fabric(text(shear)), spacing=spacing).coefficient

    (low, high), drapes = SHEARS, (found(SHEARS[0]), found(SHEARS[1]))
    if not drapes[0] - _CLOSE <= drape <= drapes[1] + _CLOSE:
        raise ConfigError(
            f"a drape of {drape:g} does not go with a bending length of {1e2 * bending_length:g} cm: its disc "
            f"drapes by {drapes[0]:.2f} to {drapes[1]:.2f}, for shear of {low:g} to {high:g} N/m; measure the "
            "bending length again, as the mean of warp and weft, or give a drape between these"
        )
    best = min(zip(drapes, SHEARS, strict=True), key=lambda pair: abs(pair[0] - drape))
    for _ in range(_MOST_TRIES):
        if abs(best[0] - drape) < _CLOSE:
            break
        middle = float(np.sqrt(low * high))
        got = found(middle)
        best = min(best, (got, middle), key=lambda pair: abs(pair[0] - drape))
        low, high = (middle, high) if got < drape else (low, middle)
    return Fitted(text(best[1]), best[0], SHEARS, drapes)
