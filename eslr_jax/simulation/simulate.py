"""Simulate from the host: check the scene, simulate in chunks, enlarge buffers, raise errors."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from eslr_jax.config import SimConfig
from eslr_jax.errors import CapacityError, ConfigError, EslrError, MotionError, NonFiniteError, Status
from eslr_jax.fabric.validate import validate_material, validate_timestep
from eslr_jax.mesh.surface import pad_body
from eslr_jax.networks.network import Network, check_network
from eslr_jax.simulation.frame import FrameInput, frame_inputs, without_tracks
from eslr_jax.simulation.program import find_program
from eslr_jax.simulation.rollout import Frames, join_frames, scan_frames
from eslr_jax.simulation.scene import initial_state, slice_tracks
from eslr_jax.simulation.stepper import make_stepper, past_state
from eslr_jax.types import ClothState, Scene, Trajectory

# A limb that moves by 16 cm in a frame takes the cloth in its way along: trousers on a kick to 2 to 9 times their
# length. In four steps the cloth slides off the limb, and keeps within 1.5 to 1.8 times.
_TORN = 1.6  # times its rest length, of a side of a face; of cloth that hangs or is worn, 1.1 to 1.45
_PARTS = 4
_CHUNK = 10  # frames per call of the compiled scan: progress is shown, and scenes of any length share it

Pace = Callable[[int, float], int]
"""Function of iterations per frame and milliseconds that a frame took; returns the next chunk's iterations."""


class Timing(NamedTuple):
    """Where the time of a simulation went."""

    compile_s: float  # that the run waited for programs, also those whose buffers were too small
    frame_ms: float  # mean of the simulated frames


class Simulation(NamedTuple):
    """What came of a scene."""

    trajectory: Trajectory
    timing: Timing
    scene: Scene  # with the buffers that sufficed


def simulate(
    params: Network | None,
    scene: Scene,
    *,
    config: SimConfig | None = None,
    pace: Pace | None = None,
    on_frames: Callable[[int, int], None] = lambda done, total: None,
    is_stopping: Callable[[], bool] = lambda: False,
    done: Trajectory | None = None,
    raises: bool = True,
) -> Simulation:
    """Simulate a scene; check it first, enlarge buffers that are too small, and raise what goes wrong.

    Where the solver tears cloth, the frames around are simulated again in four steps each.

    Args:
        params: A network, of `load_model`; None without one.
        scene: Of `prepare_scene`.
        config: Iterations and tolerance; the solver alone by default.
        pace: Chooses the iterations of every chunk; by default all take the configuration's.
        on_frames: Called with the number of frames done and the number in all.
        is_stopping: Asked after every chunk; the trajectory ends where it answers yes.
        done: First frames of the same scene, simulated before; the trajectory begins with them.
        raises: Raise what went wrong in a frame. False: the trajectory ends with the chunk of its first bad
            frame and keeps its status, see `raise_for_status`.

    Raises:
        ConfigError: `params` is no network, or the fabric, a constant or the timestep is out of
            its physical range.
        CheckpointError: The weights are for another architecture.
        NonFiniteError: Positions became NaN or infinite; the message names the first bad frame.
        CapacityError: A buffer was too small and can't be enlarged.
        MotionError: The body is too fast to follow, or the scene has fewer than two frames.
    """
    config = config or SimConfig()
    check_network(params)
    check_scene(scene)
    done = None if done is None else good_frames(done)
    larger: Scene | None = scene
    passes = []
    while larger is not None:
        scene = larger
        trajectory, spent = _in_chunks(
            jax.device_put(params), scene, config, done, pace, on_frames, is_stopping
        )
        passes.append(spent)
        larger, kept = enlarge_buffers(scene, trajectory.demands), good_frames(trajectory)
        if larger is not None and is_stopping():  # what overflowed is simulated when somebody goes on
            trajectory, larger = kept, None
        done = kept if kept.num_frames > 1 else None  # what fitted stands
    if raises:
        raise_for_status(trajectory)
    compile_s, run_s, frames = map(sum, zip(*passes, strict=True))
    return Simulation(trajectory, Timing(compile_s, 1e3 * run_s / max(frames, 1)), scene)


