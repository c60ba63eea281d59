"""The front door: simulate a garment on a moving body, and raise what went wrong."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from eslr_jax.config import SimConfig
from eslr_jax.errors import CapacityError, ConfigError, EslrError, MotionError, NonFiniteError, Status
from eslr_jax.models.registry import check_params
from eslr_jax.physics.materials import COTTON
from eslr_jax.physics.problem import PhysicsParameters
from eslr_jax.scene import SceneOptions, prepare_scene
from eslr_jax.simulate.scan import frame_inputs, join_frames, scan_frames, simulate_scene
from eslr_jax.simulate.step import FrameInput
from eslr_jax.types import BodyMotion, Garment, Material, Scene, Trajectory


def rollout(
    params: Any,
    garment: Garment,
    poses: BodyMotion,
    *,
    config: SimConfig | None = None,
    material: Material = COTTON,
    parameters: PhysicsParameters | None = None,
    options: SceneOptions | None = None,
) -> Trajectory:
    """Simulate a garment on a moving body.

    Args:
        params: Weights of the network, of `load_model`; None for the physics simulator.
        garment: Of `load_garment` or `prepare_garment`.
        poses: Of `pose_body`.
        config: Which simulator, and how; the physics simulator by default.
        material: Fabric.
        parameters: Physical constants.
        options: What the scene leaves out or adds.

    Returns:
        The trajectory; frame 0 is the garment skinned to the first pose and pushed out of the body.

    Raises:
        ConfigError: The network is asked for without weights or without its architecture.
        CheckpointError: The weights are for another architecture.
        NonFiniteError: Positions became NaN or infinite; the message names the first bad frame.
        CapacityError: A buffer was too small.
        MotionError: The motion is too short, or too fast to follow.
    """
    config = config or SimConfig(simulator="physics")
    check_network(params, config)
    scene = prepare_scene(garment, poses, material=material, options=options)
    trajectory = simulate_scene(params, scene, parameters or PhysicsParameters(), config)
    raise_for_status(trajectory)
    return trajectory


class Timing(NamedTuple):
    """Where the time of a rollout went."""

    compile_s: float
    frame_ms: float  # mean of the simulated frames


def rollout_in_chunks(
    params: Any,
    scene: Scene,
    *,
    config: SimConfig,
    parameters: PhysicsParameters | None = None,
    chunk: int = 10,
    on_frames: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[Trajectory, Timing]:
    """Simulate a prepared scene a few frames at a time, to show progress and to time compilation apart.

    Args:
        params: Weights of the network; None for the physics simulator.
        scene: Of `prepare_scene`.
        config: Which simulator, and how.
        parameters: Physical constants.
        chunk: Frames per call of the compiled scan.
        on_frames: Called with the frames done and the frames in all.

    Returns:
        The trajectory, with its status unchecked, and its timing.
    """
    check_network(params, config)
    parameters = parameters or PhysicsParameters()
    total = scene.num_frames - 1
    chunk = min(chunk, total)
    inputs = frame_inputs(scene)
    constant = scene.replace(body_positions=None, pin_targets=None)

    def part(first: int) -> FrameInput:
        # The last chunk repeats its last frame; what it simulates beyond the end is dropped.
        frames = np.minimum(np.arange(first, first + chunk), total - 1)
        return jax.tree.map(lambda leaf: leaf[frames], inputs)

    scan = jax.jit(scan_frames, static_argnames=("length", "config"))
    began = time.perf_counter()
    compiled = scan.lower(params, constant, scene.start, part(0), chunk, parameters, config).compile()
    compile_s = time.perf_counter() - began
    state, done = scene.start, []
    began = time.perf_counter()
    for first in range(0, total, chunk):
        end, frames = jax.block_until_ready(compiled(params, constant, state, part(first), parameters))
        count = min(chunk, total - first)
        done.append(jax.tree.map(lambda leaf, count=count: leaf[:count], frames))
        if count == chunk or int(end.first_bad_frame) <= total:
            state = end
        on_frames(first + count, total)
    frame_ms = (time.perf_counter() - began) * 1e3 / (chunk * len(done))
    joined = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *done)
    return join_frames(scene.start, joined, state), Timing(compile_s, frame_ms)


def check_network(params: Any, config: SimConfig) -> None:
    """Check that weights and architecture are there and fit each other.

    Raises:
        ConfigError: The network is asked for without weights or without its architecture.
        CheckpointError: The weights are for another architecture.
    """
    if config.simulator == "physics":
        return
    if params is None or config.model is None:
        raise ConfigError("the network needs weights and config.model; get both from load_model")
    check_params(config.model, params)


def raise_for_status(trajectory: Trajectory) -> None:
    """Raise the error that a trajectory's status bits stand for.

    Raises:
        NonFiniteError: Positions became NaN or infinite.
        CapacityError: A buffer was too small.
        MotionError: The body moved too fast to follow.
    """
    status = Status(int(jax.device_get(trajectory.status)))
    if status == Status.OK:
        return
    message = f"frame {int(trajectory.first_bad_frame)}: {status.describe()}"
    error: type[EslrError] = CapacityError
    if Status.NON_FINITE in status:
        error = NonFiniteError
    elif Status.BODY_TOO_FAST in status:
        error = MotionError
    raise error(message)
