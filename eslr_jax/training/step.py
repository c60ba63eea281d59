"""One optimiser step: contacts, graph, model, integration, loss, update, and the trajectory moves on."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Int

from eslr_jax.config import TrainConfig
from eslr_jax.graph.build import build_graph
from eslr_jax.models.registry import init_model, update_statistics
from eslr_jax.physics.membrane import principal_stretches
from eslr_jax.physics.problem import PhysicsParameters
from eslr_jax.simulate.network import graph_inputs
from eslr_jax.simulate.step import FrameInput, frame_problem, next_state
from eslr_jax.training.data import TrainingData
from eslr_jax.training.loss import LossReport, physics_loss
from eslr_jax.training.pool import Slot, empty_pool, skin, start_trajectory
from eslr_jax.types import Garment

_TIMESTEP = 1 / 30  # [s]


@struct.dataclass
class TrainState:
    """All that a run must remember to go on bit by bit."""

    params: Any
    optimizer: Any
    pools: tuple[Slot, ...]  # one per resolution
    key: Array
    iteration: Int[Array, ""]
    skipped: Int[Array, ""]  # updates with a non-finite loss or gradient


def make_schedule(config: TrainConfig) -> optax.Schedule:
    """Return linear warm-up, then a cosine to the final rate."""
    return optax.warmup_cosine_decay_schedule(
        init_value=0.0,
        peak_value=config.learning_rate,
        warmup_steps=min(config.warmup, config.iterations - 1),
        decay_steps=config.iterations,
        end_value=config.final_learning_rate,
    )


def make_optimizer(config: TrainConfig) -> optax.GradientTransformation:
    """Return Adam behind a clipped global norm."""
    return optax.chain(optax.clip_by_global_norm(config.clip_norm), optax.adam(make_schedule(config)))


def init_train_state(config: TrainConfig, datasets: tuple[TrainingData, ...]) -> TrainState:
    """Return the state before the first step."""
    params = init_model(config.model, config.seed)
    return TrainState(
        params=params,
        optimizer=make_optimizer(config).init(params["params"]),
        pools=tuple(empty_pool(data, config.slots_per_garment) for data in datasets),
        key=jax.random.key_data(jax.random.key(config.seed)),
        iteration=jnp.int32(0),
        skipped=jnp.int32(0),
    )


def make_train_step(config: TrainConfig, resolution: int) -> Callable:
    """Return the jitted step on one resolution's pool: (state, data) -> (state, metrics); state is donated.

    Args:
        config: The run.
        resolution: Index of the pool and of the data that the step works on.
    """

    @partial(jax.jit, donate_argnums=0)
    def train_step(state: TrainState, data: TrainingData) -> tuple[TrainState, dict[str, Array]]:
        pool = state.pools[resolution]
        count = pool.is_done.shape[0]
        index = (state.iteration // len(config.vertices)) % count
        garment = data.garment(index % data.num_garments)
        key = jax.random.wrap_key_data(state.key)
        key, start_key = jax.random.split(key)
        slot = jax.tree.map(lambda leaf: leaf[index], pool)
        slot = jax.lax.cond(
            slot.is_done, lambda: start_trajectory(start_key, data, garment, config), lambda: slot
        )
        problem = _problem(slot, data, garment, config)

        def loss_of(trained):
            weights = {**state.params, "params": trained}
            return physics_loss(weights, garment, slot.material, problem, slot.state, config)

        (loss, report), gradient = jax.value_and_grad(loss_of, has_aux=True)(state.params["params"])
        norm = optax.tree.norm(gradient)
        is_good = jnp.isfinite(loss) & jnp.isfinite(norm)
        gradient = jax.tree.map(lambda g: jnp.where(is_good, g, 0.0), gradient)
        updates, optimizer = make_optimizer(config).update(gradient, state.optimizer, state.params["params"])
        trained = optax.apply_updates(state.params["params"], updates)
        keep = partial(jax.tree.map, lambda new, old: jnp.where(is_good, new, old))
        params = {**state.params, "params": keep(trained, state.params["params"])}
        if config.model.features == "hood" or config.model.output == "acceleration":
            params = _with_statistics(params, slot, problem, garment, config)
        slot = _advance(slot, problem, garment, report, data, config, state.iteration)
        pool = jax.tree.map(lambda all_, one: all_.at[index].set(one), pool, slot)
        metrics = {
            "loss": loss,
            "gradient_norm": norm,
            "start": report.start,
            "resets": slot.is_done.astype(jnp.float32),
            **report.terms._asdict(),
        }
        return (
            TrainState(
                params=params,
                optimizer=keep(optimizer, state.optimizer),
                pools=(*state.pools[:resolution], pool, *state.pools[resolution + 1 :]),
                key=jax.random.key_data(key),
                iteration=state.iteration + 1,
                skipped=state.skipped + ~is_good,
            ),
            metrics,
        )

    return train_step


def _problem(slot: Slot, data: TrainingData, garment: Garment, config: TrainConfig):
    """Pose the body at both ends of the frame and state the frame's problem."""
    transforms, later = (data.transforms(slot.frame + k, slot.yaw) for k in (0, 1))
    frame = FrameInput(data.body(transforms), data.body(later), skin(garment, later))
    parameters = PhysicsParameters(collision_stiffness=config.collision_stiffness)
    problem = frame_problem(garment, slot.state, frame, data.surface, jnp.float32(_TIMESTEP), parameters)
    return jax.lax.stop_gradient(problem)


def _advance(
    slot: Slot,
    problem,
    garment: Garment,
    report: LossReport,
    data: TrainingData,
    config: TrainConfig,
    iteration: Int[Array, ""],
) -> Slot:
    """Move the trajectory on with the network's answer; mark it done where it ends or has gone astray."""
    state = next_state(report.answer, problem, garment, slot.state, jnp.int32(0))
    stretch = jnp.max(principal_stretches(report.answer, garment)[0])
    moved = jnp.max(jnp.abs(report.answer - slot.state.position))
    is_astray = ~(stretch < config.reset_stretch) | ~(moved < config.reset_displacement)
    horizon = jnp.minimum(config.horizon, 1 + iteration // config.horizon_growth)
    age, frame = slot.age + 1, slot.frame + 1
    is_done = is_astray | (age >= horizon) | (data.frames_left[frame] < 1)
    return slot.replace(state=state, frame=frame, age=age, is_done=is_done)


def _with_statistics(params: Any, slot: Slot, problem, garment: Garment, config: TrainConfig) -> Any:
    """Let the normalisers see this frame (HOOD); accelerations are those of the frame's start."""
    inputs = graph_inputs(problem, garment, slot.material, slot.state)
    graph = build_graph(garment, slot.material, inputs, config.model)
    acceleration = None
    if config.model.output == "acceleration":
        guess = problem.pin_targets if problem.pin_targets is not None else problem.inertial_guess
        acceleration = guess - problem.inertial_guess
    return update_statistics(config.model, params, graph, garment, acceleration)
