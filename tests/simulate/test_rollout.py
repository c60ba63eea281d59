import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eslr_jax.config import SimConfig
from eslr_jax.errors import CheckpointError, ConfigError, MotionError, NonFiniteError, Status
from eslr_jax.evaluation.gap import measure_gap, trajectory_states
from eslr_jax.models.registry import MODELS, init_model
from eslr_jax.physics.potential import potential
from eslr_jax.physics.problem import PhysicsParameters
from eslr_jax.rollout import more_room, raise_for_status, rollout, rollout_in_chunks
from eslr_jax.scene import SceneOptions, prepare_scene
from eslr_jax.simulation.scan import simulate_scene
from eslr_jax.simulation.step import frame_problem

PHYSICS = SimConfig(simulator="physics", solver_iterations=200)
SMALL = dataclasses.replace(MODELS["eslr-small"], refinement_steps=2)
NETWORK = SimConfig(simulator="network", model=SMALL)


@pytest.fixture(scope="module")
def scene(tshirt, walk):
    return prepare_scene(tshirt, walk)


@pytest.fixture(scope="module")
def params():
    return init_model(SMALL)


@pytest.fixture(scope="module")
def learned(scene, params):
    return simulate_scene(params, scene, PhysicsParameters(), NETWORK)


@pytest.fixture(scope="module")
def physical(scene):
    return simulate_scene(None, scene, PhysicsParameters(), PHYSICS)


def test_physics_rollout_is_finite_and_dressed(physical, scene):
    from eslr_jax.evaluation.report import trajectory_report

    report = trajectory_report(physical, scene)
    assert report["finite"]
    assert report["num_frames"] == 8
    assert report["max_principal_stretch"] < 1.3
    assert report["penetration_p999_mm"] < 3.0


def test_frame_zero_is_clear_of_the_body(scene):
    from eslr_jax.contact.nearest import find_contacts

    body = scene.body_positions[0]
    contacts = find_contacts(scene.start.position, body, body, scene.surface)
    assert float(contacts.distances.min()) > 0


def test_frame_by_frame_equals_one_scan(scene, params, learned):
    parts, timing = rollout_in_chunks(params, scene, config=NETWORK, chunk=1)
    assert parts.positions.shape == learned.positions.shape
    np.testing.assert_allclose(parts.positions, learned.positions, atol=1e-4)
    assert timing.frame_ms > 0


def test_a_pace_sets_the_iterations_of_the_next_frames(scene, physical):
    asked = []

    def pace(iterations, took_ms):
        asked.append((iterations, took_ms > 0))
        return iterations + 5

    config = dataclasses.replace(PHYSICS, solver_iterations=10)
    paced, _ = rollout_in_chunks(None, scene, config=config, chunk=3, pace=pace)
    assert asked == [(10, True), (15, True), (20, True)]  # seven frames: the last chunk has one
    np.testing.assert_array_equal(paced.iterations, [0, 10, 10, 10, 15, 15, 15, 20])


def test_corrector_lowers_the_residual(scene, params, learned):
    corrected = simulate_scene(
        params, scene, PhysicsParameters(), dataclasses.replace(NETWORK, corrector_steps=30)
    )
    assert float(jnp.median(corrected.residuals[1:])) < 0.2 * float(jnp.median(learned.residuals[1:]))
    assert int(corrected.iterations[1:].max()) == 30


def test_tolerance_stops_early_and_is_kept(scene, physical):
    loose = dataclasses.replace(PHYSICS, tolerance=0.01)
    trajectory = simulate_scene(None, scene, PhysicsParameters(), loose)
    assert int(trajectory.iterations[1:].max()) < int(physical.iterations[1:].min())
    gap = measure_gap(None, trajectory, scene, PhysicsParameters(), loose, iterations=())
    states, inputs = trajectory_states(trajectory, scene, PhysicsParameters())

    def energy(frame):
        state, outside, answer = frame
        arguments = (scene.garment, state, outside, scene.surface, scene.timestep, PhysicsParameters())
        return potential(answer, frame_problem(*arguments), scene.garment, scene.material)

    reached = jax.lax.map(energy, (states, inputs, trajectory.positions[1:]))[1:]
    np.testing.assert_allclose(gap.answer, reached, rtol=1e-5)
    share = (gap.answer - gap.optimum) / (gap.start - gap.optimum)
    assert float(share.max()) <= 0.01


