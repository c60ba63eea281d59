"""Rollouts: one jitted scan over frames."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from eslr_jax.config import SimConfig
from eslr_jax.physics.problem import PhysicsParameters
from eslr_jax.simulate.step import FrameInput, StepReport, frame_problem, step
from eslr_jax.types import ClothState, Scene, Trajectory


class Frames(NamedTuple):
    """What a scan leaves behind, frame by frame."""

    positions: Float[Array, "frames vertices 3"]  # [m]
    velocities: Float[Array, "frames vertices 3"]  # [m/s]
    residuals: Float[Array, " frames"]
    iterations: Int[Array, " frames"]
    needed_capacity: Int[Array, "frames capacities"] | None  # see Trajectory


def frame_inputs(scene: Scene) -> FrameInput:
    """Return the inputs of all frames, stacked along a leading axis of num_frames - 1."""
    body = scene.body_positions
    return FrameInput(
        body=None if body is None else body[:-1],
        next_body=None if body is None else body[1:],
        pin_targets=None if scene.pin_targets is None else scene.pin_targets[1:],
    )


def scan_frames(
    params: Any,
    scene: Scene,
    state: ClothState,
    inputs: FrameInput,
    length: int,
    parameters: PhysicsParameters,
    config: SimConfig,
    iterations: Int[Array, ""] | None = None,
) -> tuple[ClothState, Frames]:
    """Simulate `length` frames from `state`; pure, and fit for jit, vmap and grad.

    Args:
        params: Weights of the network; None for the physics simulator.
        scene: What stays constant; its own frames are not read.
        state: Where to start.
        inputs: The outside world, frame by frame.
        length: Number of frames; static.
        parameters: Physical constants; traced.
        config: Choices that shape the compiled step; static.
        iterations: See `simulate_scene`.
    """

    def advance(state: ClothState, frame: FrameInput) -> tuple[ClothState, Frames]:
        problem = frame_problem(
            scene.garment, state, frame, scene.surface, scene.timestep, parameters, config
        )
        report: StepReport
        state, report = step(params, scene.garment, scene.material, problem, state, config, iterations)
        return state, Frames(
            state.position, state.velocity, report.residual, report.iterations, report.needed_capacity
        )

    return jax.lax.scan(advance, state, inputs, length=length)


@partial(jax.jit, static_argnames="config")
def simulate_scene(
    params: Any,
    scene: Scene,
    parameters: PhysicsParameters,
    config: SimConfig,
    iterations: Int[Array, ""] | int | None = None,
) -> Trajectory:
    """Simulate every frame of a scene.

    Args:
        params: Weights of the network; None for the physics simulator.
        scene: Garment, fabric, start, and the outside world frame by frame.
        parameters: Physical constants; traced.
        config: Choices that shape the compiled step; static.
        iterations: Of L-BFGS per frame, in place of the configuration's; traced, so that rollouts which differ
            in nothing else share a program.

    Returns:
        Positions and velocities of all frames, frame 0 being the scene's start.
    """
    inputs, length = frame_inputs(scene), scene.num_frames - 1
    end, frames = scan_frames(params, scene, scene.start, inputs, length, parameters, config, iterations)
    return join_frames(scene.start, frames, end)


def join_frames(start: ClothState, frames: Frames, end: ClothState) -> Trajectory:
    """Return the trajectory of a start, the frames after it, and the state it ended in."""

    def after_nothing(values: Array) -> Array:
        return jnp.concatenate([jnp.zeros_like(values[:1]), values])

    needed = frames.needed_capacity
    return Trajectory(
        positions=jnp.concatenate([start.position[None], frames.positions]),
        velocities=jnp.concatenate([start.velocity[None], frames.velocities]),
        residuals=after_nothing(frames.residuals),
        iterations=after_nothing(frames.iterations),
        needed_capacity=None if needed is None else after_nothing(needed),
        status=end.status,
        first_bad_frame=end.first_bad_frame,
    )
