"""A narrow strip of cloth that falls or hangs from its upper end, for known answers."""

import jax
import jax.numpy as jnp
import numpy as np

from eslr_jax.geometry.prepare import prepare_garment
from eslr_jax.physics.materials import COTTON
from eslr_jax.scene.build import initial_state, start_integrator
from eslr_jax.types import PhysicsConstants, Scene

LENGTH = 0.5  # [m]


def strip(integrator="euler", *, frames, is_pinned, timestep=1 / 30, tilt=0.35, **modelled):
    """A strip that is released at an angle [rad] from the vertical; pinned at its upper end, or nowhere."""
    x, along = (grid.ravel() for grid in np.meshgrid([0.0, 0.05], np.linspace(0, LENGTH, 11), indexing="ij"))
    index = np.arange(22).reshape(2, 11)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    garment = prepare_garment(
        np.stack([x, -along * np.cos(tilt), along * np.sin(tilt)], axis=1),
        np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]),
        skin_weights=np.ones((22, 1)),
        skin_indices=np.zeros((22, 1), int),
        is_pinned=along == 0 if is_pinned else None,
    )
    garment = jax.tree.map(jnp.asarray, garment)
    start, dt = garment.rest_positions, jnp.float32(timestep)
    return Scene(
        garment=garment,
        material=COTTON,
        **{"constants": PhysicsConstants(), **modelled},
        initial_state=start_integrator(initial_state(start, jnp.zeros_like(start)), integrator),
        timestep=dt,
        body=None,
        pin_targets=jnp.broadcast_to(start, (frames, *start.shape)) if is_pinned else None,
        num_frames=frames,
    )