@pytest.mark.slow
def test_gradient_through_time_is_finite(scene):
    plain = dataclasses.replace(MODELS["mgn-small"], refinement_steps=1, latent_size=8)
    params = init_model(plain)
    short = scene.replace(body_positions=scene.body_positions[:3], num_frames=3)

    def height(weights):
        config = SimConfig(model=plain)
        trajectory = simulate_scene({**params, "params": weights}, short, PhysicsParameters(), config)
        return jnp.sum(trajectory.positions[-1, :, 1])

    gradient = jax.tree.leaves(jax.grad(height)(params["params"]))
    assert all(np.isfinite(leaf).all() for leaf in gradient)
    assert any(float(jnp.abs(leaf).max()) > 0 for leaf in gradient)


def test_scene_without_a_body_falls_like_implicit_euler(tshirt, walk):
    options = SceneOptions(has_body=False, start_at_rest=True)
    scene = prepare_scene(tshirt, walk, options=options)
    scene = scene.replace(start=scene.start.replace(position=tshirt.rest_positions))
    assert scene.surface is None
    trajectory = simulate_scene(None, scene, PhysicsParameters(), PHYSICS)
    mass = np.asarray(tshirt.vertex_areas)
    height = (np.asarray(trajectory.positions)[..., 1] * mass).sum(axis=1) / mass.sum()
    frames, timestep = np.arange(8), 1 / 30
    # Backward Euler: velocity after n steps is -g n dt, so the fall is g dt^2 n (n + 1) / 2.
    fall = 9.81 * timestep**2 * frames * (frames + 1) / 2
    np.testing.assert_allclose(height[0] - height, fall, rtol=2e-3, atol=1e-5)


def test_non_finite_positions_raise_with_the_frame(scene):
    broken = scene.replace(body_positions=scene.body_positions.at[4].set(jnp.nan))
    trajectory = simulate_scene(None, broken, PhysicsParameters(), PHYSICS)
    with pytest.raises(NonFiniteError, match="frame 4"):
        raise_for_status(trajectory)


def test_network_without_weights_is_refused(tshirt, walk):
    with pytest.raises(ConfigError, match="load_model"):
        rollout(None, tshirt, walk, config=NETWORK)


def test_weights_of_another_architecture_are_refused(tshirt, walk, params):
    wider = dataclasses.replace(NETWORK, model=dataclasses.replace(SMALL, latent_size=48))
    with pytest.raises(CheckpointError, match="another architecture"):
        rollout(params, tshirt, walk, config=wider)


def test_single_frame_is_refused(tshirt, walk):
    single = walk.replace(positions=walk.positions[:1], joint_transforms=walk.joint_transforms[:1])
    with pytest.raises(MotionError, match="two frames"):
        prepare_scene(tshirt, single)


def test_vmap_equals_one_by_one(scene, params, learned):
    starts = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), scene.start)
    starts = starts.replace(velocity=starts.velocity.at[1].multiply(0.5))

    def run(start):
        return simulate_scene(params, scene.replace(start=start), PhysicsParameters(), NETWORK).positions

    together = jax.vmap(run)(starts)
    slower = run(jax.tree.map(lambda leaf: leaf[1], starts))
    np.testing.assert_allclose(together[0], learned.positions, atol=1e-4)
    np.testing.assert_allclose(together[1], slower, atol=1e-4)


def test_one_trace_per_shape(scene):
    simulate_scene(None, scene, PhysicsParameters(), PHYSICS)
    before = simulate_scene._cache_size()
    faster = scene.replace(start=scene.start.replace(velocity=2 * scene.start.velocity))
    simulate_scene(None, faster, PhysicsParameters(gravity=3.0), PHYSICS)
    assert simulate_scene._cache_size() == before


def test_too_few_world_edges_are_doubled_until_they_suffice(tshirt, walk, params, learned):
    few = dataclasses.replace(NETWORK, model=dataclasses.replace(SMALL, world_edge_capacity=300))
    scene = prepare_scene(tshirt, walk)
    short = simulate_scene(params, scene, PhysicsParameters(), few)
    assert Status.WORLD_EDGE_OVERFLOW in Status(int(short.status))
    more = more_room(short, few)
    assert more.model.world_edge_capacity == 600
    assert more_room(learned, NETWORK) is None
    trajectory = rollout(params, tshirt, walk, config=few)
    assert int(trajectory.status) == 0
    np.testing.assert_allclose(trajectory.positions[:3], learned.positions[:3], atol=1e-4)