_join = jax.jit(join_frames)


def _in_chunks(
    params: Network | None,
    scene: Scene,
    config: SimConfig,
    before: Trajectory | None,
    pace: Pace | None,
    on_frames: Callable[[int, int], None],
    is_stopping: Callable[[], bool],
) -> tuple[Trajectory, tuple[float, float, int]]:
    """Simulate a scene a few frames at a time; see `simulate`.

    Returns:
        The trajectory; the seconds that it compiled and ran; the frames that ran, also those beyond the end.
    """
    total, chunk = scene.num_frames - 1, _chunk_of(scene)
    # The last chunk goes on beyond the last frame, and what it simulates there is dropped: all stands still.
    held = np.minimum(np.arange(scene.num_frames + chunk), total)
    shared = share_programs(jax.device_get(scene))  # on the host, where it compiles nothing
    inputs = frame_inputs(slice_tracks(shared, held))
    constant = jax.device_put(_without_frames(shared))

    def part(first: int) -> FrameInput:
        return jax.device_put(jax.tree.map(lambda leaf: leaf[first : first + chunk], inputs))

    def run(constant: Scene, first: int, state: ClothState) -> tuple[ClothState, Frames, float, float]:
        arguments = (params, constant, state, part(first), bound)
        began = time.perf_counter()
        program = find_program(_scan, arguments, config=config).wait()
        compiled = time.perf_counter()
        end, frames = jax.block_until_ready(program(*arguments))
        return end, frames, compiled - began, time.perf_counter() - compiled

    iterations = config.iterations
    start = jax.device_put(scene.initial_state if before is None else state_at(before, scene))
    begin = 0 if before is None else before.num_frames - 1
    if before is not None and begin >= total:  # nothing is left
        return before, (0.0, 0.0, 0)
    parts = scene.substeps
    if before is not None:
        known = before.substeps
        if known is None:  # of `rollout`
            known = np.full(before.num_frames, parts, np.int32)
        before, parts = before.replace(substeps=known), int(known[-1])
    state, done, substeps, seconds, compile_s = start, [], [], 0.0, 0.0
    can_part = config.iterations > 0 and scene.substeps < _PARTS
    for first in range(begin, total, chunk):
        bound = None if pace is None else jnp.int32(iterations)  # all numbers share a program
        end, frames, waited, took = run(constant, first, state)
        was_parted, parts = parts > scene.substeps, scene.substeps
        is_torn = can_part and int(end.status) == Status.OK and _is_torn(scene, frames.positions)
        # Cloth that begins torn comes out of that in one step as well, but not where it tears on.
        if is_torn and (was_parted or not _is_torn(scene, state.position)):
            parted_end, parted, *again = run(constant.replace(substeps=_PARTS), first, state)
            waited, took = waited + again[0], took + again[1]
            if _num_passed(parted) <= _num_passed(frames):  # rather stretched than let through
                end, frames, parts = parted_end, parted, _PARTS
        compile_s, seconds = compile_s + waited, seconds + took
        if pace is not None:
            iterations = pace(iterations, took * 1e3 / chunk)
        count = min(chunk, total - first)
        done.append(jax.tree.map(lambda leaf, count=count: np.asarray(leaf)[:count], frames))
        substeps += [parts] * count
        bad = int(end.first_bad_frame) - int(scene.initial_state.frame)
        is_bad = int(end.status) != Status.OK and bad <= total
        if count == chunk or is_bad:
            state = end
        on_frames(first + count, total)
        if is_bad or is_stopping():
            break
    joined = jax.tree.map(lambda *leaves: np.concatenate(leaves), *done)
    trajectory = _join(start, joined, state)
    trajectory = trajectory.replace(substeps=np.array([scene.substeps, *substeps], np.int32))
    if before is not None:
        bad = trajectory.first_bad_frame
        trajectory = trajectory.replace(first_bad_frame=jnp.where(bad < 0, bad, bad + begin))
        tail = _slice_frames(trajectory, slice(1, None))
        trajectory = _map_frames(lambda first, second: jnp.concatenate([first, second]), tail, before)
    return trajectory, (compile_s, seconds, chunk * len(done))


