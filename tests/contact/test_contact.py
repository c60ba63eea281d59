"""The term Contact: nothing passes through anything, by the IPC Toolkit's count in every frame."""

import jax.numpy as jnp
import numpy as np
import pytest
from cloth import grid_faces, make_garment
from draped_ball import TIMESTEP, drifting_ball, square

from eslr_jax import SimConfig, prepare_scene, rollout_scene, scene_terms, simulate
from eslr_jax.pipeline.report.crossing import intersecting_pairs
from eslr_jax.terms import Damping, Friction


def assert_nothing_crosses(trajectory, scene):
    faces, surface = np.asarray(scene.garment.faces), np.asarray(scene.body.surface.faces)
    for cloth, body in zip(np.asarray(trajectory.positions), np.asarray(scene.body.positions), strict=True):
        assert len(intersecting_pairs(cloth, faces, body, surface)) == 0


@pytest.mark.parametrize(
    ("speed", "integrator"), [pytest.param(0.3, "euler", marks=pytest.mark.slow), (3.0, "bdf2")]
)
def test_a_ball_passes_through_no_sheet(speed, integrator):
    pytest.importorskip("ipctk")
    poses = drifting_ball(9, speed=speed)
    scene = prepare_scene(square(), poses, integrator=integrator)
    # The sheet falls onto the ball, and hits it at a metre a second.
    falls = scene.initial_state.velocity.at[:, 1].set(-1.0)
    scene = scene.replace(initial_state=scene.initial_state.replace(velocity=falls))
    trajectory = rollout_scene(None, scene, SimConfig())
    assert int(trajectory.status) == 0
    assert not trajectory.is_passed.any()
    assert_nothing_crosses(trajectory, scene)


@pytest.mark.slow
def test_a_shirt_that_starts_folded_through_itself_walks_and_crosses_nothing(tshirt, walk):
    pytest.importorskip("ipctk")
    scene = prepare_scene(tshirt, walk, integrator="bdf2")
    trajectory = rollout_scene(None, scene, SimConfig())
    assert int(trajectory.status) == 0
    assert not trajectory.is_passed.any()
    assert float(trajectory.gap_bounds.max()) <= 0.01
    assert_nothing_crosses(trajectory, scene)


@pytest.mark.slow
def test_a_pinned_sheet_folds_onto_itself_without_crossing():
    pytest.importorskip("ipctk")
    is_pinned = np.zeros(64, bool)
    is_pinned[:8] = True
    garment = square(is_pinned=is_pinned)
    poses = drifting_ball(9, speed=0.0)
    far = poses.replace(positions=poses.positions + jnp.array([[[0.0, -5.0, 0.0]]]))
    scene = prepare_scene(garment, far)
    # The free end is thrown over the pinned one.
    rest = np.asarray(garment.rest_positions)
    thrown = np.zeros_like(rest)
    thrown[:, 1], thrown[:, 0] = 8.0 * (rest[:, 0] - rest[:, 0].min()), -3.0
    thrown[is_pinned] = 0.0
    scene = scene.replace(
        initial_state=scene.initial_state.replace(velocity=jnp.asarray(thrown, jnp.float32))
    )
    trajectory = simulate(None, scene).trajectory  # with tables that suffice
    assert int(trajectory.status) == 0
    assert not trajectory.is_passed.any()
    for cloth in np.asarray(trajectory.positions):
        assert len(intersecting_pairs(cloth, np.asarray(garment.faces))) == 0


def sheet(length, width, height):
    """Return a level sheet of 5 cm squares around the origin, for another one to lie on."""
    x, z = np.meshgrid(*(np.arange(n + 1) * 0.05 - n * 0.025 for n in (length, width)), indexing="ij")
    points = np.stack([x, np.full_like(x, height), z], axis=-1).reshape(-1, 3)
    return points, grid_faces(length + 1, width + 1)


@pytest.mark.parametrize("coefficient", [0.1, 0.6])
def test_a_layer_slides_on_another_by_coulombs_law(coefficient):
    """Both lie on a slope of 25 degrees, whose tangent is .47. The lower one is pinned."""
    frames, slope = 6, np.radians(25.0)
    (lower, faces), (upper, more) = sheet(12, 3, 0.0), sheet(2, 1, 1.9e-3)
    turn = np.array([[np.cos(slope), np.sin(slope), 0], [-np.sin(slope), np.cos(slope), 0], [0, 0, 1]])
    garment = make_garment(
        np.concatenate([lower, upper + np.array([0.012, 0.0, 0.007])]) @ turn.T,
        np.concatenate([faces, more + len(lower)]),
        is_pinned=np.arange(len(lower) + len(upper)) < len(lower),
    )
    poses = drifting_ball(frames, speed=0.0)
    far = poses.replace(positions=poses.positions + jnp.array([[[0.0, -5.0, 0.0]]]))
    scene = prepare_scene(garment, far, terms=scene_terms(Friction(coefficient=coefficient)))
    trajectory = simulate(None, scene).trajectory
    assert not trajectory.is_passed.any()
    ways = (
        np.asarray(trajectory.positions)[:, len(lower) :] - np.asarray(trajectory.positions)[0, len(lower) :]
    )
    slid = (ways @ turn[:, 0]).mean(axis=1)
    pull = 9.81 * (np.sin(slope) - coefficient * np.cos(slope))
    if pull > 0:  # friction takes the force of the frame before, which the first one does not know
        np.testing.assert_allclose(np.diff(slid, 2)[1:] / TIMESTEP**2, pull, rtol=0.05)
    else:
        assert np.abs(slid).max() < 2e-3


def test_terms_of_one_kind_are_all_kept():
    assert scene_terms(Damping(0.1), Damping(0.2))[-2:] == (Damping(0.1), Damping(0.2))
