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
from flax import struct

from eslr_jax import (
    ConfigError,
    SimConfig,
    Status,
    load_motion,
    pose_body,
    prepare_scene,
    rollout,
    rollout_scene,
    scene_terms,
)
from eslr_jax.fabric.materials import COTTON
from eslr_jax.mesh.prepare import with_rest_positions
from eslr_jax.networks.registry import MODELS
from eslr_jax.simulation.frame import first_problem
from eslr_jax.simulation.simulate import raise_for_status
from eslr_jax.solver.guess import Start
from eslr_jax.solver.solve import solve, solve_hessian
from eslr_jax.terms import CLOTH, Air, Collision, Damping, Friction, Gravity, Ground, Term
from eslr_jax.types import tree_cast

TIGHT = SimConfig(iterations=400)  # ends where float64 ends
STEP = 1e-2  # of differences; positive numbers change by that share, places by ten micrometres
STEPS = STEP * 0.5 ** np.arange(7.0)
_NOISE = 2e-9  # of a difference quotient: what the solver leaves of the loss, over its steps


@pytest.fixture(autouse=True)
def _float64():
    with jax.enable_x64(True):
        yield


def wide(scene):
    return tree_cast(jax.tree.map(jnp.asarray, scene), jnp.float64)


def small_scene(num_frames, *others, has_body, **options):
    """Sixteen vertices: hanging from two corners, or lying on the ball."""
    pins = None if has_body else np.array([0, 3])
    options |= {
        "terms": scene_terms(*others) if has_body else (*CLOTH, *others),
        "starts_at_rest": not has_body,
    }
    size = 0.08 if has_body else 0.24
    return wide(prepare_scene(square(4, size, is_pinned=pins), drifting_ball(num_frames), **options))


def stiff(scene):
    """Return a scene whose cloth bends little and starts uneven: it has no choice between ways to fold."""
    start, material = scene.initial_state, scene.material
    offset = np.random.default_rng(4).standard_normal(start.position.shape) * 5e-4 + [7e-3, 1e-3, 4e-3]
    return scene.replace(
        initial_state=start.replace(position=start.position + jnp.asarray(offset)),
        material=material.replace(bending_stiffness=20.0 * material.bending_stiffness),
    )


def grounded_scene(num_frames):
    """A sheet that slides over the ground, four millimetres below it at first."""
    scene = small_scene(num_frames, has_body=False)
    start = scene.initial_state
    velocity = start.velocity + jnp.array([[0.5, -0.1, 0.2]])
    ground = jnp.mean(start.position[:, 1]) - 4e-3
    start = start.replace(velocity=velocity)
    terms = (*scene.terms, Ground(ground), Friction())
    return scene.replace(initial_state=start, terms=terms, pin_targets=None)


def windy_scene(num_frames):
    """A hanging sheet of a fabric with damping, in the wind."""
    scene = small_scene(num_frames, has_body=False)
    air = Air(wind=jnp.array([1.0, 0.2, 3.0]))
    return wide(scene.replace(terms=(*scene.terms, air, Damping(jnp.asarray(0.01)))))


# What of a term may be differentiated, and by which name; places move, and positive numbers grow.
OF_TERMS = {
    Gravity: {"acceleration": "gravity"},
    Collision: {"stiffness": "collision_stiffness", "thickness": "collision_thickness"},
    Ground: {"stiffness": "ground_stiffness", "thickness": "ground_thickness"},
    Friction: {"coefficient": "friction_coefficient", "speed": "friction_speed"},
    Air: {"density": "air_density", "normal_drag": "normal_drag", "tangential_drag": "tangential_drag"},
    Damping: {"time": "damping"},
}


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
        "timestep": (),
    }
    for kind, names in OF_TERMS.items():
        shapes |= dict.fromkeys(names.values() if scene.term(kind) is not None else (), ())
    if scene.body is not None:
        shapes["body"] = scene.body.positions.shape
    if scene.term(Ground) is not None:
        shapes["ground"] = ()
    if scene.term(Air) is not None:
        shapes["wind"] = (3,)
    if scene.pin_targets is not None:
        shapes["pins"] = scene.pin_targets.shape
    return {name: jnp.asarray(random.standard_normal(shape)) for name, shape in shapes.items()}


