"""What a scene leaves out must be what it does not need."""

import numpy as np
import pytest
from eslr_jax.simulation.scan import simulate_scene

from eslr_jax.assets import load_garment, load_motion
from eslr_jax.body.motion import pose_body
from eslr_jax.config import SimConfig
from eslr_jax.contact.nearest import find_contacts
from eslr_jax.geometry.closest import closest_points
from eslr_jax.physics.problem import PhysicsParameters
from eslr_jax.scene import prepare_scene


@pytest.mark.parametrize("name", ["dress", "tshirt"])
def test_cloth_touches_nothing_else_than_what_was_searched(body, name):
    """The hem of a dress swings farther from where it is skinned to than a T-shirt does."""
    poses = pose_body(body, load_motion("cmu_016_32"), num_frames=31)
    scene = prepare_scene(load_garment(name), poses)
    config = SimConfig(simulator="physics", solver_iterations=40)
    trajectory = simulate_scene(None, scene, PhysicsParameters(), config)
    solid = np.asarray(poses.faces)[np.asarray(poses.is_obstacle)]
    for frame in (10, 20, 30):
        cloth, reached = trajectory.positions[frame], scene.body_positions[frame]
        contacts = find_contacts(cloth, reached, reached, scene.surface)
        corners = np.asarray(poses.positions[frame])
        face, weights = closest_points(np.asarray(cloth), corners, solid)
        nearest = np.einsum("vc,vcx->vx", weights, corners[solid[face]])
        touches = np.linalg.norm(nearest - np.asarray(cloth), axis=1) < 0.02
        assert touches.sum() > 50
        assert np.mean(contacts.is_near[touches]) > 0.999
        np.testing.assert_array_less(-0.005, np.where(contacts.is_near, contacts.distances, 0.0))
