"""The scene of these experiments: a square sheet in the air."""

from __future__ import annotations

import harness
import jax
import jax.numpy as jnp
import numpy as np

from eslr_jax.geometry.prepare import prepare_garment
from eslr_jax.physics.materials import COTTON
from eslr_jax.scene.build import initial_state
from eslr_jax.types import Garment, Material, PhysicsConstants, Scene

RESULTS = harness.RESULTS / "inverse"
TIMESTEP = 1 / 30  # [s]


def square(side: int, size: float, pins: list[int]) -> Garment:
    """Return a level square of side x side vertices around the origin.

    Args:
        side: Number of vertices along an edge.
        size: Length of an edge [m].
        pins: Indices of vertices that are held.
    """
    line = np.linspace(-0.5, 0.5, side) * size
    x, z = (grid.ravel() for grid in np.meshgrid(line, line, indexing="ij"))
    index = np.arange(side * side).reshape(side, side)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    return prepare_garment(
        np.stack([x, np.zeros_like(x), z], axis=1),
        np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]),
        skin_weights=np.ones((side * side, 1)),
        skin_indices=np.zeros((side * side, 1), int),
        is_pinned=np.array(pins, int),
    )


def held_scene(garment: Garment, shift: jax.Array, material: Material = COTTON) -> Scene:
    """Return the scene of a sheet that starts level and at rest while its pinned vertices move.

    Args:
        garment: A sheet with pins.
        shift: How far pinned vertices are from where they start [m], shape [frames, vertices or 1, 3].
        material: Fabric.
    """
    rest = jnp.asarray(garment.rest_positions)
    return Scene(
        garment=jax.tree.map(jnp.asarray, garment),
        material=material,
        constants=PhysicsConstants(),
        timestep=jnp.float32(TIMESTEP),
        initial_state=initial_state(rest, jnp.zeros_like(rest)),
        body=None,
        pin_targets=rest + shift,
        num_frames=shift.shape[0],
    )
