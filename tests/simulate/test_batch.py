"""Several garments in one batch, on one device and on four."""

import subprocess
import sys

import numpy as np
import pytest

from eslr_jax.assets import load_garment
from eslr_jax.config import SimConfig
from eslr_jax.errors import ConfigError
from eslr_jax.physics.problem import PhysicsParameters
from eslr_jax.rollout import raise_for_status, rollout_batch
from eslr_jax.scene import SceneOptions, prepare_scene, prepare_scenes, shared_surface
from eslr_jax.simulation.batch import simulate_scenes, stack_scenes
from eslr_jax.simulation.scan import simulate_scene

QUICK = SimConfig(simulator="physics", solver_iterations=5)
EARLY = 4  # frames


@pytest.fixture(scope="module")
def garments(tshirt):
    return [tshirt, load_garment("dress"), load_garment("tank")]


@pytest.fixture(scope="module")
def batch(garments, walk):
    return rollout_batch(None, garments, [walk] * 3, config=QUICK)


@pytest.fixture(scope="module")
def alone(tshirt, garments, walk):
    scene = prepare_scene(tshirt, walk, surface=shared_surface(garments, walk))
    return simulate_scene(None, scene, PhysicsParameters(), QUICK)


def test_a_batch_equals_one_by_one_with_its_own_vertex_counts(batch, garments, alone):
    for trajectory, garment in zip(batch, garments, strict=True):
        raise_for_status(trajectory)
        assert trajectory.positions.shape == (8, len(garment.rest_positions), 3)
    # Cloth buckles: rounding grows a hundredfold in a few frames, so only the first are compared.
    np.testing.assert_allclose(batch[0].positions[:EARLY], alone.positions[:EARLY], atol=1e-5)


def test_one_trace_per_bucket(batch, garments, walk):
    """Other garments of the same bucket, and another motion, compile nothing anew."""
    before = simulate_scenes._cache_size()
    moved = walk.replace(positions=walk.positions + 0.01)
    again = rollout_batch(None, garments, [moved] * 3, config=QUICK)
    assert simulate_scenes._cache_size() == before
    assert not np.array_equal(again[1].positions, batch[1].positions)


def test_counts_must_match(garments, walk):
    with pytest.raises(ConfigError, match="3 garments and 1 motions"):
        rollout_batch(None, garments, [walk])


def test_unlike_scenes_are_not_stacked(tshirt, walk):
    scene = prepare_scene(tshirt, walk)
    bare = prepare_scene(tshirt, walk, options=SceneOptions(has_body=False))
    with pytest.raises(ValueError, match="differ in what they model"):
        stack_scenes([scene, bare])


FOUR_DEVICES = """
import sys, jax, numpy as np
from eslr_jax import load_body, load_garment, load_motion, pose_body, rollout_batch
from eslr_jax.config import SimConfig
assert len(jax.devices()) == 4
body = load_body()
poses = pose_body(body, load_motion("cmu_016_32"), num_frames=4)
garments = [load_garment("tshirt")] * 5
config = SimConfig(simulator="physics", solver_iterations=5)
spread = rollout_batch(None, garments, [poses] * 5, config=config, devices=jax.devices())
alone = rollout_batch(None, garments[:1], [poses], config=config)[0]
for trajectory in spread:
    np.testing.assert_allclose(trajectory.positions, alone.positions, atol=1e-5)
"""


@pytest.mark.slow
def test_scenes_spread_over_four_devices_equal_one(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_force_host_platform_device_count=4")
    subprocess.run([sys.executable, "-c", FOUR_DEVICES], check=True, timeout=600)


def test_batch_size_does_not_change_the_answer(tshirt, walk):
    scenes = stack_scenes(prepare_scenes([tshirt, tshirt], [walk, walk]))
    one_by_one, together = (
        simulate_scenes(None, scenes, PhysicsParameters(), QUICK, batch_size=size) for size in (1, 2)
    )
    np.testing.assert_allclose(one_by_one.positions[:, :EARLY], together.positions[:, :EARLY], atol=1e-5)
