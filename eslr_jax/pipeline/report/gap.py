"""The optimality gap: how much potential a stepper leaves above the minimum, frame by frame."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from eslr_jax.config import SimConfig
from eslr_jax.networks.network import Network
from eslr_jax.simulation.frame import FrameInput, frame_inputs, frame_problem
from eslr_jax.simulation.scene import initial_state
from eslr_jax.simulation.stepper import find_start, make_stepper, past_state
from eslr_jax.solver.guess import Start
from eslr_jax.solver.lbfgs import unknown_point
from eslr_jax.solver.potential import potential
from eslr_jax.solver.solve import solve
from eslr_jax.terms.term import FrameProblem
from eslr_jax.types import ClothState, PastState, Scene, Trajectory

ITERATIONS = (0, 5, 10, 20, 50, 100)  # of L-BFGS, for comparison
_LEAST_INITIAL_GAP = 1e-9  # [J]
_OPTIMUM_ITERATIONS = 500  # leaves less than 1e-5 of the initial gap; see experiments/tried.md


class OptimalityGap(NamedTuple):
    """Potentials from the same states, one per frame [J]."""

    guess: Float[Array, " frames"]  # at the pushed-out inertial guess
    optimum: Float[Array, " frames"]
    reached: Float[Array, " frames"]  # where the trajectory itself went
    solver: dict[int, Float[Array, " frames"]]  # after so many iterations from the solver's own guess
    # After as many from the network's prediction; empty without one.
    refined: dict[int, Float[Array, " frames"]]

    @property
    def initial_gap(self) -> Float[Array, " frames"]:
        """The gap at the pushed-out inertial guess [J]; a floor keeps shares of it finite."""
        return jnp.maximum(self.guess - self.optimum, _LEAST_INITIAL_GAP)

    def share(self, energy: Float[Array, " frames"]) -> Float[Array, " frames"]:
        """Return the gap of potentials [J], shape [frames], relative to the initial gap."""
        return jnp.maximum(energy - self.optimum, 0.0) / self.initial_gap


def trajectory_states(trajectory: Trajectory, scene: Scene) -> tuple[ClothState, FrameInput]:
    """Return the state before every simulated frame of a trajectory, and the frame's input, stacked."""
    count = trajectory.positions.shape[0] - 1
    still = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count, *leaf.shape)), scene.initial_state)
    states = still.replace(
        position=trajectory.positions[:-1],
        velocity=trajectory.velocities[:-1],
        friction_load=trajectory.friction_loads[:-1],
        frame=scene.initial_state.frame + jnp.arange(count, dtype=jnp.int32),
        past=past_states(trajectory.positions, trajectory.velocities, scene, trajectory.residuals),
    )
    return states, frame_inputs(scene)


def past_states(
    positions: Float[Array, "frames vertices 3"],
    velocities: Float[Array, "frames vertices 3"],
    scene: Scene,
    residuals: Float[Array, " frames"] | None = None,
) -> PastState | None:
    """Return what BDF2 remembers before every simulated frame, stacked; None for implicit Euler.

    Residuals are force norms over weight at the end of every frame. NaN, or None for all frames, stands for
    unknown: such a frame counts as one that ended in its minimum.
    """
    first = scene.initial_state.past
    if first is None:
        return None
    left = jnp.zeros(len(positions) - 2) if residuals is None else residuals[1:-1]
    before = jax.vmap(initial_state)(positions[:-2], velocities[:-2])
    timesteps = jnp.broadcast_to(scene.timestep, left.shape)
    tracks = past_state(before, timesteps, jnp.nan_to_num(left, nan=0.0))
    return jax.tree.map(lambda start, track: jnp.concatenate([start[None], track]), first, tracks)


class GapOptions(NamedTuple):
    """What a gap is compared with; static."""

    every: int = 1  # take every so many frames, from the second on
    iterations: tuple[int, ...] = ITERATIONS  # of the solver from its own guess
    refined: tuple[int, ...] = (0,)  # of the solver from a network's prediction


