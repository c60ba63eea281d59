"""The scene of these experiments: a square sheet in the air."""

import harness
import jax
import jax.numpy as jnp
import numpy as np
from hard_cases.build import make_cloth, same_way_faces

from eslr_jax.fabric.materials import COTTON
from eslr_jax.simulation.scene import initial_state
from eslr_jax.terms import CLOTH
from eslr_jax.types import Garment, Material, Scene

RESULTS = harness.RESULTS / "inverse"
TIMESTEP = 1 / 30  # [s]


def square(side: int, size: float, pins: list[int]) -> Garment:
    """Return a level square of side x side vertices around the origin, of a size [m], with pins."""
    line = np.linspace(-0.5, 0.5, side) * size
    x, z = (grid.ravel() for grid in np.meshgrid(line, line, indexing="ij"))
    positions = np.stack([x, np.zeros_like(x), z], axis=1)
    return make_cloth((positions, same_way_faces(side, side)), {}, is_pinned=np.array(pins, int))


def held_scene(garment: Garment, shift: jax.Array, material: Material = COTTON) -> Scene:
    """Return the scene of a sheet that starts level and at rest while its pins shift [m], frame by frame."""
    rest = jnp.asarray(garment.rest_positions)
    return Scene(
        garment=jax.tree.map(jnp.asarray, garment),
        material=material,
        timestep=jnp.float32(TIMESTEP),
        initial_state=initial_state(rest, jnp.zeros_like(rest)),
        body=None,
        pin_targets=rest + shift,
        terms=CLOTH,
        num_frames=shift.shape[0],
    )
