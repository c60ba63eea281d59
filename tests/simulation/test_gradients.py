"""Derivatives of solved frames against central differences, in float64."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from draped_ball import drifting_ball, square

from eslr_jax.assets import load_motion
from eslr_jax.body.motion import pose_body
from eslr_jax.config import SimConfig
from eslr_jax.models.registry import MODELS, init_model
from eslr_jax.physics.rest_shape import with_rest_positions
from eslr_jax.physics.solve import solve_hessian
from eslr_jax.scene.plan import SceneOptions, prepare_scene
from eslr_jax.simulation.frame import frame_inputs, frame_problem
from eslr_jax.simulation.rollout import rollout_scene
from eslr_jax.types import tree_cast

TIGHT = SimConfig(iterations=1500)  # ends where float64 ends
STEP = 3e-3  # of central differences; what is changed, changes by a tenth of it or a few micrometres
_NOISE = 2e-6  # of a difference quotient: what the solver leaves of the loss, over two steps


@pytest.fixture(autouse=True)
def _float64():
    # Index arrays are int32, and what JAX counts is int64 here.
    with jax.enable_x64(True), jax.numpy_dtype_promotion("standard"):
        yield


def small_scene(num_frames, *, has_body):
    """Sixteen vertices: hanging from two corners, or lying on the ball."""
    pins = None if has_body else np.array([0, 3])
    options = SceneOptions(has_body=has_body, start_at_rest=not has_body)
    size = 0.08 if has_body else 0.24
    scene = prepare_scene(square(4, size, is_pinned=pins), drifting_ball(num_frames), options=options)
    return tree_cast(jax.tree.map(jnp.asarray, scene), jnp.float64)


def directions(scene, seed=0):
    """A random direction for everything that may be differentiated, as a dictionary of arrays."""
    random = np.random.default_rng(seed)
    garment = scene.garment
    shapes = {
        "density": garment.vertex_areas.shape,
        "lame_mu": garment.rest_areas.shape,
        "lame_lambda": garment.rest_areas.shape,
        "thickness": garment.rest_areas.shape,
        "bending_stiffness": garment.hinge_rest_areas.shape,
        "rest": garment.rest_positions.shape,
        "position": garment.rest_positions.shape,
        "velocity": garment.rest_positions.shape,
        "gravity": (),
        "timestep": (),
    }
    if scene.body is not None:
        names = ("collision_stiffness", "collision_thickness", "friction_coefficient", "friction_speed")
        shapes |= dict.fromkeys(names, ()) | {"body": scene.body.positions.shape}
    if scene.pin_targets is not None:
        shapes["pins"] = scene.pin_targets.shape
    return {name: jnp.asarray(random.standard_normal(shape)) for name, shape in shapes.items()}


def changed(scene, change):
    """Return the scene with everything changed: factors on positive numbers, offsets of millimetres on places."""
    material, constants = scene.material, scene.constants
    fabric = {
        field.name: getattr(material, field.name) * (1 + 0.1 * change[field.name])
        for field in dataclasses.fields(material)
    }
    factors = {
        name: getattr(constants, name) * (1 + 0.1 * change[name])
        for name in vars(constants)
        if name in change
    }
    start = scene.initial_state
    scene = scene.replace(
        material=material.replace(**fabric),
        constants=constants.replace(**factors),
        timestep=scene.timestep * (1 + 0.1 * change["timestep"]),
        garment=with_rest_positions(scene.garment, scene.garment.rest_positions + 1e-3 * change["rest"]),
        initial_state=start.replace(
            position=start.position + 1e-3 * change["position"],
            velocity=start.velocity + 1e-2 * change["velocity"],
        ),
    )
    if "body" in change:
        body = scene.body
        scene = scene.replace(body=body.replace(positions=body.positions + 1e-3 * change["body"]))
    if "pins" in change:
        scene = scene.replace(pin_targets=scene.pin_targets + 1e-3 * change["pins"])
    return scene


def check_every_parameter(scene, tolerance):
    weights = jnp.asarray(np.random.default_rng(1).standard_normal(scene.initial_state.position.shape))

    @jax.jit
    def loss(change):
        trajectory = rollout_scene(None, changed(scene, change), TIGHT)
        return jnp.sum(weights * trajectory.positions[-1]) + jnp.sum(trajectory.terms.stretch)

    along = directions(scene)
    zeros = jax.tree.map(jnp.zeros_like, along)
    gradient = jax.jit(jax.grad(loss))(zeros)
    for name, direction in along.items():
        ends = [float(loss({**zeros, name: sign * STEP * direction})) for sign in (1.0, -1.0)]
        expected = (ends[0] - ends[1]) / (2 * STEP)
        found = float(jnp.sum(gradient[name] * direction))
        assert found == pytest.approx(expected, rel=tolerance, abs=_NOISE), name


def test_one_hanging_frame_has_right_gradients_by_every_parameter():
    check_every_parameter(small_scene(2, has_body=False), 1e-3)


@pytest.mark.slow
def test_one_frame_on_a_body_has_right_gradients_by_every_parameter():
    check_every_parameter(small_scene(2, has_body=True), 1e-3)


@pytest.mark.slow
def test_ten_hanging_frames_have_right_gradients_by_every_parameter():
    check_every_parameter(small_scene(11, has_body=False), 1e-3)


@pytest.mark.slow
def test_forward_mode_agrees_with_reverse_mode():
    scene = small_scene(2, has_body=False)

    def end(gravity):
        constants = scene.constants.replace(gravity=gravity)
        return rollout_scene(None, scene.replace(constants=constants), TIGHT).positions[-1]

    value = jnp.asarray(9.81)
    _, forward = jax.jit(lambda g: jax.jvp(end, (g,), (jnp.ones_like(g),)))(value)
    weights = jnp.asarray(np.random.default_rng(2).standard_normal(forward.shape))
    reverse = jax.jit(jax.grad(lambda g: jnp.sum(weights * end(g))))(value)
    assert float(jnp.sum(weights * forward)) == pytest.approx(float(reverse), rel=1e-6)


def test_the_linear_system_reports_what_it_did():
    scene = small_scene(2, has_body=False)
    inputs = jax.tree.map(lambda leaf: leaf[0], frame_inputs(scene))
    problem = frame_problem(scene, scene.initial_state, inputs)
    minimum = rollout_scene(None, scene, TIGHT).positions[-1]
    force = jnp.asarray(np.random.default_rng(3).standard_normal(minimum.shape))
    force = jnp.where(scene.garment.is_pinned[:, None], 0.0, force)
    found = jax.jit(solve_hessian)(problem, minimum, force)
    assert float(found.residual) < 1e-8
    assert not bool(found.is_indefinite)
    crushed = minimum * jnp.array([[0.3, 1.0, 0.3]])  # membrane under compression has negative curvature
    assert bool(jax.jit(solve_hessian)(problem, crushed, force).is_indefinite)


@pytest.mark.slow
@pytest.mark.parametrize("output", ["subspace", "descent"])
def test_a_refined_prediction_has_right_gradients(output):
    """Through the combination weights too, which training alone may take as constants."""
    model = dataclasses.replace(
        MODELS["smooth-small"], output=output, refinement_steps=2, latent_size=8, seed=0
    )
    params = tree_cast(jax.tree.map(jnp.asarray, init_model(model)), jnp.float64)
    scene = small_scene(2, has_body=False)
    config = SimConfig(model=model, iterations=0)
    weights = jnp.asarray(np.random.default_rng(1).standard_normal(scene.initial_state.position.shape))

    @jax.jit
    def loss(factor):
        material = scene.material.replace(lame_mu=scene.material.lame_mu * factor)
        return jnp.sum(
            weights * rollout_scene(params, scene.replace(material=material), config).positions[-1]
        )

    expected = (loss(1.0 + STEP) - loss(1.0 - STEP)) / (2 * STEP)
    assert float(jax.jit(jax.grad(loss))(1.0)) == pytest.approx(float(expected), rel=1e-3)


@pytest.mark.slow
def test_a_walking_shirt_has_right_gradients_by_fabric_body_and_rest_shape(tshirt, body):
    """Five frames of a walk at 1k vertices; here contacts may switch."""
    with jax.enable_x64(False):
        poses = pose_body(body, load_motion("cmu_016_32"), num_frames=6)
        scene = prepare_scene(tshirt, poses)
    scene = tree_cast(jax.tree.map(jnp.asarray, scene), jnp.float64)

    @jax.jit
    def loss(change):
        material, garment, surroundings = scene.material, scene.garment, scene.body
        stiffer = material.replace(
            lame_mu=material.lame_mu * (1 + change["fabric"]),
            lame_lambda=material.lame_lambda * (1 + change["fabric"]),
            density=material.density * (1 - change["fabric"]),
        )
        shift = change["body"] * jnp.array([[[1.0, 0.0, 0.0]]])
        moved = scene.replace(
            material=stiffer,
            garment=with_rest_positions(garment, garment.rest_positions * (1 + change["rest"])),
            body=surroundings.replace(positions=surroundings.positions + shift),
        )
        trajectory = rollout_scene(None, moved, SimConfig(iterations=3000))
        # Of the whole shirt: single vertices in a fold leave the linear range at once.
        return jnp.mean(trajectory.positions[-1, :, 0]) + jnp.sum(trajectory.terms.stretch)

    zeros = dict.fromkeys(("fabric", "body", "rest"), jnp.zeros(()))
    gradient = jax.jit(jax.grad(loss))(zeros)
    for name, step in (("fabric", 1e-3), ("body", 1e-5), ("rest", 1e-4)):
        ends = [float(loss({**zeros, name: jnp.asarray(sign * step)})) for sign in (1.0, -1.0)]
        assert float(gradient[name]) == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=0.02), name


BY_A_COUNT = """
import jax
from draped_ball import drifting_ball, square
from eslr_jax import SimConfig, prepare_scene
from eslr_jax.errors import ConfigError
from eslr_jax.simulation.rollout import rollout_scene
scene = prepare_scene(square(4), drifting_ball(2))
try:
    jax.grad(lambda count: rollout_scene(None, scene, SimConfig(), count).positions.sum())(5.0)
except ConfigError as error:
    print(error)
"""


@pytest.mark.slow
def test_a_derivative_by_a_count_is_refused():
    """In a process of its own: here the annotations are checked, and refuse it before."""
    command = [sys.executable, "-c", BY_A_COUNT]
    result = subprocess.run(
        command, capture_output=True, text=True, cwd=Path(__file__).parents[1], check=True
    )
    assert result.stdout == "iterations are float32; give a whole number, which has no derivative\n"
