"""This package's own simulators, as the hard cases see them."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from eslr_jax.config import ModelConfig, SimConfig
from eslr_jax.evaluation.gap import find_friction_loads
from eslr_jax.scene.build import Integrator
from eslr_jax.simulation.simulate import simulate
from eslr_jax.types import PotentialTerms, Scene, Trajectory
from hard_cases.case import Simulator


def solver_simulator(iterations: int = 200, integrator: Integrator = "euler") -> Simulator:
    """Return the L-BFGS solver as a simulator, with so many iterations per frame at most."""

    def run(scene: Scene) -> Trajectory:
        return simulate(None, scene, config=SimConfig(iterations=iterations), raises=False).trajectory

    name = "physics" if integrator == "euler" else f"physics, {integrator}"
    return Simulator(f"{name}, {iterations} iterations", run, integrator=integrator)


def network_simulator(name: str, params: Any, model: ModelConfig, iterations: int = 0) -> Simulator:
    """Return a network as a simulator.

    Args:
        name: What tables call it.
        params: Weights of the network.
        model: Architecture.
        iterations: Iterations of the solver behind it, per frame.
    """

    def run(scene: Scene) -> Trajectory:
        config = SimConfig(model=model, iterations=iterations)
        return simulate(params, scene, config=config, raises=False).trajectory

    options = {"embedding_size": model.embedding_size, "embedding_mode": model.embedding_mode}
    return Simulator(f"{name}, {iterations} iterations" if iterations else name, run, options)


def foreign_trajectory(
    positions: Float[np.ndarray, "frames vertices 3"],
    scene: Scene,
    velocities: Float[np.ndarray, "frames vertices 3"] | None = None,
    iterations: int = 0,
) -> Trajectory:
    """Return the trajectory of another simulator; energies and residuals, which it does not tell, are NaN.

    Args:
        positions: Vertex positions [m], shape [frames, vertices, 3].
        scene: The scene that was simulated.
        velocities: Vertex velocities [m/s], shape [frames, vertices, 3]; by default differences of positions.
        iterations: Iterations that it spent on every frame.
    """
    x = jnp.asarray(positions, jnp.float32)
    if velocities is None:
        moved = jnp.diff(x, axis=0) / scene.timestep
        v = jnp.concatenate([scene.initial_state.velocity[None], moved])
    else:
        v = jnp.asarray(velocities, jnp.float32)
    unknown = jnp.full(len(x), jnp.nan)
    return Trajectory(
        positions=x,
        velocities=v,
        friction_loads=find_friction_loads(x, v, scene),
        terms=PotentialTerms(*[unknown] * len(PotentialTerms._fields)),
        residuals=unknown,
        iterations=jnp.full(len(x), iterations, jnp.int32).at[0].set(0),
        status=jnp.int32(0),
        first_bad_frame=jnp.int32(-1),
    )
