"""A frame's program multiplies in full precision."""

import jax
import pytest
from draped_ball import drifting_ball, square

from eslr_jax import SimConfig, prepare_scene, scene_terms
from eslr_jax.simulation import frame
from eslr_jax.simulation.stepper import make_stepper
from eslr_jax.terms import Air, Damping, Ground


@pytest.mark.slow
def test_physics_multiplies_in_full_precision():
    """A GPU rounds the operands of other products of float32 to ten bits."""
    options = {
        "terms": scene_terms(
            Ground(is_always=True),
            Air((0.0, 0.0, 0.0)),
            Damping(0.01),
        ),
        "integrator": "bdf2",
    }
    scene = prepare_scene(square(), drifting_ball(13), **options)
    stepper = make_stepper(None, SimConfig(iterations=5))
    inputs = jax.tree.map(lambda leaf: leaf[0], frame.frame_inputs(scene))

    def step(scene, state, inputs):
        return stepper(frame.frame_problem(scene, state, inputs), state)

    program = jax.jit(step).lower(scene, scene.initial_state, inputs).as_text()
    products = [line for line in program.splitlines() if "stablehlo.dot_general" in line]
    assert products
    assert not [line for line in products if "HIGHEST" not in line]
