"""The order of the integrators, on a strip that swings without folds, in frames that are solved to rounding."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from eslr_jax import SimConfig, rollout_scene
from eslr_jax.simulation.scene import Integrator
from known_answers.strip import strip

_SECONDS = 0.4  # of the swing
_FRAME = 0.1  # [s]
_PARTS = (2, 4, 8, 16)  # of it, each of which is a step
_FINEST = 64
_TURN = 0.5  # [rad/s], about the upper end; faster, the pull outwards would make it ring


class Order(NamedTuple):
    """How far a swing is from the same one in finer steps."""

    integrator: str
    timestep_ms: float
    rms_mm: float  # over vertices, at the end
    order: float | None  # by which the error fell since the step before


def orders(is_smoke: bool) -> Iterator[Order]:
    """Yield the error at each timestep, against BDF2 in the finest one."""
    hanging = strip("euler", frames=61, is_pinned=True, timestep=0.1, tilt=0.0)
    rest = rollout_scene(None, hanging, SimConfig(iterations=100)).positions[-1]
    best = _end(rest, "bdf2", 8 if is_smoke else _FINEST)
    for integrator in ("euler", "bdf2"):
        before = None
        for parts in _PARTS[:1] if is_smoke else _PARTS:
            away = np.linalg.norm(_end(rest, integrator, parts) - best, axis=1)
            error = 1e3 * float(np.sqrt(np.mean(away**2)))
            order = None if before is None else float(np.log2(before / error))
            yield Order(integrator, 1e3 * _FRAME / parts, error, order)
            before = error


def _end(rest: jax.Array, integrator: Integrator, parts: int) -> np.ndarray:
    """Return where a strip ends [m] that hung at rest and was pushed, with frames in so many parts.

    It hangs stretched by its weight. Let go unstretched, it would ring in modes that are faster than a timestep.
    """
    timestep = _FRAME / parts
    scene = strip(
        integrator, frames=round(_SECONDS / timestep) + 1, is_pinned=True, timestep=timestep, tilt=0.0
    )
    turning = jnp.zeros_like(rest).at[:, 2].set(-_TURN * rest[:, 1])
    start = scene.initial_state.replace(position=rest, velocity=turning)
    trajectory = rollout_scene(None, scene.replace(initial_state=start), SimConfig(iterations=100))
    return np.asarray(trajectory.positions[-1], np.float64)