def _is_torn(scene: Scene, positions: Float[Array, "*frames vertices 3"]) -> bool:
    """Return whether a side of a face is longer than `_TORN` times its rest length (host)."""
    garment = scene.garment
    is_real = np.asarray(garment.rest_areas) > 0
    one, other = np.moveaxis(np.linalg.inv(np.asarray(garment.inverse_rest_frames)[is_real]), -1, 0)
    a, b, c = np.moveaxis(np.asarray(positions)[..., np.asarray(garment.faces)[is_real], :], -2, 0)
    sides = (a - c, one), (b - c, other), (a - b, one - other)
    return any(
        bool(np.any(np.linalg.norm(now, axis=-1) > _TORN * np.linalg.norm(rest, axis=-1)))
        for now, rest in sides
    )


def _num_passed(frames: Frames) -> int:
    passed = frames.reports.is_passed
    return 0 if passed is None else int(np.sum(passed))


def _slice_frames(trajectory: Trajectory, frames: slice) -> Trajectory:
    """Return some frames of a trajectory, with its status."""
    return _map_frames(lambda leaf: jax.device_put(np.asarray(leaf)[frames]), trajectory)


def _map_frames(function: Callable, trajectory: Trajectory, *before: Trajectory) -> Trajectory:
    """Apply a function to what trajectories hold frame by frame; the status is that of the first given.

    Further trajectories are the function's first arguments.
    """
    whole = [one.replace(status=None, first_bad_frame=None) for one in (*before, trajectory)]
    end = {"status": trajectory.status, "first_bad_frame": trajectory.first_bad_frame}
    return jax.tree.map(function, *whole).replace(**end)


def state_at(trajectory: Trajectory, scene: Scene, frame: int = -1) -> ClothState:
    """Return the state of the cloth at a frame of a trajectory without an error, the last by default."""
    frame = range(trajectory.num_frames)[frame]
    # Cut by NumPy: JAX would compile a program for every array.
    position, velocity = np.asarray(trajectory.positions), np.asarray(trajectory.velocities)
    past = scene.initial_state.past
    if past is not None and frame > 0:
        before = initial_state(*jax.device_put((position[frame - 1], velocity[frame - 1])))
        past = past_state(before, jax.device_put(scene.timestep), np.asarray(trajectory.residuals)[frame])
    state = initial_state(*jax.device_put((position[frame], velocity[frame])))
    load = jax.device_put(np.asarray(trajectory.friction_loads)[frame])
    number = scene.initial_state.frame + jnp.int32(frame)
    return state.replace(friction_load=load, frame=number, past=past)


def _scan(
    params: Network | None,
    scene: Scene,
    state: ClothState,
    inputs: FrameInput,
    iterations: Int[Array, ""] | None,
    *,
    config: SimConfig,
) -> tuple[ClothState, Frames]:
    """Simulate one chunk."""
    return scan_frames(make_stepper(params, config, iterations), scene, state, inputs)


def begin_compiling(
    params: Network | None, scene: Scene, config: SimConfig, *, is_paced: bool = False
) -> None:
    """Trace what `simulate` runs, and compile it in a thread; `simulate` waits for it.

    Args:
        params: A network, or None.
        scene: The scene; its initial state may be shapes alone.
        config: As for `simulate`.
        is_paced: Whether `simulate` will get a pace.
    """

    def first_chunk(params: Network | None, scene: Scene) -> tuple:
        inputs = jax.tree.map(lambda leaf: leaf[: _chunk_of(scene)], frame_inputs(scene))
        bound = jnp.int32(0) if is_paced else None
        return params, _without_frames(scene), scene.initial_state, inputs, bound

    find_program(_scan, jax.eval_shape(first_chunk, params, share_programs(scene)), config=config).begin()


def share_programs(scene: Scene) -> Scene:
    """Return a scene whose body is padded, so that other motions run the same program (host)."""
    return scene if scene.body is None else scene.replace(body=pad_body(scene.body))


def _chunk_of(scene: Scene) -> int:
    """Return the number of frames that a call of the compiled scan simulates."""
    return min(_CHUNK, scene.num_frames - 1)


