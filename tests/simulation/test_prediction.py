"""The network's prediction as a start for the solver."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from draped_ball import drifting_ball, square

from eslr_jax import SimConfig, Status, prepare_scene
from eslr_jax.networks.registry import MODELS
from eslr_jax.simulation.frame import first_problem
from eslr_jax.simulation.stepper import make_stepper
from eslr_jax.solver.guess import initial_guess
from eslr_jax.solver.potential import potential
from eslr_jax.terms import CLOTH

CONFIG = MODELS["smooth-small"]


@pytest.fixture(scope="module")
def step_of():
    """The first frame of a sheet in free fall, by weights and by how much the sheet is stretched."""
    scene = prepare_scene(square(6), drifting_ball(3), terms=CLOTH, starts_at_rest=True)

    @jax.jit
    def step(network, stretch):
        state = scene.initial_state.replace(position=scene.initial_state.position * stretch)
        problem = first_problem(scene.replace(initial_state=state))
        guess = initial_guess(problem).position
        after, _ = make_stepper(network, SimConfig(iterations=0))(problem, state)
        return guess, after, jnp.stack([potential(x, problem) for x in (guess, after.position)])

    return step


def change_weights(change):
    network = CONFIG.new_network()
    return network.replace(params=jax.tree.map(change, network.params))


def test_a_prediction_that_climbs_is_not_taken(step_of):
    """In free fall the guess is the optimum: whatever a network adds raises the potential."""
    guess, after, _ = step_of(change_weights(lambda leaf: leaf + 0.5), 1.0)
    np.testing.assert_array_equal(after.position, guess)
    guess, after, energies = step_of(CONFIG.new_network(), 1.1)  # a new one is plain preconditioned descent
    assert energies[1] < energies[0]
    assert np.abs(after.position - guess).max() > 1e-4
    assert int(after.status) == Status.OK


def test_a_prediction_that_is_not_a_number_is_told(step_of):
    _, after, _ = step_of(change_weights(lambda leaf: leaf * jnp.nan), 1.1)
    assert np.isfinite(after.position).all(), "the solver has its own start"
    assert Status.NON_FINITE in Status(int(after.status))
