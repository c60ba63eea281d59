"""A narrow strip of cloth that falls or hangs from its upper end, for known answers."""

import jax
import jax.numpy as jnp
import numpy as np
from hard_cases.build import make_cloth, make_scene, same_way_faces

from eslr_jax import SimConfig, rollout_scene
from eslr_jax.simulation.scene import start_integrator

LENGTH = 0.5  # [m]


def strip(integrator="euler", *terms, frames, is_pinned, timestep=1 / 30, tilt=0.35, gravity=9.81):
    """A strip that is released at an angle [rad] from the vertical; pinned at its upper end, or nowhere.

    Terms beyond those of every scene, such as air, are given after the integrator.
    """
    x, along = (grid.ravel() for grid in np.meshgrid([0.0, 0.05], np.linspace(0, LENGTH, 11), indexing="ij"))
    mesh = np.stack([x, -along * np.cos(tilt), along * np.sin(tilt)], axis=1), same_way_faces(2, 11)
    garment = jax.tree.map(jnp.asarray, make_cloth(mesh, {}, is_pinned=along == 0 if is_pinned else None))
    scene = make_scene(garment, mesh[0], frames, timestep=timestep, gravity=gravity)
    start = start_integrator(scene.initial_state, integrator)
    return scene.replace(initial_state=start, terms=(*scene.terms, *terms))


def kept_per_period(integrator: str, *, timestep: float = 1 / 30, substeps: int = 1) -> float:
    """Return the share of its energy that a swinging strip keeps over a period, in the median."""
    scene = strip(integrator, frames=round(10 / 3 / timestep), is_pinned=True, timestep=timestep)
    trajectory = rollout_scene(None, scene.replace(substeps=substeps), SimConfig(iterations=60))
    return kept_in(np.asarray(trajectory.positions))


def kept_in(positions: np.ndarray) -> float:
    """Return the share of its energy that a strip keeps per period, from positions of all frames [m].

    Two turning points, heights of the mean angle over the lowest point, are half a period apart.
    """
    side = positions[:, :, 2].mean(axis=1) * 2
    is_turn = (np.diff(side[:-1]) * np.diff(side[1:]) <= 0) & (np.abs(side[1:-1]) > 1e-3)
    turns = np.abs(side[1:-1][is_turn])
    heights = LENGTH - np.sqrt(LENGTH**2 - turns**2)
    return float(np.median(heights[2:] / heights[:-2]))
