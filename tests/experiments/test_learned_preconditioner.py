"""The preconditioner with learned weights stays symmetric and positive, and without them is the solver's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cloth import make_limb, swing_motion
from learned_preconditioner import MAKERS, Frame, Network, energies, init, inverse_of, places_of

from eslr_jax.body.motion import pose_body
from eslr_jax.physics.guess import initial_guess
from eslr_jax.physics.lbfgs import Stop, minimize
from eslr_jax.physics.potential import potential
from eslr_jax.physics.preconditioner import stretched_stiffness
from eslr_jax.scene.plan import prepare_scene
from eslr_jax.simulation.frame import first_problem


@pytest.fixture(scope="module")
def frame(small_garment) -> Frame:
    """The first frame of a sleeve on a limb that swings, begun a millimetre off."""
    body = make_limb()
    problem = first_problem(prepare_scene(small_garment, pose_body(body, swing_motion(body, 3))))
    start = initial_guess(problem).position
    start = start + 1e-3 * jax.random.normal(jax.random.key(2), start.shape)
    initial = potential(start, problem)
    matrix = stretched_stiffness(problem, start)
    best = minimize(lambda x: potential(x, problem), start, matrix, Stop(200)).value
    return Frame(problem, start, initial, best)


def test_without_weights_it_descends_as_the_solver(frame):
    found = energies(None, None, frame, 10)
    problem = frame.problem
    matrix = stretched_stiffness(problem, frame.start)
    expected = [
        minimize(lambda x: potential(x, problem), frame.start, matrix, Stop(count)).value
        for count in (1, 5, 10)
    ]
    gap = float(frame.initial - frame.best)
    np.testing.assert_allclose(found[jnp.array([1, 5, 10])], np.array(expected), atol=2e-3 * gap)


@pytest.mark.parametrize("name", ["numbers", "network"])
def test_with_any_weights_it_is_symmetric_and_positive(frame, name):
    maker, places = MAKERS[name], places_of(frame)
    params = init(maker, places)
    keys = jax.random.split(jax.random.key(1), 20)
    params = jax.tree.map(lambda leaf: leaf + 0.3 * jax.random.normal(keys[0], leaf.shape), params)
    inverse = inverse_of(maker.apply(params, places), places)
    first, second = (jax.random.normal(key, frame.start.shape) for key in keys[1:3])
    np.testing.assert_allclose(
        jnp.sum(first * inverse(second)), jnp.sum(second * inverse(first)), rtol=1e-3, atol=1e-6
    )
    assert all(
        float(jnp.sum(force * inverse(force))) > 0
        for force in (jax.random.normal(key, frame.start.shape) for key in keys[3:])
    )


def test_the_loss_reaches_every_weight_of_the_network(frame):
    maker = Network()
    params = init(maker, places_of(frame))
    gradient = jax.grad(lambda params: energies(maker, params, frame, 5)[-1])(params)
    for leaf in jax.tree.leaves(gradient):
        assert np.all(np.isfinite(leaf))
        assert np.any(leaf != 0)
