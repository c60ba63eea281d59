"""Trajectories of other simulators, which have positions only: add what report and gap need (host)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from eslr_jax.numerics import safe_norm
from eslr_jax.pipeline.report.gap import map_frames, past_states, trajectory_states
from eslr_jax.simulation.frame import frame_inputs, frame_problem
from eslr_jax.simulation.stepper import buffer_demands
from eslr_jax.solver.potential import contact_load, evaluate, potential_terms
from eslr_jax.terms.problem import FrameProblem, weight_norm
from eslr_jax.types import Scene, Trajectory


def foreign_trajectory(
    positions: Float[ArrayLike, "frames vertices 3"],
    scene: Scene,
    *,
    velocities: Float[ArrayLike, "frames vertices 3"] | None = None,
    friction_loads: Float[ArrayLike, "frames vertices"] | None = None,
    iterations: int = 0,
) -> Trajectory:
    """Return the trajectory of another simulator; what it does not tell, such as energies and residuals, is NaN.

    Args:
        positions: Vertex positions [m], shape [frames, vertices, 3].
        scene: The scene that was simulated.
        velocities: Vertex velocities [m/s], shape [frames, vertices, 3]; by default the scene's own in frame 0,
            and then what its integrator makes of the positions.
        friction_loads: Normal forces that load friction [N], shape [frames, vertices]; by default those of our
            contacts.
        iterations: Iterations that it spent on every frame.
    """
    x = jnp.asarray(positions, jnp.float32)
    if velocities is None:
        # Implicit Euler: (x_t - x_{t-1}) / dt. BDF2, from frame 2 on: (3 x_t - 4 x_{t-1} + x_{t-2}) / (2 dt).
        moved = jnp.diff(x, axis=0) / scene.timestep
        if scene.initial_state.past is not None:
            moved = jnp.concatenate([moved[:1], 1.5 * moved[1:] - 0.5 * moved[:-1]])
        v = jnp.concatenate([scene.initial_state.velocity[None], moved])
    else:
        v = jnp.asarray(velocities, jnp.float32)
    loads = find_friction_loads(x, v, scene) if friction_loads is None else jnp.asarray(friction_loads)
    unknown = jnp.full(len(x), jnp.nan)
    return Trajectory(
        positions=x,
        velocities=v,
        friction_loads=loads,
        energies={term.name: unknown for term in scene.terms},
        residuals=unknown,
        gap_bounds=unknown,
        iterations=jnp.full(len(x), iterations, jnp.int32).at[0].set(0),
        status=jnp.int32(0),
        first_bad_frame=jnp.int32(-1),
    )


@jax.jit
def find_friction_loads(
    positions: Float[Array, "frames vertices 3"], velocities: Float[Array, "frames vertices 3"], scene: Scene
) -> Float[Array, "frames vertices"]:
    """Return the friction loads [N] of a trajectory that does not tell them; it is in m and m/s."""

    def advance(load, frame):
        position, velocity, past, reached, inputs = frame
        state = scene.initial_state.replace(
            position=position, velocity=velocity, friction_load=load, past=past
        )
        load = contact_load(reached, frame_problem(scene, state, inputs))
        return load, load

    first = scene.initial_state.friction_load
    past = past_states(positions, velocities, scene)
    frames = (positions[:-1], velocities[:-1], past, positions[1:], frame_inputs(scene))
    _, loads = jax.lax.scan(advance, first, frames)
    return jnp.concatenate([first[None], loads])


@jax.jit
def with_energies(trajectory: Trajectory, scene: Scene) -> Trajectory:
    """Return a trajectory with energies, residuals and pairs of cloth at its positions; frame 0 has none.

    Those of the simulator that it is of are replaced by ours.
    """

    def measure(
        position: Float[Array, "vertices 3"], problem: FrameProblem
    ) -> tuple[dict[str, Array], Float[Array, ""], dict[str, Array]]:
        gradient = evaluate(position, problem).gradient
        residual = safe_norm(gradient.reshape(-1)) / weight_norm(problem)
        return potential_terms(position, problem), residual, buffer_demands(problem)

    states, inputs = trajectory_states(trajectory, scene)
    measured = map_frames(measure, trajectory.positions[1:], states, inputs, scene)
    energies, residuals, demands = jax.tree.map(
        lambda track: jnp.concatenate([jnp.zeros_like(track[:1]), track]), measured
    )
    return trajectory.replace(energies=energies, residuals=residuals, demands=demands)
