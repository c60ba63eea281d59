"""This package's own simulators, as the hard cases see them."""

from __future__ import annotations

from eslr_jax import Network, SimConfig, Trajectory, simulate
from eslr_jax.simulation.scene import Integrator
from eslr_jax.types import Scene
from hard_cases.case import Simulator


def solver_simulator(
    iterations: int = 200, integrator: Integrator = "euler", *, substeps: int = 1
) -> Simulator:
    """Return the L-BFGS solver as a simulator, see `Simulator`."""

    def run(scene: Scene) -> Trajectory:
        return simulate(None, scene, config=SimConfig(iterations=iterations), raises=False).trajectory

    parts = ["physics", integrator * (integrator != "euler")]
    parts += [f"{substeps} substeps" * (substeps > 1), f"{iterations} iterations"]
    name = ", ".join(filter(None, parts))
    return Simulator(name, run, integrator=integrator, substeps=substeps)


def network_simulator(name: str, network: Network, iterations: int = 0) -> Simulator:
    """Return a network as a simulator, with so many iterations of the solver behind it."""

    def run(scene: Scene) -> Trajectory:
        config = SimConfig(iterations=iterations)
        return simulate(network, scene, config=config, raises=False).trajectory

    label = f"{name}, {iterations} iterations" if iterations else name
    return Simulator(label, run, network.garment_options)
