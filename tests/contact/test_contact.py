"""The term Contact: nothing passes through anything, by the IPC Toolkit's count in every frame."""

import jax.numpy as jnp
import numpy as np
import pytest
from draped_ball import drifting_ball, square

from eslr_jax import SimConfig, prepare_scene, rollout_scene, scene_terms, simulate
from eslr_jax.pipeline.report.referee import intersecting_pairs
from eslr_jax.terms import Damping


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
    far = poses.replace(positions=poses.positions + jnp.array([[[0.0, 5.0, 0.0]]]))
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


def test_terms_of_one_kind_are_all_kept():
    assert scene_terms(Damping(0.1), Damping(0.2))[-2:] == (Damping(0.1), Damping(0.2))