def changed(scene, change):
    """Return the scene with everything changed: factors on positive numbers, offsets of millimetres on places."""
    material = scene.material
    fabric = {
        field.name: getattr(material, field.name) * (1 + change[field.name])
        for field in dataclasses.fields(material)
        if field.name in change
    }
    start = scene.initial_state
    scene = scene.replace(
        material=material.replace(**fabric),
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
    for kind, names in OF_TERMS.items():
        if (term := scene.term(kind)) is not None:
            grown = {field: getattr(term, field) * (1 + change[name]) for field, name in names.items()}
            scene = scene.with_term(term.replace(**grown))
    if "ground" in change:
        ground = scene.term(Ground)
        scene = scene.with_term(ground.replace(height=ground.height + 1e-3 * change["ground"]))
    if "wind" in change:
        air = scene.term(Air)
        scene = scene.with_term(air.replace(wind=air.wind + change["wind"]))
    if "pins" in change:
        scene = scene.replace(pin_targets=scene.pin_targets + 1e-3 * change["pins"])
    return scene


def loss_by_frames(scene):
    """Return the function from changes to a loss after every frame, shape [frames - 1], and the status."""
    weights = jnp.asarray(np.random.default_rng(1).standard_normal(scene.initial_state.position.shape))

    def losses(change):
        trajectory = rollout_scene(None, changed(scene, change), TIGHT)
        places = jnp.sum(weights[None] * trajectory.positions, axis=(1, 2))
        return (places + jnp.cumsum(trajectory.energies["stretch"]))[1:], trajectory.status

    return losses


def check_every_parameter(scene, frames=(-1,), steps=STEPS):
    """Hold gradients of the loss after some of the frames against central difference quotients.

    A large step crosses a change of contact, a small one divides what the solver leaves by little, and which is
    which differs by parameter. So the median of the quotients of all steps counts, and its error is three times
    their median distance from it.
    """
    losses, along = loss_by_frames(scene), directions(scene)
    zeros = jax.tree.map(jnp.zeros_like, along)
    value, gradient = jax.jit(losses), jax.jit(jax.grad(lambda change, frame: losses(change)[0][frame]))
    assert int(value(zeros)[1]) == Status.OK
    found = [gradient(zeros, frame) for frame in frames]
    unseen = []
    for name, direction in along.items():
        quotients = []
        for step in steps:
            up, down = (value({**zeros, name: sign * step * direction})[0] for sign in (1, -1))
            quotients.append(np.asarray(up - down) / (2 * step))
        expected = np.median(quotients, axis=0)
        noise = _NOISE + np.median(np.abs(quotients - expected), axis=0)
        for frame, slopes in zip(frames, found, strict=True):
            slope = float(jnp.sum(slopes[name] * direction))
            assert slope == pytest.approx(float(expected[frame]), rel=1e-3, abs=3 * float(noise[frame])), name
            unseen += [(name, frame)] if abs(slope) < 10 * noise[frame] else []
    assert len(unseen) <= len(along) // 3, unseen  # else the noise hides what is checked


def test_hanging_frames_have_right_gradients_by_every_parameter():
    """After one frame, and after five."""
    check_every_parameter(stiff(small_scene(6, has_body=False)), frames=(0, 4), steps=STEPS[:3])


SCENES = {
    "friction": lambda: small_scene(4, has_body=True),
    "bdf2": lambda: small_scene(4, has_body=True, integrator="bdf2"),
    "substeps": lambda: small_scene(3, has_body=True, integrator="bdf2", substeps=2),
    "air": lambda: windy_scene(4),
    "ground": lambda: grounded_scene(4),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", SCENES)
def test_frames_in_contact_have_right_gradients_by_every_parameter(kind):
    check_every_parameter(stiff(SCENES[kind]()))


@pytest.mark.slow
def test_forward_mode_agrees_with_reverse_mode():
    """By everything at once."""
    scene = stiff(small_scene(3, has_body=True))
    losses, along = loss_by_frames(scene), directions(scene)
    zeros = jax.tree.map(jnp.zeros_like, along)
    _, forward = jax.jit(lambda change: jax.jvp(lambda x: losses(x)[0], (zeros,), (change,)))(along)
    gradient = jax.jit(jax.grad(lambda change: losses(change)[0][-1]))(zeros)
    reverse = sum(float(jnp.sum(gradient[name] * along[name])) for name in along)
    assert float(forward[-1]) == pytest.approx(reverse, rel=1e-6)


@pytest.mark.slow
def test_a_scene_that_is_moved_whole_moves_the_cloth_with_it():
    """Through skinning, the push off the body, contacts and time: by a shift the cloth's derivative is one."""
    garment, poses = wide(square(4, 0.08)), wide(drifting_ball(4))

    def place(shift):
        moved = poses.replace(
            positions=poses.positions + shift[None, None],
            joint_transforms=poses.joint_transforms.at[..., 3].add(shift[None, None]),
        )
        material = tree_cast(COTTON, jnp.float64)
        return rollout(None, garment, moved, config=TIGHT, material=material).positions[-1]

    derivative = jax.jit(jax.jacrev(place))(jnp.zeros(3))
    np.testing.assert_allclose(derivative, np.broadcast_to(np.eye(3), derivative.shape), atol=1e-5)


def test_the_linear_system_reports_what_it_did():
    scene = small_scene(2, has_body=False)
    problem = jax.jit(first_problem)(scene)
    minimum = rollout_scene(None, scene, TIGHT).positions[-1]
    force = jnp.asarray(np.random.default_rng(3).standard_normal(minimum.shape))
    force = jnp.where(scene.garment.is_pinned[:, None], 0.0, force)
    solve_linear = jax.jit(solve_hessian)
    found = solve_linear(problem, minimum, force)
    assert float(found.residual) < 1e-8
    assert not bool(found.is_indefinite)
    crushed = minimum * jnp.array([[0.3, 1.0, 0.3]])  # membrane under compression has negative curvature
    assert bool(solve_linear(problem, crushed, force).is_indefinite)


def test_a_gradient_is_refused_where_the_linear_system_stalls(monkeypatch):
    monkeypatch.setattr("eslr_jax.solver.solve._LINEAR_STOP", {"float64": (1e-12, 2)})
    scene = small_scene(2, has_body=False)
    start = Start(scene.initial_state.position, jnp.zeros(()))

    @jax.jit
    def height(density):
        moved = scene.replace(material=scene.material.replace(density=density))
        return solve(first_problem(moved), start, iterations=100).position[:, 1].mean()

    assert np.isnan(jax.grad(height)(0.2))


@struct.dataclass
class Kink(Term):
    """Pulls every vertex to where it was, as hard from near as from far: no point has a force of zero."""

    name = "kink"
    on = "vertices"

    def corner_energies(self, corners, problem, data):
        return sum(jnp.abs(part - was) for part, was in zip(corners[0], problem.position.T, strict=True))


@pytest.mark.slow
def test_a_frame_without_a_point_of_rest_has_no_derivative_and_says_so():
    scene = small_scene(3, Kink(), has_body=False)

    @jax.jit
    def height(density):
        moved = scene.replace(material=scene.material.replace(density=density))
        trajectory = rollout_scene(None, moved, SimConfig())
        return trajectory.positions[-1, :, 1].mean(), trajectory

    assert int(height(0.2)[1].status) == Status.OK, "motion alone needs no point of rest"
    gradient, trajectory = jax.grad(height, has_aux=True)(0.2)
    assert np.isnan(gradient)
    assert int(trajectory.status) == Status.DERIVATIVE_REFUSED
    with pytest.raises(ConfigError, match="frame 1: the frame did not come to rest"):
        raise_for_status(trajectory)


@pytest.mark.slow
@pytest.mark.parametrize("output", ["subspace", "descent"])
def test_a_refined_prediction_has_right_gradients(output):
    """Through the combination weights too, which training alone may take as constants."""
    model = dataclasses.replace(MODELS["smooth-small"], output=output, refinement_steps=2, latent_size=8)
    network = tree_cast(jax.tree.map(jnp.asarray, model.new_network()), jnp.float64)
    scene = small_scene(2, has_body=False)
    config = SimConfig(iterations=0)
    weights = jnp.asarray(np.random.default_rng(1).standard_normal(scene.initial_state.position.shape))

    @jax.jit
    def loss(factor):
        material = scene.material.replace(lame_mu=scene.material.lame_mu * factor)
        return jnp.sum(
            weights * rollout_scene(network, scene.replace(material=material), config).positions[-1]
        )

    expected = (loss(1.0 + STEP) - loss(1.0 - STEP)) / (2 * STEP)
    assert float(jax.jit(jax.grad(loss))(1.0)) == pytest.approx(float(expected), rel=1e-3)


@pytest.mark.slow
def test_a_prediction_drops_out_where_the_solver_follows_it():
    model = dataclasses.replace(MODELS["smooth-small"], latent_size=8)
    network = tree_cast(jax.tree.map(jnp.asarray, model.new_network()), jnp.float64)
    scene = small_scene(2, has_body=False)
    weights = jnp.asarray(np.random.default_rng(1).standard_normal(scene.initial_state.position.shape))

    def loss(params, density, network):
        start = None if network is None else network.replace(params=params)
        material = scene.material.replace(density=density)
        return jnp.sum(weights * rollout_scene(start, scene.replace(material=material), TIGHT).positions[-1])

    slopes = jax.jit(jax.grad(loss, argnums=(0, 1)))
    by_weights, by_density = slopes(network.params, 0.2, network)
    assert all(float(jnp.abs(leaf).max()) == 0 for leaf in jax.tree.leaves(by_weights))
    assert float(by_density) == pytest.approx(float(slopes(None, 0.2, None)[1]), rel=1e-4)


@pytest.mark.slow
def test_a_hundred_frames_have_right_gradients_in_the_memory_of_their_states():
    scene = small_scene(101, has_body=False)
    weights = jnp.asarray(np.random.default_rng(1).standard_normal(scene.initial_state.position.shape))

    def loss(gravity, pins):
        moved = scene.with_term(Gravity(gravity)).replace(pin_targets=pins, num_frames=len(pins))
        return jnp.sum(weights * rollout_scene(None, moved, TIGHT).positions[-1])

    slope, value = jax.jit(jax.grad(loss)), jax.jit(loss)
    pins = scene.pin_targets
    step = 0.01
    expected = (value(9.81 + step, pins) - value(9.81 - step, pins)) / (2 * step)
    assert float(slope(9.81, pins)) == pytest.approx(float(expected), rel=1e-3)
    short, long = (
        slope.lower(9.81, pins[:count]).compile().memory_analysis().temp_size_in_bytes for count in (11, 101)
    )
    state = weights.nbytes  # of one place per vertex
    assert (long - short) / 90 < 10 * state, (short, long)


@pytest.mark.slow
def test_a_walking_shirt_has_right_gradients_by_fabric_body_and_rest_shape(tshirt, body):
    """Five frames of a walk at 1k vertices; contacts switch within steps ten times as large."""
    with jax.enable_x64(False):
        poses = pose_body(body, load_motion("cmu_016_32"), num_frames=6)
        scene = prepare_scene(tshirt, poses)
    scene = wide(scene)

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
        return jnp.mean(trajectory.positions[-1, :, 0]) + jnp.sum(trajectory.energies["stretch"])

    zeros = dict.fromkeys(("fabric", "body", "rest"), jnp.zeros(()))
    gradient = jax.jit(jax.grad(loss))(zeros)
    for name, step in (("fabric", 1e-4), ("body", 1e-6), ("rest", 1e-5)):
        ends = [float(loss({**zeros, name: jnp.asarray(sign * step)})) for sign in (1.0, -1.0)]
        assert float(gradient[name]) == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=2e-3), name


BY_A_COUNT = """
import jax
from draped_ball import drifting_ball, square
from flax import struct
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
