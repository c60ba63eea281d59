"""OptimalityOptimality gap: how much potential a stepper leaves on the table, frame by frame."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from eslr_jax.config import SimConfig
from eslr_jax.io.trajectory import TrajectoryFile
from eslr_jax.physics.potential import next_friction_load, potential
from eslr_jax.physics.problem import FrameProblem, PhysicsParameters, start_guess
from eslr_jax.simulate.scan import frame_inputs
from eslr_jax.simulate.step import FrameInput, frame_problem, solve, start_point
from eslr_jax.types import ClothState, Scene, Trajectory

ITERATIONS = (0, 5, 10, 20, 50, 100)  # of L-BFGS, for comparison
_SOLVER = SimConfig(simulator="physics")
_LEAST_INITIAL_GAP = 1e-9  # [J]
_OPTIMUM_ITERATIONS = 500  # leaves less than 1e-5 of the drop; see experiments/solver_convergence.py


class OptimalityGap(NamedTuple):
    """Potentials from the same states, one per frame [J]."""

    start: Float[Array, " frames"]  # at the pushed-out inertial guess
    optimum: Float[Array, " frames"]
    answer: Float[Array, " frames"]  # what the trajectory itself did
    solver: dict[int, Float[Array, " frames"]]  # after so many L-BFGS iterations from where the solver starts
    corrected: dict[int, Float[Array, " frames"]]  # after as many from the model's answer; empty without one

    @property
    def initial_gap(self) -> Float[Array, " frames"]:
        """What a frame has to gain [J]; a floor keeps shares of it finite."""
        return jnp.maximum(self.start - self.optimum, _LEAST_INITIAL_GAP)

    def share(self, energy: Float[Array, " frames"]) -> Float[Array, " frames"]:
        """Return by how much potentials [J] exceed the optimum, relative to the initial gap."""
        return jnp.maximum(energy - self.optimum, 0.0) / self.initial_gap


def trajectory_states(
    trajectory: Trajectory | TrajectoryFile, scene: Scene, parameters: PhysicsParameters
) -> tuple[ClothState, FrameInput]:
    """Return the state before every frame of a trajectory, with its friction load, and the frame's input."""
    inputs = frame_inputs(scene)
    garment = scene.garment

    def advance(load, frame):
        position, velocity, answer, inputs = frame
        state = scene.start.replace(position=position, velocity=velocity, friction_load=load)
        if scene.surface is not None:
            problem = frame_problem(garment, state, inputs, scene.surface, scene.timestep, parameters)
            load = next_friction_load(answer, problem, garment)
        return load, state

    frames = (trajectory.positions[:-1], trajectory.velocities[:-1], trajectory.positions[1:], inputs)
    _, states = jax.lax.scan(advance, scene.start.friction_load, frames)
    return states, inputs


@partial(jax.jit, static_argnames=("config", "every", "iterations", "corrector_steps"))
def measure_gap(
    params: Any,
    trajectory: Trajectory,
    scene: Scene,
    parameters: PhysicsParameters,
    config: SimConfig,
    *,
    every: int = 1,
    iterations: tuple[int, ...] = ITERATIONS,
    corrector_steps: tuple[int, ...] = (0,),
) -> OptimalityGap:
    """Compare a model, the solver after few iterations, and the optimum, from the states of a trajectory.

    Teacher-forced where the trajectory is the optimum's own, on-policy where it is the model's.

    Args:
        params: Weights; None leaves the model out.
        trajectory: Supplies the states.
        scene: The same scene.
        parameters: Physical constants.
        config: With the model's architecture; static.
        every: Take every so many frames, from the second on; static.
        iterations: L-BFGS iterations to compare with; static.
        corrector_steps: L-BFGS iterations behind the model; static.
    """
    states, inputs = trajectory_states(trajectory, scene, parameters)
    taken = jax.tree.map(lambda leaf: leaf[1::every], (states, inputs, trajectory.positions[1:]))
    garment, material = scene.garment, scene.material

    counts = [*iterations, _OPTIMUM_ITERATIONS]
    rows = [0] * len(counts)  # 0: from the start, 1: from the model's answer
    if params is not None:
        counts += [*corrector_steps, _OPTIMUM_ITERATIONS]
        rows += [1] * (len(counts) - len(rows))

    def measure(frame):
        state, inputs, answer = frame
        problem = frame_problem(garment, state, inputs, scene.surface, scene.timestep, parameters)
        starts = [start_point(None, garment, material, problem, state, _SOLVER)]
        if params is not None:
            starts.append(start_point(params, garment, material, problem, state, config))
        # A start that nobody came to is its own earlier point.
        pairs = [(start.point, start.earlier or start.point) for start in starts]
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *pairs)

        def descend(task):
            row, count = task
            start, earlier = jax.tree.map(lambda rows: rows[row], stacked)
            return solve(problem, garment, material, start, iterations=count, earlier=earlier).value

        # In turn, not unrolled: the solver is compiled once.
        values = jax.lax.map(descend, (jnp.array(rows), jnp.array(counts)))
        split = len(iterations)
        solver = dict(zip(iterations, values[:split], strict=True))
        optimum, corrected = values[split], {}
        if params is not None:
            corrected = dict(zip(corrector_steps, values[split + 1 : -1], strict=True))
            # The network may start in the basin of a deeper minimum than the solver finds.
            optimum = jnp.minimum(optimum, values[-1])
        guess, answered = jax.lax.map(
            lambda x: potential(x, problem, garment, material),
            jnp.stack([start_guess(problem, garment), answer]),
        )
        return OptimalityGap(guess, optimum, answered, solver, corrected)

    return jax.lax.map(measure, taken)


def trajectory_gap(
    trajectory: Trajectory, scene: Scene, parameters: PhysicsParameters, *, every: int
) -> OptimalityGap:
    """Return where frames of a trajectory start, end, and could have ended; nothing else is solved.

    The arguments are those of `measure_gap`.
    """
    return measure_gap(
        None, trajectory, scene, parameters, _SOLVER, every=every, iterations=(), corrector_steps=()
    )


def map_answers(
    measure: Callable[[Float[Array, "vertices 3"], FrameProblem], Array],
    answers: Float[Array, "frames vertices 3"],
    states: ClothState,
    inputs: FrameInput,
    scene: Scene,
    parameters: PhysicsParameters,
    config: SimConfig | None = None,
) -> Array:
    """State the problem of every frame and return what `measure` makes of its answer.

    Args:
        measure: Of an answer and its frame's problem.
        answers: Anybody's positions at t + 1 [m].
        states: Cloth at t, of `trajectory_states`.
        inputs: The frames' inputs.
        scene: The scene.
        parameters: Physical constants.
        config: Says whether layers and tips collide; neither does by default.
    """

    def frame(arguments):
        answer, state, inputs = arguments
        problem = frame_problem(
            scene.garment, state, inputs, scene.surface, scene.timestep, parameters, config
        )
        return measure(answer, problem)

    return jax.lax.map(frame, (answers, states, inputs))


@jax.jit
def answer_potentials(
    answers: Float[Array, "frames vertices 3"],
    states: ClothState,
    inputs: FrameInput,
    scene: Scene,
    parameters: PhysicsParameters,
) -> Float[Array, " frames"]:
    """Return the potential [J] of every answer to the frame that starts in the state beside it; `map_answers`."""

    def measure(answer: Float[Array, "vertices 3"], problem: FrameProblem) -> Float[Array, ""]:
        return potential(answer, problem, scene.garment, scene.material)

    return map_answers(measure, answers, states, inputs, scene, parameters)
