"""Several garments in one batch, on one device and on four."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from draped_ball import drifting_ball, square

from eslr_jax import (
    ConfigError,
    SimConfig,
    load_body,
    load_garment,
    load_motion,
    pose_body,
    prepare_scene,
    prepare_scenes,
    rollout_scene,
    scene_terms,
    simulate,
    simulate_batch,
)
from eslr_jax.fabric.materials import COTTON
from eslr_jax.mesh.coarse import add_coarse_edges
from eslr_jax.mesh.prepare import with_rest_positions
from eslr_jax.simulation.batch import _group_alike, rollout_scenes, simulate_scenes, stack_scenes
from eslr_jax.simulation.plan import shared_surface
from eslr_jax.simulation.simulate import raise_for_status
from eslr_jax.terms import CLOTH, FAST, Damping, Ground

QUICK = SimConfig(iterations=5)
CLIPS = (
    "cmu_016_23", "cmu_016_31", "cmu_016_32", "cmu_047_01", "cmu_069_01", "cmu_069_21", "deepmimic_punch",
    "deepmimic_run",
)  # fmt: skip
FABRICS = [COTTON, COTTON.replace(density=np.float32(0.4)), COTTON]


@pytest.fixture(scope="module")
def garments():
    return [square(8), square(8, 0.2), square(8)]  # of one bucket: one program


@pytest.fixture(scope="module")
def poses():
    return drifting_ball(4)


@pytest.fixture(scope="module")
def batch(garments, poses):
    return simulate_batch(None, garments, [poses] * 3, config=QUICK, material=FABRICS, terms=FAST)


def test_a_batch_equals_one_by_one_with_its_own_vertices(batch, garments, poses):
    surface = shared_surface(garments, poses)
    np.testing.assert_array_equal(batch[0].positions, batch[2].positions)
    for trajectory in batch:
        raise_for_status(trajectory)
    padded = 1
    scene = prepare_scene(garments[padded], poses, material=FABRICS[padded], terms=FAST, surface=surface)
    alone = rollout_scene(None, scene, QUICK)
    assert batch[padded].positions.shape == alone.positions.shape
    np.testing.assert_allclose(batch[padded].positions, alone.positions, atol=1e-5)
    # Loads are 3 k a d^2 [N]: two micrometres, by which two programs differ, are a hundredth of them.
    np.testing.assert_allclose(batch[padded].friction_loads, alone.friction_loads, atol=1e-3)


def test_scenes_of_any_shape_come_back_in_order(garments):
    """Those of one shape go together; that this is as alone is shown above."""
    scenes = [prepare_scene(garments[0], drifting_ball(count), terms=CLOTH) for count in (3, 2, 3)]
    start = scenes[2].initial_state
    scenes[2] = scenes[2].replace(initial_state=start.replace(position=start.position + 1.0))
    found = simulate_scenes(None, scenes, config=QUICK, batch_size=1)
    assert [one.num_frames for one in found] == [3, 2, 3]
    for one, scene in zip(found, scenes, strict=True):
        np.testing.assert_array_equal(one.positions[0], scene.initial_state.position)
    np.testing.assert_allclose(found[1].positions, found[0].positions[:2], atol=1e-6)


def test_bundled_garments_form_a_group(poses):
    assert _group_alike([load_garment("tshirt"), load_garment("shorts")], [poses] * 2) == [[0, 1]]


@pytest.mark.slow
def test_three_bundled_garments_on_eight_motions_equal_one_by_one():
    """Each ends in a minimum; where a fold tips over by rounding, it is another one, as deep to a hundredth."""
    cloths, body = [load_garment(name) for name in ("tshirt", "tank", "dress")], load_body()
    worn = [cloths[row % 3] for row in range(8)]
    motions = [pose_body(body, load_motion(clip), num_frames=2) for clip in CLIPS]
    config, same = SimConfig(iterations=1000), []
    for row, trajectory in enumerate(simulate_batch(None, worn, motions, config=config)):
        raise_for_status(trajectory)
        alone = simulate(None, prepare_scene(worn[row], motions[row]), config=config).trajectory
        gap = max(alone.gap_bounds[1], trajectory.gap_bounds[1])  # where rounding ends the iterations
        assert gap < 3e-3
        depth, depth_alone = (sum(track[1] for track in one.energies.values()) for one in (trajectory, alone))
        np.testing.assert_allclose(depth, depth_alone, rtol=1e-2)
        away = np.linalg.norm(np.asarray(trajectory.positions[1] - alone.positions[1]), axis=1)
        assert np.median(away) < 2e-4
        # Near a minimum the energy is quadratic: 0.1 mm at a gap of 1e-5.
        same.append(away.max() < 1e-4 * np.sqrt(gap / 1e-5))
    assert sum(same) >= 4, same


def test_another_motion_compiles_nothing_anew(batch, garments, poses):
    before = rollout_scenes._cache_size()
    moved = poses.replace(positions=poses.positions + 0.01)
    again = simulate_batch(None, garments, [moved] * 3, config=QUICK, material=FABRICS, terms=FAST)
    assert rollout_scenes._cache_size() == before
    assert not np.array_equal(again[1].positions, batch[1].positions)


def test_bodies_that_differ_in_what_is_an_obstacle_are_searched_apart(garments, poses):
    part = poses.replace(is_obstacle=np.asarray(poses.is_obstacle) & (np.arange(len(poses.faces)) > 0))
    motions = [poses, poses, part]
    assert _group_alike(garments[:1] * 3, motions) == [[0, 1], [2]]
    taller = poses.replace(rest_positions=1.5 * np.asarray(poses.rest_positions))
    assert _group_alike(garments[:1] * 3, [poses, taller, poses]) == [[0, 2], [1]]


def test_garments_that_padding_leaves_unlike_are_simulated_apart(garments, poses):
    plain = garments[0]
    count = len(plain.vertex_mask)
    one_joint = plain.replace(skin_weights=np.ones((count, 1)), skin_indices=np.zeros((count, 1), np.int32))
    long = plain.replace(geodesic_embedding=np.zeros((count, plain.geodesic_embedding.shape[1] + 1)))
    recut = with_rest_positions(plain, plain.rest_positions)
    kinds = [plain, one_joint, long, add_coarse_edges(plain), recut]
    assert _group_alike(kinds + kinds, [poses] * 10) == [[i, i + 5] for i in range(5)]


def test_counts_must_match(garments, poses):
    with pytest.raises(ConfigError, match="3 garments, 1 motions and 3 fabrics"):
        simulate_batch(None, garments, [poses])
    with pytest.raises(ConfigError, match="3 garments, 3 motions and 2 fabrics"):
        simulate_batch(None, garments, [poses] * 3, material=FABRICS[:2])


def test_fabrics_that_lie_on_one_mesh_are_refused(garments, poses):
    by_face = COTTON.replace(lame_mu=np.full(garments[0].faces.shape[0], 2e4, np.float32))
    with pytest.raises(ConfigError, match=r"one isotropic fabric for each garment.*one by one"):
        simulate_batch(None, garments[:1], [poses], material=by_face)


@pytest.mark.slow
def test_all_that_a_scene_can_model_maps_over_scenes(poses):
    garments = [square(8), square(7, is_pinned=np.array([0]))]
    terms = scene_terms(Ground(is_always=True), Damping(0.002))
    scenes = prepare_scenes(garments, [poses] * 2, FABRICS[:2], terms=terms, integrator="bdf2", substeps=2)
    together = rollout_scenes(None, stack_scenes(scenes), QUICK, batch_size=2)
    for row, scene in enumerate(scenes):
        alone = rollout_scene(None, scene, QUICK)
        np.testing.assert_allclose(together.positions[row], alone.positions, atol=2e-5)


def test_unlike_scenes_are_not_stacked(garments, poses):
    scene = prepare_scene(garments[0], poses, terms=CLOTH)
    with pytest.raises(ValueError, match="differ in what they model"):
        stack_scenes([scene, scene.replace(terms=CLOTH[:-1])])


FOUR_DEVICES = """
import jax, numpy as np
from draped_ball import drifting_ball, square
from eslr_jax import SimConfig, simulate_batch
assert len(jax.devices()) == 4
poses, garments, config = drifting_ball(4), [square()] * 5, SimConfig(iterations=5)
spread = simulate_batch(None, garments, [poses] * 5, config=config, devices=jax.devices())
alone = simulate_batch(None, garments[:1], [poses], config=config, devices=jax.devices()[2:3])[0]
assert alone.positions.devices() == {jax.devices()[2]}
alone = jax.device_get(alone)
for trajectory in spread:
    np.testing.assert_allclose(trajectory.positions, alone.positions, atol=1e-5)
"""


@pytest.mark.slow
def test_scenes_spread_over_four_devices_equal_one(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_force_host_platform_device_count=4")
    tests = Path(__file__).parents[1]
    subprocess.run([sys.executable, "-c", FOUR_DEVICES], check=True, timeout=600, cwd=tests)
