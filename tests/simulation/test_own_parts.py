"""An energy and a network of one's own go through the public doors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from draped_ball import drifting_ball, square
from flax import linen as nn
from flax import struct

from eslr_jax import Network, NonFiniteError, SimConfig, plan_scene, prepare_scene, rollout, simulate
from eslr_jax.networks.network import System
from eslr_jax.pipeline.report.report import trajectory_report
from eslr_jax.simulation.frame import first_problem
from eslr_jax.solver.guess import initial_guess
from eslr_jax.terms import CLOTH, Term

DENSITY = 0.20022  # [kg/m2] of cotton


@struct.dataclass
class Push(Term):
    """A steady push along x."""

    name = "push"
    on = "vertices"

    pressure: float  # [N/m^2]

    def corner_energies(self, corners, problem, data):
        return -self.pressure * problem.garment.vertex_areas * (corners[0][0] - problem.position[:, 0])


@struct.dataclass
class Root(Term):
    """An energy without a finite gradient."""

    name = "root"
    on = "vertices"

    def corner_energies(self, corners, problem, data):
        return jnp.sqrt(jnp.maximum(0.0 * corners[0][0], 0.0))


class Nudge(nn.Module, System):
    """Moves the solver's own guess by a learned step."""

    @nn.compact
    def __call__(self, problem, state):
        step = self.param("step", nn.initializers.zeros, (3,))
        return initial_guess(problem).position + jnp.broadcast_to(step, state.position.shape)


def test_an_own_energy_moves_the_cloth_stands_in_the_report_and_is_differentiated():
    garment, poses = square(), drifting_ball(4, speed=0.0)

    options = {"terms": (*CLOTH, Push(1.0))}
    terms, poses = plan_scene(garment, poses, **options)

    def last(pressure):
        windy = (*terms[:-1], Push(pressure))
        trajectory = rollout(None, garment, poses, config=SimConfig(iterations=30), terms=windy)
        return trajectory.positions[-1, :, 0].mean(), trajectory

    slope, trajectory = jax.jit(jax.grad(last, has_aux=True))(jnp.float32(5.0))
    way = np.asarray(trajectory.positions[..., 0]).mean(axis=1)
    # Implicit Euler under a constant force: the speed grows by a dt each frame, and the place by v dt.
    known = np.array([0, 1, 3, 6]) / DENSITY / 30**2
    np.testing.assert_allclose(way - way[0], 5.0 * known, rtol=1e-3, atol=1e-6)
    assert float(slope) == pytest.approx(known[-1], rel=1e-2)
    scene = prepare_scene(garment, poses, terms=CLOTH)
    own = trajectory_report(trajectory, scene)["terms"]["push"]
    area = float(garment.vertex_areas.sum())
    assert own == pytest.approx(-5.0 * area * 5.0 * known[-1] / 3, rel=1e-3)


def test_an_own_energy_without_a_finite_gradient_is_refused():
    """The solver would stay at its guess, at positions that are finite."""

    options = {"terms": (*CLOTH, Root())}
    scene = prepare_scene(square(), drifting_ball(3, speed=0.0), **options)
    with pytest.raises(NonFiniteError, match="forces"):
        simulate(None, scene, config=SimConfig(iterations=5))


@pytest.mark.slow  # training/test_own_network.py rolls one out, and the guide to extensions simulates one
def test_an_own_network_goes_through_both_doors():
    garment, poses, module = square(), drifting_ball(4), Nudge()
    scene = prepare_scene(garment, poses, terms=CLOTH)
    weights = module.init(jax.random.key(0), jax.jit(first_problem)(scene), scene.initial_state)
    config = SimConfig(iterations=0)
    still = simulate(Network(weights, module), scene, config=config).trajectory
    pushing = Network({"params": {"step": jnp.array([1e-3, 0.0, 0.0])}}, module)
    moved = rollout(pushing, garment, poses, config=config, terms=CLOTH)
    way = np.asarray(moved.positions[1] - still.positions[1])
    np.testing.assert_allclose(way, np.broadcast_to([1e-3, 0.0, 0.0], way.shape), atol=1e-6)
