"""Measures of a trajectory's frames: stretch, penetration, speed."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from eslr_jax.contact.nearest import find_contacts
from eslr_jax.simulation.program import Program, find_program
from eslr_jax.terms.stretch import principal_stretches
from eslr_jax.types import Garment, Obstacle, Scene


class FrameMeasures(NamedTuple):
    """Measures of every simulated frame; frame 0 is left out."""

    max_stretch: Float[Array, " frames"]  # largest principal stretch
    p99_stretch: Float[Array, " frames"]  # the same, not exceeded by 99 % of the faces
    distances: Float[Array, "frames vertices"] | None  # signed distance to the body [m]; None without one
    speed: Float[Array, " frames"]  # root mean square vertex speed [m/s]


def measure_frames(positions: Float[Array, "frames vertices 3"], scene: Scene) -> FrameMeasures:
    """Measure every simulated frame of a trajectory of a scene, given positions [m]; frame 0 is the start."""
    measured = jax.device_put(_measured(positions, scene))
    return measures_program(positions, scene).wait()(*measured)


def measures_program(positions: Float[Array, "frames vertices 3"], scene: Scene) -> Program:
    """Return the program of `measure_frames`; arrays may be shapes alone."""
    return find_program(_measure, _measured(positions, scene))


def _measured(positions: Any, scene: Scene) -> tuple:
    """Return what measures depend on, which is not what the scene models."""
    return positions, scene.garment, scene.timestep, scene.body


def _measure(
    positions: Float[Array, "frames vertices 3"],
    garment: Garment,
    timestep: Float[Array, ""],
    body: Obstacle | None,
) -> FrameMeasures:
    is_real = garment.rest_areas > 0
    count = jnp.sum(is_real, dtype=jnp.int32)

    def measure(frame):
        position, moved_to, moved_body = frame
        stretch = jnp.sort(jnp.where(is_real, principal_stretches(moved_to, garment)[0], jnp.inf))
        distances = None
        if body is not None:
            contacts = find_contacts(moved_to, moved_body, moved_body, body.surface, garment.vertex_blocks)
            distances = jnp.where(garment.vertex_mask, contacts.distances, jnp.inf)
        moved = jnp.where(garment.vertex_mask[:, None], (moved_to - position) / timestep, 0.0)
        speed = jnp.sqrt(jnp.sum(moved * moved) / jnp.sum(garment.vertex_mask, dtype=moved.dtype))
        return FrameMeasures(stretch[count - 1], stretch[(99 * (count - 1)) // 100], distances, speed)

    bodies = None if body is None else body.positions[1:]
    return jax.lax.map(measure, (positions[:-1], positions[1:], bodies))


def extremes(measures: FrameMeasures, is_real: np.ndarray) -> dict[str, float]:
    """Return the largest stretch that 99 % of the frames stay below, and the penetration of a scene with a body.

    `is_real` tells which vertices are no padding, shape [vertices].
    """
    depth = -np.asarray(measures.distances)[:, is_real]
    stretch = float(np.quantile(measures.max_stretch, 0.99))
    return {"stretch_p99": stretch, "penetration_p999_mm": penetration_p999_mm(depth)}


def penetration_p999_mm(depth: np.ndarray) -> float:
    """Return the depth in the body [mm] that 99.9 % of the depths [m] stay below; zero where all are outside."""
    return float(max(np.quantile(depth, 0.999), 0.0) * 1e3)


@jax.jit
def face_stretches(
    positions: Float[Array, "frames vertices 3"], garment: Garment
) -> Float[Array, "frames faces"]:
    """Return the larger principal stretch of every face in every frame; positions are in m."""
    return jax.lax.map(lambda position: principal_stretches(position, garment)[0], positions)
