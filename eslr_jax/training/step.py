"""One optimiser step: contacts, graph, model, integration, loss, update, and the trajectory moves on."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Bool, Float, Int

from eslr_jax.config import Criterion, TrainConfig
from eslr_jax.errors import ConfigError, Status
from eslr_jax.networks.apply import graph_inputs, measure_statistics, merge_statistics
from eslr_jax.networks.build import build_graph
from eslr_jax.networks.network import Network
from eslr_jax.networks.normalizer import is_warming_up
from eslr_jax.simulation.frame import BodyStep, FrameInput, frame_problem
from eslr_jax.simulation.stepper import next_state
from eslr_jax.solver.potential import potential_terms
from eslr_jax.terms import Collision, Contact, Ground, hood, scene_terms
from eslr_jax.terms.stretch import principal_stretches
from eslr_jax.terms.term import FrameProblem
from eslr_jax.training.data import FPS, TrainingData
from eslr_jax.training.loss import EnergyTerms, LossReport, physics_loss
from eslr_jax.training.pool import Slot, empty_pool, start_trajectory, turn_round
from eslr_jax.types import ClothState, Normalizer, Obstacle, Scene

_HOOD_HALVING, _HOOD_LEAST = 50_000, 0.01  # optimiser steps; share of the rate that stays (HOOD)
BATCH = "batch"  # axis of the device mesh


@struct.dataclass
class TrainState:
    """All that a run must remember to go on bit by bit."""

    network: Network
    optimizer: Any
    pools: tuple[Slot, ...]  # one per resolution
    key: Array
    step: Int[Array, ""]  # of the optimiser
    skipped: Int[Array, ""]  # updates in a row, the last one included, whose loss or gradient was not finite


def make_schedule(config: TrainConfig) -> optax.Schedule:
    """Return linear warm-up, then a cosine to the final rate; or HOOD's steps, halved every 50,000."""
    if config.schedule == "hood":
        return lambda count: config.learning_rate * (0.5 ** (count // _HOOD_HALVING) + _HOOD_LEAST)
    return optax.warmup_cosine_decay_schedule(
        init_value=0.0,
        peak_value=config.learning_rate,
        warmup_steps=min(config.warmup, config.steps - 1),
        decay_steps=config.steps,
        end_value=config.final_learning_rate,
    )


def make_optimizer(config: TrainConfig) -> optax.GradientTransformation:
    """Return Adam behind a clipped global norm."""
    return optax.chain(optax.clip_by_global_norm(config.clip_norm), optax.adam(make_schedule(config)))


def init_train_state(config: TrainConfig, datasets: tuple[TrainingData, ...]) -> TrainState:
    """Return the state before the first step."""

    @jax.jit
    def first(data: TrainingData) -> tuple[FrameProblem, ClothState]:
        slot = start_trajectory(jax.random.key(config.seed), data, jnp.int32(0), config)
        return slot_problem(slot, data, jnp.int32(0), config), slot.state

    network = config.model.new_network(config.seed, lambda: first(datasets[0]))
    # A batch takes every trajectory at most once.
    slots = [max(config.slots_per_garment, -(-config.batch_size // data.num_garments)) for data in datasets]
    return TrainState(
        network=network,
        optimizer=make_optimizer(config).init(network.params),
        pools=tuple(empty_pool(data, count, config) for data, count in zip(datasets, slots, strict=True)),
        key=jax.random.key_data(jax.random.key(config.seed)),
        step=jnp.int32(0),
        skipped=jnp.int32(0),
    )


def make_mesh(config: TrainConfig) -> Mesh | None:
    """Return all devices as one axis, None for a single one; a ConfigError where they can't share a batch."""
    devices = jax.devices()
    if len(devices) == 1 or (config.batch_size == 1 and jax.process_count() == 1):
        return None
    if config.batch_size % len(devices):
        raise ConfigError(
            f"batch_size = {config.batch_size} does not spread over {len(devices)} devices; "
            "make it a multiple of their number"
        )
    return Mesh(np.array(devices), (BATCH,))


def replicate(tree: Any, mesh: Mesh | None) -> Any:
    """Put a copy of every array on every device of the mesh."""
    return tree if mesh is None else jax.device_put(tree, NamedSharding(mesh, PartitionSpec()))


class _Sample(NamedTuple):
    """What one trajectory's frames contribute."""

    slot: Slot
    metrics: dict[str, Array]
    statistics: dict[str, Normalizer]  # of every frame


def make_train_step(config: TrainConfig, resolution: int, mesh: Mesh | None = None) -> Callable:
    """Return the jitted step on one resolution's pool: (state, data) -> (state, metrics); state is donated.

    `resolution` is the index of its pool and data. A batch is spread over the devices of `mesh`, of `make_mesh`;
    state and data are on all of them.
    """
    everywhere = None if mesh is None else NamedSharding(mesh, PartitionSpec())

    @partial(jax.jit, donate_argnums=0, out_shardings=everywhere)
    def train_step(state: TrainState, data: TrainingData) -> tuple[TrainState, dict[str, Array]]:
        pool = state.pools[resolution]
        count, size = pool.is_done.shape[0], config.batch_size
        turn = state.step // len(state.pools)
        indices = (turn * size + jnp.arange(size)) % count
        key, start_key = jax.random.split(jax.random.wrap_key_data(state.key))
        slots = jax.tree.map(lambda leaf: leaf[indices], pool)
        windows = config.frames // config.through_time
        keys = jax.random.split(start_key, size * windows).reshape(size, windows)
        batch = _Entry(indices, keys, slots)
        run = partial(_batch_gradient, config=config)
        if mesh is not None:
            run = jax.shard_map(
                partial(run, axis=BATCH),
                mesh=mesh,
                in_specs=(PartitionSpec(), PartitionSpec(), PartitionSpec(), PartitionSpec(BATCH)),
                out_specs=(PartitionSpec(), PartitionSpec(BATCH)),
                check_vma=False,
            )
        gradient, samples = run(state.network, data, state.step, batch)
        norm = optax.tree.norm(gradient)
        is_good = jnp.isfinite(norm) & jnp.all(jnp.isfinite(samples.metrics["loss"]))
        # HOOD's normalisers see a hundred graphs before anything is learned on their statistics.
        network = state.network
        is_learning = is_good & ~is_warming_up(network.statistics)
        gradient = jax.tree.map(lambda g: jnp.where(is_good, g, 0.0), gradient)
        updates, optimizer = make_optimizer(config).update(gradient, state.optimizer, network.params)
        trained = optax.apply_updates(network.params, updates)
        seen = network
        for one, frame in np.ndindex(size, config.frames if samples.statistics else 0):
            measured = jax.tree.map(lambda leaf: leaf[one, frame], samples.statistics)  # noqa: B023
            seen = merge_statistics(seen, measured)
        network = network.replace(
            params=_choose(is_learning, trained, network.params),
            statistics=_choose(is_good, seen.statistics, network.statistics),
        )
        pool = jax.tree.map(lambda all_, some: all_.at[indices].set(some), pool, samples.slot)
        metrics = {name: jnp.mean(values) for name, values in samples.metrics.items()}
        metrics |= {"gradient_norm": norm, "skipped": (~is_good).astype(jnp.float32)}
        state = TrainState(
            network=network,
            optimizer=_choose(is_learning, optimizer, state.optimizer),
            pools=(*state.pools[:resolution], pool, *state.pools[resolution + 1 :]),
            key=jax.random.key_data(key),
            step=state.step + 1,
            skipped=jnp.where(is_good, 0, state.skipped + 1),
        )
        return state, metrics

    return train_step


def _choose(is_new: Bool[Array, ""], new: Any, old: Any) -> Any:
    return jax.tree.map(lambda one, other: jnp.where(is_new, one, other), new, old)


class _Entry(NamedTuple):
    """One trajectory of a batch."""

    index: Int[Array, ""]  # in the pool
    key: Array  # one for every window of frames, of the random numbers with which it starts anew
    slot: Slot


def _batch_gradient(
    network: Network,
    data: TrainingData,
    step: Int[Array, ""],
    batch: _Entry,
    *,
    config: TrainConfig,
    axis: str | None = None,
) -> tuple[Any, _Sample]:
    """Return the mean gradient over a batch, or over all devices' parts of it, and every sample's share."""
    run = partial(_sample_gradient, network, data, step, config=config)
    if config.vmap_size == 1:

        def add(total, entry):
            gradient, sample = run(entry)
            return jax.tree.map(jnp.add, total, gradient), sample

        total, samples = jax.lax.scan(add, jax.tree.map(jnp.zeros_like, network.params), batch)
    else:
        gradients, samples = jax.lax.map(run, batch, batch_size=config.vmap_size)
        total = jax.tree.map(partial(jnp.sum, axis=0), gradients)
    if axis is not None:
        total = jax.lax.psum(total, axis)
    return jax.tree.map(lambda leaf: leaf / config.batch_size, total), samples


def _sample_gradient(
    network: Network, data: TrainingData, step: Int[Array, ""], entry: _Entry, *, config: TrainConfig
) -> tuple[Any, _Sample]:
    """Return one trajectory's gradient, the mean over its next frames, and move it on by these.

    A scan over windows of frames: a gradient goes back to its window's start. Where loss or gradient is not
    finite, the trajectory stays as it was, to be looked at, until it starts anew.
    """
    index = entry.index % data.num_garments
    progress = curriculum(config, step * config.frames)

    def window(carry: tuple[Any, Slot], key: Array):
        total, slot = carry
        start = _living_slot(entry._replace(key=key, slot=slot), data, index, config)
        start = turn_round(jax.random.fold_in(key, 1), start, data, config.turn_probability)

        def loss_of(trained):
            slot, frames = start, []
            # Unrolled: a gradient through a scan of one frame costs more.
            for _ in range(config.through_time):
                trial = network.replace(params=trained)
                slot, *frame = _frame(trial, data, index, progress, slot, start, config)
                frames.append(frame)
            losses, metrics, statistics = jax.tree.map(lambda *rows: jnp.stack(rows), *frames)
            return jnp.mean(losses), (slot, metrics, statistics)

        (loss, (moved, metrics, statistics)), gradient = jax.value_and_grad(loss_of, has_aux=True)(
            network.params
        )
        is_good = jnp.isfinite(loss) & jnp.isfinite(optax.tree.norm(gradient))
        slot = _choose(is_good, moved, start.replace(is_done=jnp.ones((), bool)))
        metrics["resets"] = jnp.where(is_good, metrics["resets"], 1.0)
        return (jax.tree.map(jnp.add, total, gradient), slot), (metrics, statistics)

    zeros = jax.tree.map(jnp.zeros_like, network.params)
    (total, slot), (metrics, statistics) = jax.lax.scan(window, (zeros, entry.slot), entry.key)
    gradient = jax.tree.map(lambda leaf: leaf / entry.key.size, total)
    flat = jax.tree.map(lambda leaf: leaf.reshape(config.frames, *leaf.shape[2:]), statistics)
    return gradient, _Sample(slot, jax.tree.map(jnp.mean, metrics), flat)


def _frame(
    network: Network,
    data: TrainingData,
    index: Int[Array, ""],
    progress: Progress,
    slot: Slot,
    start: Slot,
    config: TrainConfig,
) -> tuple[Slot, Float[Array, ""], dict[str, Array], dict[str, Normalizer]]:
    """Return a trajectory moved on by a frame, the frame's loss, what it shows, and statistics of its graph.

    Where the trajectory is done within its window, it waits: the frame is that of the window's start, and its
    loss is zero.
    """
    is_live = ~slot.is_done
    here = _choose(is_live, slot, start)
    problem = slot_problem(here, data, index, config)
    terms_of = potential_terms
    if config.energy_set == "hood":
        terms_of = _hood_terms(here, data, progress.num_samples, config.criterion)
    loss, report = physics_loss(network, problem, here.state, config, terms_of)
    statistics = {}
    if network.statistics:
        inputs = graph_inputs(problem, here.state, network.config.graph)
        graph = build_graph(problem.garment, problem.material, inputs, network.config.graph)
        acceleration = _skinned_acceleration(here, data, index)
        statistics = measure_statistics(network, graph, problem.garment, acceleration)
    moved, is_astray = _advance(here, problem, report, data, config, progress.horizon)
    metrics = {
        "loss": loss,
        "inertial_energy": report.inertial_energy,
        "resets": (is_astray & is_live).astype(jnp.float32),
        **report.energies,
    }
    return _choose(is_live, moved, slot), jnp.where(is_live, loss, 0.0), metrics, statistics


def _living_slot(entry: _Entry, data: TrainingData, index: Int[Array, ""], config: TrainConfig) -> Slot:
    """Return the trajectory, or the start of another where it is done.

    Under `vmap` a condition computes both sides. A start is rare and searches contacts several times, so it is
    left out while no trajectory of the batch is done.
    """

    def living(entry: _Entry, data: TrainingData, index: Array) -> Slot:
        return jax.lax.cond(
            entry.slot.is_done, lambda: start_trajectory(entry.key, data, index, config), lambda: entry.slot
        )

    def living_batch(size, is_batched, *given):
        axes = jax.tree.map(lambda leaf: 0 if leaf else None, tuple(is_batched))
        batched = partial(jax.vmap, in_axes=axes, axis_size=size)
        is_any_done = jnp.any(given[0].slot.is_done)
        slots = jax.lax.cond(is_any_done, batched(living), batched(lambda entry, *_: entry.slot), *given)
        return slots, jax.tree.map(lambda _: True, slots)

    switched = jax.custom_batching.custom_vmap(living)
    switched.def_vmap(living_batch)
    return switched(entry, data, index)


def slot_problem(slot: Slot, data: TrainingData, index: Int[Array, ""], config: TrainConfig) -> FrameProblem:
    """Pose the body at both ends of the frame and state the frame's problem; `index` is the garment's."""
    garment = data.garment(index)
    frames = (slot.frame, data.next_frame(slot.frame, slot.before))
    transforms, later = (data.transforms(k, slot.yaw, slot.shape) for k in frames)
    body = BodyStep(*(data.body(frame, slot.girth, slot.shape) for frame in (transforms, later)))
    searched = Obstacle(data.surface, body.start[None, :0])
    scene = Scene(
        garment=garment,
        material=slot.material,
        timestep=jnp.float32(1.0 / FPS),
        initial_state=slot.state,
        body=searched,
        pin_targets=None,
        num_frames=0,
        terms=scene_terms(Collision(stiffness=config.collision_stiffness), without=(Ground, Contact)),
    )
    inputs = FrameInput(body, data.skinned(index, later, slot.shape))
    return frame_problem(scene, slot.state, inputs)


def _hood_terms(
    slot: Slot, data: TrainingData, num_samples: Int[Array, ""], criterion: Criterion
) -> EnergyTerms:
    """Return HOOD's losses around this frame, with the collision weight of its ramp, or that of its tables."""
    frames = (slot.before, slot.frame, data.next_frame(slot.frame, slot.before))
    bodies = hood.BodyFrames(
        *(data.body(data.transforms(k, slot.yaw, slot.shape), slot.girth, slot.shape) for k in frames),
        data.surface.faces,
    )
    parameters = hood.METRIC_PARAMETERS
    if criterion != "metric":
        parameters = hood.HoodParameters(collision_weight=hood.collision_weight(num_samples))
    state = slot.state

    def terms_of(position, problem: FrameProblem):
        around = hood.HoodProblem(
            current=state.position,
            previous=state.position - problem.timestep * state.velocity,
            bodies=bodies,
            garment=problem.garment,
            material=problem.material,
            timestep=problem.timestep,
            parameters=parameters,
        )
        return hood.hood_terms(position, around, criterion=criterion)

    return terms_of


class Progress(NamedTuple):
    """How far a run is."""

    horizon: Int[Array, ""]  # frames of a trajectory
    num_samples: Int[Array, ""]  # trajectories so far, each counted with its horizon: HOOD's iterations


def curriculum(config: TrainConfig, step: Int[Array, ""] | int) -> Progress:
    """Return how far a run is after some optimiser steps of one frame each; a batch counts as one trajectory.

    The horizon grows by a frame after every `horizon_growth` steps, or with the schedule "hood" after as many
    trajectories, as HOOD's does: there n frames take n times as many steps.
    """
    frames = np.arange(1, config.horizon)
    steps = config.horizon_growth * (frames if config.schedule == "hood" else np.ones_like(frames))
    starts, samples = (  # step at which every horizon begins, and trajectories by then
        jnp.asarray([0, *np.cumsum(counts)], jnp.int32) for counts in (steps, steps // frames)
    )
    horizon = jnp.sum(step >= starts, dtype=jnp.int32)
    now = horizon - 1
    return Progress(horizon, samples[now] + (step - starts[now]) // horizon)


def _advance(
    slot: Slot,
    problem: FrameProblem,
    report: LossReport,
    data: TrainingData,
    config: TrainConfig,
    horizon: Int[Array, ""],
) -> tuple[Slot, Bool[Array, ""]]:
    """Move the trajectory on with the network's prediction, and tell whether it has gone astray.

    It is done then, and at its horizon. A simulated frame takes the solver's guess where that has less energy; a
    trajectory goes on from the prediction all the same, since it is from there that the network has to learn.
    """
    state = next_state(report.onward, problem, slot.state, jnp.int32(0))
    stretch = jnp.max(principal_stretches(report.onward, problem.garment)[0])
    moved = jnp.max(jnp.abs(state.position - slot.state.position))
    is_astray = ~(stretch < config.reset_stretch) | ~(moved < config.reset_displacement)
    is_astray |= (state.status & Status.BODY_TOO_FAST) > 0  # contacts can't follow: no frame for learning
    age, frame = slot.age + 1, data.next_frame(slot.frame, slot.before)
    is_done = is_astray | (age >= horizon)
    return slot.replace(state=state, frame=frame, before=slot.frame, age=age, is_done=is_done), is_astray


def _skinned_acceleration(
    slot: Slot, data: TrainingData, index: Int[Array, ""]
) -> Float[Array, "vertices 3"]:
    """Return the acceleration of the garment carried by the joints [m per frame^2], which HOOD normalises by."""
    frames = (slot.before, slot.frame, data.next_frame(slot.frame, slot.before))
    before, now, later = (
        data.skinned(index, data.transforms(frame, slot.yaw, slot.shape), slot.shape) for frame in frames
    )
    # A trajectory at a clip's first frame has none before it, and begins with the velocity to the next.
    is_turned = (slot.age == 0) & (frames[0] == frames[2])
    return jnp.where(is_turned, 0.0, later - 2.0 * now + before)
