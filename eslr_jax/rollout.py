"""The front door: simulate a garment on a moving body, and raise what went wrong."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Int

from eslr_jax.config import SimConfig
from eslr_jax.contact.self_contact import CELL_CAPACITY, PAIRS_PER_VERTEX
from eslr_jax.errors import CapacityError, ConfigError, EslrError, MotionError, NonFiniteError, Status
from eslr_jax.geometry.padding import choose_bucket
from eslr_jax.models.registry import check_params
from eslr_jax.physics.materials import COTTON
from eslr_jax.physics.problem import PhysicsParameters
from eslr_jax.physics.validate import validate_material, validate_parameters, validate_timestep
from eslr_jax.scene import SceneOptions, prepare_scene, prepare_scenes
from eslr_jax.simulate.batch import SCENES, simulate_scenes, stack_scenes
from eslr_jax.simulate.scan import frame_inputs, join_frames, scan_frames, simulate_scene
from eslr_jax.simulate.step import FrameInput
from eslr_jax.types import BodyMotion, Garment, Material, Scene, Trajectory

_HEADROOM = 1.25  # of a buffer made larger: with it, cloth moves on a little differently and may need more


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
        ConfigError: The network is asked for without weights or without its architecture, or the fabric, a
            constant or the timestep is out of its physical range.
        CheckpointError: The weights are for another architecture.
        NonFiniteError: Positions became NaN or infinite; the message names the first bad frame.
        CapacityError: A buffer was too small; where it was that of world edges or of self-contact, the rollout
            was done anew with a larger one instead.
        MotionError: The motion is too short, or too fast to follow.
    """
    config, parameters = config or SimConfig(simulator="physics"), parameters or PhysicsParameters()
    check_network(params, config)
    scene = prepare_scene(garment, poses, material=material, options=options)
    check_scene(scene, parameters)
    trajectory = simulate_scene(params, scene, parameters, config)
    while (larger := more_room(trajectory, config)) is not None:
        config = larger
        trajectory = simulate_scene(params, scene, parameters, config)
    raise_for_status(trajectory)
    return trajectory


def more_room(trajectory: Trajectory, config: SimConfig) -> SimConfig | None:
    """Return a configuration with more room for what a rollout had too little of, else None.

    World edges get twice as much: doubling ends, as a row for every vertex always suffices. Self-contact gets
    what its fullest frame asked for and a quarter more. Other buffers can't be enlarged.
    """
    status = Status(int(jax.device_get(trajectory.status)))
    changes: dict[str, Any] = {}
    if Status.WORLD_EDGE_OVERFLOW in status:
        assert config.model is not None
        assert config.model.world_edge_capacity is not None
        capacity = 2 * config.model.world_edge_capacity
        changes["model"] = dataclasses.replace(config.model, world_edge_capacity=capacity)
    if Status.SELF_CONTACT_OVERFLOW in status and trajectory.needed_capacity is not None:
        pairs, faces = (int(value) for value in np.max(np.asarray(trajectory.needed_capacity), axis=0))
        num_vertices = trajectory.positions.shape[1]
        if pairs > (config.self_contact_capacity or PAIRS_PER_VERTEX * num_vertices):
            changes["self_contact_capacity"] = math.ceil(_HEADROOM * pairs)
        if faces > (config.self_contact_cell_capacity or CELL_CAPACITY):
            changes["self_contact_cell_capacity"] = math.ceil(_HEADROOM * faces)
    return dataclasses.replace(config, **changes) if changes else None


def rollout_batch(
    params: Any,
    garments: Sequence[Garment],
    poses: Sequence[BodyMotion],
    *,
    config: SimConfig | None = None,
    material: Material = COTTON,
    parameters: PhysicsParameters | None = None,
    options: SceneOptions | None = None,
    batch_size: int = 1,
    devices: Sequence[Any] | None = None,
) -> list[Trajectory]:
    """Simulate garment i on motion i for every i; scenes of like size share one compiled rollout.

    Garments are padded to the bucket of their vertex count, and those of one bucket are simulated together.

    Args:
        params: Weights of the network; None for the physics simulator.
        garments: Of `load_garment` or `prepare_garment`; any sizes.
        poses: As many motions, of `pose_body`.
        config: Which simulator, and how; the physics simulator by default.
        material: Fabric of all.
        parameters: Physical constants of all.
        options: What the scenes leave out or add.
        batch_size: Scenes per step on a device, see `simulate_scenes`.
        devices: Of `jax.devices()`, to spread the scenes over; by default the first alone.

    Returns:
        Trajectories in the order given, with the vertices of each garment. Their status is not checked: one
        bad scene shall not cost the others; see `raise_for_status`.

    Raises:
        ConfigError: As many motions as garments are needed; or the network lacks weights; or a fabric, a
            constant or a timestep is out of its physical range.
        CheckpointError: The weights are for another architecture.
        MotionError: A motion has fewer than two frames.
    """
    config = config or SimConfig(simulator="physics")
    check_network(params, config)
    if len(garments) != len(poses):
        raise ConfigError(f"{len(garments)} garments and {len(poses)} motions; give one motion per garment")
    devices = list(devices or [])
    mesh = Mesh(np.array(devices), (SCENES,)) if len(devices) > 1 else None
    parameters = parameters or PhysicsParameters()
    done: dict[int, Trajectory] = {}
    for group in _group_alike(garments, poses):
        scenes = prepare_scenes(
            [garments[i] for i in group], [poses[i] for i in group], material=material, options=options
        )
        # Devices get equal shares: the last scene is repeated, and what is simulated twice is dropped.
        missing = -len(scenes) % max(len(devices), 1)
        for scene in scenes:
            check_scene(scene, parameters)
        stacked = stack_scenes(scenes + scenes[-1:] * missing)
        together = simulate_scenes(params, stacked, parameters, config, batch_size=batch_size, mesh=mesh)
        for row, i in enumerate(group):
            one = jax.tree.map(lambda leaf, row=row: leaf[row], together)
            count = garments[i].vertex_mask.shape[0]
            done[i] = one.replace(positions=one.positions[:, :count], velocities=one.velocities[:, :count])
    return [done[i] for i in range(len(garments))]


