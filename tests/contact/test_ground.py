"""A level ground: known answers of falling, resting and sliding cloth, and where it is modelled."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from draped_ball import RADIUS, drifting_ball, square
from newton_oracle import minimize_newton

from eslr_jax import SimConfig, plan_scene, prepare_scene, prepare_scenes, rollout_scene, scene_terms
from eslr_jax.fabric.materials import COTTON
from eslr_jax.simulation.frame import first_problem
from eslr_jax.solver.guess import initial_guess
from eslr_jax.solver.solve import solve
from eslr_jax.terms import CLOTH, FAST, Friction, Gravity, Ground

ON = (*CLOTH, Ground(is_always=True), Friction())
FLOOR = -RADIUS  # [m], the lowest point of the ball
FINE = 1 / 240  # [s]


def resting_height(scene):
    """The height at which the barrier carries the weight: 3 k d^2 = density g, d below the thickness [m]."""
    ground, gravity = scene.term(Ground), scene.term(Gravity).acceleration
    return (
        FLOOR + ground.thickness - np.sqrt(float(scene.material.density) * gravity / (3 * ground.stiffness))
    )


def sliding(friction, speed=1.0, num_frames=61):
    """A sheet that lies on the ground and slides along x."""
    terms = (*CLOTH, Ground(is_always=True), Friction(friction))
    scene = prepare_scene(square(), drifting_ball(num_frames), terms=terms)
    position = scene.initial_state.position.at[:, 1].set(resting_height(scene))
    velocity = jnp.zeros_like(position).at[:, 0].set(speed)
    start = scene.initial_state.replace(position=position, velocity=velocity)
    return scene.replace(initial_state=start, timestep=jnp.float32(FINE))


def test_a_falling_sheet_rests_on_the_ground_at_contact_thickness():
    # As many frames as the sheets that slide have: one program.
    scene = prepare_scene(square(), drifting_ball(61), terms=ON)
    assert float(scene.term(Ground).height) == pytest.approx(FLOOR)
    trajectory = rollout_scene(None, scene, SimConfig(iterations=60))
    heights = np.asarray(trajectory.positions)[..., 1]
    assert heights.min() > FLOOR
    np.testing.assert_allclose(heights[-1], resting_height(scene), atol=2e-5)
    assert np.abs(np.asarray(trajectory.velocities[-1])).max() < 1e-3
    assert float(trajectory.energies["collision"][-1]) > 0


def test_friction_stops_a_sliding_sheet_after_its_known_way():
    speed, friction = 1.0, 0.5
    trajectory = rollout_scene(None, sliding(friction), SimConfig(iterations=60))
    way = np.asarray(trajectory.positions)[:, :, 0].mean(axis=1)
    known = speed**2 / (2 * friction * 9.81)
    assert way[-1] - way[0] == pytest.approx(known, rel=0.03)
    assert abs(way[-1] - way[-2]) < 1e-4 * FINE * 240
    slippery = rollout_scene(None, sliding(0.0), SimConfig(iterations=60))
    way = np.asarray(slippery.positions)[:, :, 0].mean(axis=1)
    assert way[-1] - way[0] == pytest.approx(speed * 60 * FINE, rel=1e-4)


@pytest.mark.slow
def test_newton_and_the_solver_find_the_same_minimum_on_the_ground():
    problem = jax.jit(first_problem)(sliding(0.5))
    reference = minimize_newton(problem)
    found = jax.jit(lambda p: solve(p, initial_guess(p), iterations=100))(problem)
    np.testing.assert_allclose(np.asarray(found.position), reference.x, atol=2e-6)


def test_a_ground_is_modelled_where_cloth_could_reach_it():
    poses, high = drifting_ball(), square()
    below = high.rest_positions.at[:, 1].add(-0.08)  # beside the ball, 6 cm above the ground

    def ground(cloth, **options):
        return next(
            (term for term in plan_scene(cloth, poses, **options)[0] if isinstance(term, Ground)), None
        )

    assert ground(high) is None
    assert ground(high.replace(rest_positions=below)).height == pytest.approx(FLOOR)
    assert ground(high.replace(rest_positions=below), terms=scene_terms(without=(Ground,))) is None
    smaller = below.at[:, [0, 2]].multiply(0.3)  # within 2 cm of the ball: it reaches no ground, but may fall
    cloth = high.replace(rest_positions=smaller)
    assert ground(cloth) is not None
    assert ground(cloth.replace(is_pinned=jnp.ones(64, bool))) is None


def test_scenes_of_a_batch_share_the_ground():
    poses = [drifting_ball(), drifting_ball(speed=0.1)]
    high = square()
    low = high.replace(rest_positions=high.rest_positions.at[:, 1].add(-0.08))
    scenes = prepare_scenes([high, low], poses, [COTTON] * 2, terms=FAST)
    assert [float(scene.term(Ground).height) for scene in scenes] == pytest.approx([FLOOR, FLOOR])
