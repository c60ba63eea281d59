"""Scenes share programs, and what is padded for that changes nothing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eslr_jax import (
    SimConfig,
    load_body,
    load_garment,
    load_motion,
    pose_body,
    prepare_scene,
    rollout_scene,
    simulate,
)
from eslr_jax.fabric.materials import COTTON
from eslr_jax.mesh.plate import prepare_plate, warp_directions
from eslr_jax.simulation.shapes import share_shapes
from eslr_jax.types import Threads

GARMENTS = [
    "tshirt",
    "tank",
    "longsleeve",
    "shorts",
    "pants",
    "dress",
    "kneepants",
    "shortsleeve",
    "tightdress",
]
MOTIONS = ["cmu_016_29", "cmu_016_31", "cmu_069_23", "cmu_005_10", "cmu_049_06"]


@pytest.fixture(scope="module")
def woven(small_garment):
    """A fabric with arrays by face: threads, and a plate."""
    warp = warp_directions(small_garment, direction=(0.0, 1.0, 0.0))
    plate = prepare_plate(small_garment, warp, np.broadcast_to([2e-5, 1e-5], (len(warp), 2)))
    stiffness = jnp.broadcast_to(jnp.array([[300.0], [200.0], [50.0], [40.0]]), (4, len(warp)))
    return COTTON.replace(
        plate=jax.tree.map(jnp.asarray, plate), threads=Threads(jnp.asarray(warp), stiffness)
    )


@pytest.mark.parametrize("is_woven", [False, True])
def test_shared_sizes_change_nothing(small_garment, small_poses, woven, is_woven):
    scene = prepare_scene(small_garment, small_poses, material=woven if is_woven else COTTON)
    shared, config = share_shapes(scene), SimConfig(iterations=8)
    assert len(shared.garment.faces) == 2 * len(small_garment.vertex_mask) > len(small_garment.faces)
    plain, padded = (rollout_scene(None, one, config).positions[:3] for one in (scene, shared))
    np.testing.assert_allclose(plain, padded, atol=1e-6)  # later frames grow what rounding differs by
    ours = simulate(None, scene, config=config).trajectory
    np.testing.assert_allclose(plain, ours.positions[:3], atol=1e-6)


@pytest.mark.slow
def test_bundled_garments_and_motions_share_three_programs():
    body, shapes = load_body(), {}
    for motion in MOTIONS:
        poses = pose_body(body, load_motion(motion), num_frames=40)
        for garment in GARMENTS:
            scene = share_shapes(prepare_scene(load_garment(garment), poses, integrator="bdf2"))
            key = jax.tree.structure(scene), *map(np.shape, jax.tree.leaves(scene))
            shapes.setdefault(key, []).append((garment, motion))
    assert len(shapes) <= 3, list(shapes.values())
