"""Measures of a trajectory: energies, stretch, penetration."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from eslr_jax.config import SimConfig
from eslr_jax.contact.nearest import find_contacts
from eslr_jax.physics.membrane import principal_stretches
from eslr_jax.physics.potential import PotentialTerms, next_friction_load, potential_terms
from eslr_jax.physics.problem import PhysicsParameters
from eslr_jax.simulate.scan import frame_inputs
from eslr_jax.simulate.step import FrameInput, frame_problem
from eslr_jax.types import Scene, Trajectory


class FrameMeasures(NamedTuple):
    """Per simulated frame; the start is left out."""

    terms: PotentialTerms  # [J], each of shape [frames - 1]
    max_stretch: Float[Array, " frames"]  # largest principal stretch
    distances: Float[Array, "frames vertices"] | None  # signed distance to the body [m]; None without one
    speed: Float[Array, " frames"]  # root mean square vertex speed [m/s]


@partial(jax.jit, static_argnames="config")
def measure_frames(
    trajectory: Trajectory, scene: Scene, parameters: PhysicsParameters, config: SimConfig | None = None
) -> FrameMeasures:
    """Measure every simulated frame of a trajectory.

    The energies of frame t are those of the minimisation problem that starts from the trajectory's own state
    at t - 1, gravity counted from there.

    Args:
        trajectory: What to measure.
        scene: The scene it is of.
        parameters: Constants of the scene.
        config: Says whether layers and tips collide, see `frame_problem`; static.
    """
    garment = scene.garment

    def measure(load, frame):
        position, velocity, answer, inputs = frame
        state = scene.start.replace(position=position, velocity=velocity, friction_load=load)
        problem = frame_problem(garment, state, inputs, scene.surface, scene.timestep, parameters, config)
        terms = potential_terms(answer, problem, garment, scene.material)
        terms = PotentialTerms(*(jnp.asarray(term, answer.dtype) for term in terms))
        stretch = jnp.max(principal_stretches(answer, garment)[0])
        distances = None
        if scene.surface is not None:
            load = next_friction_load(answer, problem, garment)
            distances = find_contacts(answer, inputs.next_body, inputs.next_body, scene.surface).distances
            distances = jnp.where(garment.vertex_mask, distances, jnp.inf)
        moved = jnp.where(garment.vertex_mask[:, None], (answer - position) / scene.timestep, 0.0)
        speed = jnp.sqrt(jnp.sum(moved * moved) / jnp.sum(garment.vertex_mask))
        return load, FrameMeasures(terms, stretch, distances, speed)

    inputs: FrameInput = frame_inputs(scene)
    frames = (trajectory.positions[:-1], trajectory.velocities[:-1], trajectory.positions[1:], inputs)
    _, measures = jax.lax.scan(measure, scene.start.friction_load, frames)
    return measures
