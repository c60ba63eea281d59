"""Motions of a garment share programs."""

import jax
import numpy as np
import pytest

from eslr_jax import load_body, load_garment, load_motion, pose_body, prepare_scene
from eslr_jax.simulation.simulate import _share_programs

MOTIONS = ("cmu_016_22", "cmu_016_25", "cmu_016_29", "cmu_016_31", "cmu_016_47", "cmu_069_23")


@pytest.mark.slow
@pytest.mark.parametrize("garment", ["tshirt", "dress"])
def test_six_motions_of_a_garment_share_two_programs(garment):
    body, shapes = load_body(), {}
    for motion in MOTIONS:
        poses = pose_body(body, load_motion(motion))
        scene = _share_programs(prepare_scene(load_garment(garment), poses, integrator="bdf2"))
        scene = scene.replace(num_frames=2, body=scene.body.replace(positions=scene.body.positions[:2]))
        key = jax.tree.structure(scene), *map(np.shape, jax.tree.leaves(scene))
        shapes.setdefault(key, []).append(motion)
    assert len(shapes) <= 2, list(shapes.values())