def _without_frames(scene: Scene) -> Scene:
    """Return what all chunks of a scene share."""
    return without_tracks(scene).replace(num_frames=_chunk_of(scene) + 1)


def enlarge_buffers(scene: Scene, demands: Mapping[str, Int[ArrayLike, "*frames"]]) -> Scene | None:
    """Return the scene with larger buffers where frames had too little room in one, else None.

    Args:
        scene: The scene that was simulated.
        demands: Of the trajectory, or of a frame's report.
    """
    larger = []
    for term in scene.terms:
        demand = demands.get(term.name)
        larger.append(None if demand is None else term.enlarged(int(np.max(np.asarray(demand)))))
    if all(one is None for one in larger):
        return None
    pairs = zip(larger, scene.terms, strict=True)
    return scene.replace(terms=tuple(before if one is None else one for one, before in pairs))


def good_frames(trajectory: Trajectory) -> Trajectory:
    """Return the frames before the first bad one; all if none is bad."""
    bad = int(trajectory.first_bad_frame)
    count = trajectory.num_frames if bad < 0 else min(bad, trajectory.num_frames)
    kept = _slice_frames(trajectory, slice(count))
    return kept.replace(status=jnp.int32(Status.OK), first_bad_frame=jnp.int32(-1))


def hold_last(trajectory: Trajectory, num_frames: int) -> Trajectory:
    """Return the good frames of a rollout that ended early, followed by its last one, with its status."""
    good = good_frames(trajectory)
    rest = num_frames - good.num_frames
    if rest <= 0:
        return trajectory
    longer = _map_frames(lambda leaf: np.concatenate([leaf, np.repeat(leaf[-1:], rest, axis=0)]), good)
    return longer.replace(status=trajectory.status, first_bad_frame=trajectory.first_bad_frame)


def last_frames(trajectory: Trajectory, scene: Scene, num_frames: int) -> tuple[Trajectory, Scene]:
    """Return the last frames of a trajectory and of its scene, without those in which the garment settled."""
    first = trajectory.num_frames - num_frames
    if first <= 0:
        return trajectory, scene
    bad = int(trajectory.first_bad_frame)
    kept = _slice_frames(trajectory, slice(first, None))
    kept = kept.replace(first_bad_frame=jnp.int32(bad - first if bad >= 0 else bad))
    state = state_at(trajectory, scene, first)  # it knows its time, which gusts depend on
    return kept, slice_tracks(scene, slice(first, None)).replace(initial_state=state, num_frames=num_frames)


def check_scene(scene: Scene) -> None:
    """Check that a scene has frames to simulate, and that its fabric, constants and timestep are physical.

    Raises:
        MotionError: There are fewer than two frames.
        ConfigError: Names the value and what is accepted.
    """
    if scene.num_frames < 2:
        raise MotionError(f"the scene has {scene.num_frames} frame; give two or more")
    validate_material(scene.material, scene.garment)
    for term in scene.terms:
        term.check()
    validate_timestep(scene.timestep)


def raise_for_status(trajectory: Trajectory, *, settle: int = 0) -> None:
    """Raise the error that a trajectory's status bits stand for.

    Args:
        trajectory: What was simulated.
        settle: Its first frames in which the garment settled; the message counts from the frame behind them.

    Raises:
        NonFiniteError: Positions became NaN or infinite.
        CapacityError: A buffer was too small.
        MotionError: The body moved too fast to follow.
        ConfigError: A frame that was differentiated did not come to rest.
    """
    status = Status(int(jax.device_get(trajectory.status)))
    if status == Status.OK:
        return
    frame = int(trajectory.first_bad_frame) - settle
    when = f"frame {frame}" if frame >= 0 else "before frame 0, while the garment settled"
    message = f"{when}: {status.describe()}"
    if Status.SELF_CONTACT_OVERFLOW in status and trajectory.demands:
        message += (
            f": {max(int(np.max(np.asarray(rows))) for rows in trajectory.demands.values())} rows or more"
        )
    error: type[EslrError] = CapacityError
    if Status.NON_FINITE in status:
        error = NonFiniteError
    elif Status.BODY_TOO_FAST in status:
        error = MotionError
    elif Status.DERIVATIVE_REFUSED in status:
        error = ConfigError
    raise error(message)
