"""The network's answer as a start for the solver."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eslr_jax.config import SimConfig
from eslr_jax.errors import Status
from eslr_jax.evaluation.hard_cases.build import make_cloth, make_scene, sheet
from eslr_jax.models.registry import MODELS, init_model
from eslr_jax.physics.potential import potential
from eslr_jax.physics.problem import PhysicsParameters
from eslr_jax.physics.start import solver_start
from eslr_jax.simulation.scan import frame_inputs
from eslr_jax.simulation.step import frame_problem, step

CONFIG = MODELS["smooth-small"]


@pytest.fixture(scope="module")
def answer_of():
    """The first frame of a sheet in free fall, by weights and by how much the sheet is stretched."""
    mesh = sheet(6, 6, (0.1, 0.1))
    scene = make_scene(make_cloth(mesh, {}), mesh[0], 3).scene
    inputs = jax.tree.map(lambda leaf: leaf[0], frame_inputs(scene))

    @jax.jit
    def answer(params, stretch):
        state = scene.start.replace(position=scene.start.position * stretch)
        problem = frame_problem(scene.garment, state, inputs, None, scene.timestep, PhysicsParameters())
        guess = solver_start(problem, scene.garment, scene.material)
        config = SimConfig(model=CONFIG, corrector_steps=0)
        after, _ = step(params, scene.garment, scene.material, problem, state, config)
        energies = [potential(x, problem, scene.garment, scene.material) for x in (guess, after.position)]
        return guess, after, jnp.stack(energies)

    return answer


def change_weights(change):
    params = init_model(CONFIG)
    return {**params, "params": jax.tree.map(change, params["params"])}


def test_passes_that_climb_are_not_taken(answer_of):
    """In free fall the guess is the answer: whatever a network adds raises the potential."""
    guess, after, _ = answer_of(change_weights(lambda leaf: leaf + 0.5), 1.0)
    np.testing.assert_array_equal(after.position, guess)
    guess, after, energies = answer_of(init_model(CONFIG), 1.1)  # a new one is plain preconditioned descent
    assert energies[1] < energies[0]
    assert np.abs(after.position - guess).max() > 1e-4
    assert int(after.status) == Status.OK


def test_an_answer_that_is_no_number_is_told(answer_of):
    _, after, _ = answer_of(change_weights(lambda leaf: leaf * jnp.nan), 1.1)
    assert np.isfinite(after.position).all(), "the solver has its own start"
    assert Status.NON_FINITE in Status(int(after.status))