@partial(jax.jit, static_argnames="options")
def measure_gap(
    network: Network | None,
    trajectory: Trajectory,
    scene: Scene,
    options: GapOptions | None = None,
) -> OptimalityGap:
    """Compare a network, the solver after few iterations, and the optimum, from the states of a trajectory.

    The states are teacher-forced where the trajectory is the optimum's own, on-policy where it is the network's.

    Args:
        network: The network; None compares the solver alone.
        trajectory: Supplies the states.
        scene: Its scene.
        options: What to compare with; static.
    """
    options = options or GapOptions()
    states, inputs = trajectory_states(trajectory, scene)
    taken = jax.tree.map(lambda leaf: leaf[1 :: options.every], (states, inputs, trajectory.positions[1:]))
    counts = [*options.iterations, _OPTIMUM_ITERATIONS]
    rows = [0] * len(counts)  # 0: from the solver's guess, 1: from the network's prediction
    if network is not None:
        counts += [*options.refined, _OPTIMUM_ITERATIONS]
        rows += [1] * (len(counts) - len(rows))

    def measure(frame):
        state, inputs, reached = frame
        problem = frame_problem(scene, state, inputs)
        starts = [find_start(None, problem, state)[0]]
        if network is not None:
            starts.append(find_start(network, problem, state)[0])
        # Stacked, so that the solver is compiled once: all have a previous point, or stand for it themselves.
        stacked = jax.tree.map(
            lambda *leaves: jnp.stack(leaves),
            *(start._replace(previous=start.previous or unknown_point(start.position)) for start in starts),
        )

        def descend(task):
            row, count = task
            start: Start = jax.tree.map(lambda rows: rows[row], stacked)
            return solve(problem, start, iterations=count).value

        values = jax.lax.map(descend, (jnp.array(rows), jnp.array(counts)))
        split = len(options.iterations)
        solver = dict(zip(options.iterations, values[:split], strict=True))
        optimum, refined = values[split], {}
        if network is not None:
            refined = dict(zip(options.refined, values[split + 1 : -1], strict=True))
            # The network may begin in the basin of a deeper minimum than the solver finds.
            optimum = jnp.minimum(optimum, values[-1])
        guess = starts[0].inertial_energy
        return OptimalityGap(guess, optimum, potential(reached, problem), solver, refined)

    return jax.lax.map(measure, taken)


def gap_medians(ends: OptimalityGap, energy: Float[Array, " frames"]) -> dict[str, float]:
    """Return the gap of potentials [J], shape [frames]: in joules, and relative to the initial gap."""
    gap, share = np.asarray(energy - ends.optimum), np.asarray(ends.share(energy))
    return {
        "gap_median_j": float(np.median(gap)),
        "gap_relative_median": float(np.median(share)),
        "gap_mean_j": float(np.mean(gap)),
        "gap_p90_j": float(np.quantile(gap, 0.9)),
    }


@partial(jax.jit, static_argnames=("config", "every"))
def stepped_potentials(
    network: Network | None, trajectory: Trajectory, scene: Scene, config: SimConfig, every: int
) -> Float[Array, " frames"]:
    """Return the potential [J] that a simulator's single frames end with, from the states of a trajectory.

    Frames are taken as `GapOptions.every` says; `every` and the configuration are static.
    """
    frames = jax.tree.map(lambda leaf: leaf[1::every], trajectory_states(trajectory, scene))
    stepper = make_stepper(network, config)

    def measure(frame: tuple[ClothState, FrameInput]) -> Float[Array, ""]:
        state, inputs = frame
        problem = frame_problem(scene, state, inputs)
        return potential(stepper(problem, state)[0].position, problem)

    return jax.lax.map(measure, frames)


def trajectory_gap(trajectory: Trajectory, scene: Scene, *, every: int) -> OptimalityGap:
    """Return potentials of a trajectory's frames: guess, reached and optimum; nothing else is solved.

    The arguments are those of `measure_gap`.
    """
    return measure_gap(None, trajectory, scene, GapOptions(every, (), ()))


def map_frames(
    measure: Callable[[Float[Array, "vertices 3"], FrameProblem], Any], trajectory: Trajectory, scene: Scene
) -> Any:
    """Apply `measure` to where the cloth went in every simulated frame [m], and to the frame's problem."""
    frames = (trajectory.positions[1:], *trajectory_states(trajectory, scene))
    return jax.lax.map(lambda frame: measure(frame[0], frame_problem(scene, *frame[1:])), frames)


@jax.jit
def reached_potentials(
    reached: Float[Array, "frames vertices 3"], states: ClothState, inputs: FrameInput, scene: Scene
) -> Float[Array, " frames"]:
    """Return the potential [J] of anybody's positions at t + 1 [m], from states at t of `trajectory_states`."""
    frames = (reached, states, inputs)
    return jax.lax.map(lambda frame: potential(frame[0], frame_problem(scene, *frame[1:])), frames)