def _group_alike(garments: Sequence[Garment], poses: Sequence[BodyMotion]) -> list[list[int]]:
    """Group scenes that can be stacked: like vertex counts, frame counts and bodies."""
    groups: dict[tuple, list[int]] = {}
    for i, (garment, motion) in enumerate(zip(garments, poses, strict=True)):
        body = hash(np.asarray(motion.faces).tobytes())
        key = (choose_bucket(garment).vertices, motion.positions.shape[0], body)
        groups.setdefault(key, []).append(i)
    return list(groups.values())


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
    pace: Callable[[int, float], int] | None = None,
    on_frames: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[Trajectory, Timing]:
    """Simulate a prepared scene a few frames at a time, to show progress and to time compilation apart.

    Args:
        params: Weights of the network; None for the physics simulator.
        scene: Of `prepare_scene`.
        config: Which simulator, and how.
        parameters: Physical constants.
        chunk: Frames per call of the compiled scan.
        pace: Called after every chunk with its iterations per frame and the milliseconds that a frame took;
            returns the iterations of the next. By default all take the configuration's.
        on_frames: Called with the frames done and the frames in all.

    Returns:
        The trajectory, with its status unchecked, and its timing. It ends with the chunk in which something went
        wrong; see `more_room` and `raise_for_status`.

    Raises:
        ConfigError: As for `rollout`.
    """
    check_network(params, config)
    parameters = parameters or PhysicsParameters()
    check_scene(scene, parameters)
    total = scene.num_frames - 1
    chunk = min(chunk, total)
    inputs = frame_inputs(scene)
    constant = scene.replace(body_positions=None, pin_targets=None)

    def part(first: int) -> FrameInput:
        # The last chunk repeats its last frame; what it simulates beyond the end is dropped.
        frames = np.minimum(np.arange(first, first + chunk), total - 1)
        return jax.tree.map(lambda leaf: leaf[frames], inputs)

    scan = jax.jit(scan_frames, static_argnames=("length", "config"))
    iterations = config.iterations

    def traced() -> Int[Array, ""] | None:
        return None if pace is None else jnp.int32(iterations)  # all numbers share a program

    began = time.perf_counter()
    compiled = scan.lower(
        params, constant, scene.start, part(0), chunk, parameters, config, traced()
    ).compile()
    compile_s = time.perf_counter() - began
    state, done, seconds = scene.start, [], 0.0
    for first in range(0, total, chunk):
        began = time.perf_counter()
        end, frames = jax.block_until_ready(
            compiled(params, constant, state, part(first), parameters, traced())
        )
        took = time.perf_counter() - began
        seconds += took
        if pace is not None:
            iterations = pace(iterations, took * 1e3 / chunk)
        count = min(chunk, total - first)
        done.append(jax.tree.map(lambda leaf, count=count: leaf[:count], frames))
        is_bad = int(end.status) != Status.OK and int(end.first_bad_frame) <= total
        if count == chunk or is_bad:
            state = end
        on_frames(first + count, total)
        if is_bad:
            break
    frame_ms = seconds * 1e3 / (chunk * len(done))
    joined = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *done)
    return join_frames(scene.start, joined, state), Timing(compile_s, frame_ms)


def check_scene(scene: Scene, parameters: PhysicsParameters) -> None:
    """Check that the fabric, the constants and the timestep of a scene are physical.

    Raises:
        ConfigError: Names the value and what is accepted.
    """
    validate_material(scene.material, scene.garment)
    validate_parameters(parameters)
    validate_timestep(scene.timestep)


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
    if Status.SELF_CONTACT_OVERFLOW in status and trajectory.needed_capacity is not None:
        pairs, faces = (int(value) for value in np.max(np.asarray(trajectory.needed_capacity), axis=0))
        message += f" to at least {pairs}, and self_contact_cell_capacity to at least {faces}"
    if Status.WORLD_EDGE_OVERFLOW in status:
        message += f"; world_edge_capacity {trajectory.positions.shape[1]} always suffices"
    error: type[EslrError] = CapacityError
    if Status.NON_FINITE in status:
        error = NonFiniteError
    elif Status.BODY_TOO_FAST in status:
        error = MotionError
    raise error(message)
