"""The network's answer as a start for the solver."""

import jax
import jax.numpy as jnp
import numpy as np

from eslr_jax.config import SimConfig
from eslr_jax.evaluation.hard_cases.build import make_cloth, make_scene, sheet
from eslr_jax.models.registry import MODELS, init_model
from eslr_jax.physics.potential import potential
from eslr_jax.physics.problem import PhysicsParameters
from eslr_jax.physics.start import solver_start
from eslr_jax.simulate.scan import frame_inputs
from eslr_jax.simulate.step import frame_problem, step

CONFIG = MODELS["smooth-small"]


def test_passes_that_climb_are_not_taken():
    """In free fall the guess is the answer: whatever a network adds raises the potential."""
    mesh = sheet(6, 6, (0.1, 0.1))
    scene = make_scene(make_cloth(mesh, {}), mesh[0], 3).scene
    inputs = jax.tree.map(lambda leaf: leaf[0], frame_inputs(scene))

    @jax.jit
    def answer_of(params, stretch):
        state = scene.start.replace(position=scene.start.position * stretch)
        problem = frame_problem(scene.garment, state, inputs, None, scene.timestep, PhysicsParameters())
        guess = solver_start(problem, scene.garment, scene.material)
        config = SimConfig(model=CONFIG, corrector_steps=0)
        answer = step(params, scene.garment, scene.material, problem, state, config)[0].position
        energies = [potential(x, problem, scene.garment, scene.material) for x in (guess, answer)]
        return guess, answer, jnp.stack(energies)

    params = init_model(CONFIG)
    wild = jax.tree.map(lambda leaf: leaf + 0.5, params["params"])
    guess, answer, _ = answer_of({**params, "params": wild}, 1.0)
    np.testing.assert_array_equal(answer, guess)
    guess, answer, energies = answer_of(params, 1.1)  # a new network is plain preconditioned descent
    assert energies[1] < energies[0]
    assert np.abs(answer - guess).max() > 1e-4
