"""Rollouts: one jitted scan over frames."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from eslr_jax.config import SimConfig
from eslr_jax.physics.problem import PhysicsParameters
from eslr_jax.simulate.step import FrameInput, frame_problem, step
from eslr_jax.types import ClothState, Scene, Trajectory


def frame_inputs(scene: Scene) -> FrameInput:
    """Return the inputs of all frames, stacked along a leading axis of num_frames - 1."""
    body = scene.body_positions
    return FrameInput(
        body=None if body is None else body[:-1],
        next_body=None if body is None else body[1:],
        pin_targets=None if scene.pin_targets is None else scene.pin_targets[1:],
    )


@partial(jax.jit, static_argnames="config")
def simulate_scene(params: Any, scene: Scene, parameters: PhysicsParameters, config: SimConfig) -> Trajectory:
    """Simulate every frame of a scene; pure, and fit for vmap, grad and `lax.map`.

    Args:
        params: Weights of the network; None for the physics simulator.
        scene: Garment, fabric, start, and the outside world frame by frame.
        parameters: Physical constants; traced.
        config: Choices that shape the compiled step; static.

    Returns:
        Positions and velocities of all frames, frame 0 being the scene's start.
    """

    def advance(state: ClothState, frame: FrameInput):
        problem = frame_problem(state, frame, scene.surface, scene.timestep, parameters)
        state, report = step(params, scene.garment, scene.material, problem, state, config)
        return state, (state.position, state.velocity, report)

    start = scene.start
    end, (positions, velocities, reports) = jax.lax.scan(
        advance, start, frame_inputs(scene), length=scene.num_frames - 1
    )
    return Trajectory(
        positions=jnp.concatenate([start.position[None], positions]),
        velocities=jnp.concatenate([start.velocity[None], velocities]),
        residuals=jnp.concatenate([jnp.zeros_like(reports.residual[:1]), reports.residual]),
        iterations=jnp.concatenate([jnp.zeros_like(reports.iterations[:1]), reports.iterations]),
        status=end.status,
        first_bad_frame=end.first_bad_frame,
    )
