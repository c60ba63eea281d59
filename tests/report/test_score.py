"""The score of anybody's trajectory is that of our own where it is ours, and worse where it is worse."""

import jax
import numpy as np
import pytest
from draped_ball import drifting_ball, square

from eslr_jax import (
    ConfigError,
    MotionError,
    NonFiniteError,
    SimConfig,
    prepare_scene,
    scene_terms,
    score_trajectory,
    simulate,
)
from eslr_jax.pipeline.report.gap import trajectory_gap
from eslr_jax.pipeline.report.report import trajectory_report
from eslr_jax.pipeline.report.score import foreign_trajectory, with_energies
from eslr_jax.terms.air import blowing

FRAMES = 7
GUSTY = {"terms": scene_terms(blowing((3.0, 0.0, 0.0), 1.0))}  # blows otherwise in every frame


@pytest.fixture(scope="module", params=["euler", "bdf2", "gusts"])
def task(request):
    options = {"integrator": request.param} if request.param != "gusts" else GUSTY
    scene = prepare_scene(square(), drifting_ball(FRAMES), **options)
    return scene, simulate(None, scene, config=SimConfig(iterations=60)).trajectory


@pytest.mark.slow
def test_what_positions_alone_tell_is_what_the_simulation_said(task):
    scene, own = task
    told = jax.device_get(with_energies(foreign_trajectory(own.positions, scene), scene))
    speed = np.abs(np.asarray(own.velocities)).max()
    np.testing.assert_allclose(told.velocities, own.velocities, atol=2e-4 * speed)
    np.testing.assert_allclose(told.friction_loads, own.friction_loads, atol=1e-4)
    for name, values in told.energies.items():
        np.testing.assert_allclose(values, own.energies[name], rtol=2e-2, atol=1e-7, err_msg=name)
    np.testing.assert_allclose(told.residuals[2:], own.residuals[2:], rtol=0.5, atol=5e-3)


@pytest.mark.slow
def test_our_own_scores_as_its_report_and_its_gap_say(task):
    scene, own = task
    score, report = score_trajectory(own, scene, every=2), trajectory_report(own, scene)
    for name in ("p99_principal_stretch", "max_principal_stretch", "penetration_max_mm", "rms_speed_m_s"):
        assert score[name] == report[name]
    assert score["total"] == pytest.approx(report["total"], rel=1e-4)
    assert score["residual_median"] == pytest.approx(report["residual_median"], rel=0.05)
    ends = trajectory_gap(own, scene, every=2)
    assert score["gap_frames"] == len(ends.reached) == 3
    assert score["gap_relative_median"] == float(np.median(ends.share(ends.reached))) < 0.01


@pytest.mark.slow
def test_a_worse_trajectory_scores_worse(task):
    scene, own = task
    noise = 1e-3 * np.random.default_rng(0).normal(size=own.positions.shape)
    better, worse = (score_trajectory(own.positions + scale * noise, scene, every=2) for scale in (0.0, 1.0))
    assert better["gap_relative_median"] < 0.02 < worse["gap_relative_median"]
    assert better["gap_median_j"] < worse["gap_median_j"]
    assert better["pooled_stretch_p99"] < worse["pooled_stretch_p99"]


@pytest.mark.slow
def test_pairs_of_triangles_are_counted():
    pytest.importorskip("ipctk")
    scene = prepare_scene(square(), drifting_ball(3, speed=0.0), starts_at_rest=True)
    still = np.repeat(np.asarray(scene.initial_state.position)[None], 3, axis=0)
    score = score_trajectory(still, scene)
    assert score["intersections_cloth"] == score["intersections_body"] == 0
    still[-1, :, 1] -= 0.05  # through the ball
    score = score_trajectory(still, scene)
    assert score["intersections_body"] == score["intersections_body_max"] > 0
    assert score["intersections_cloth"] == 0


@pytest.mark.slow
def test_how_the_garment_sits_is_scored_with_the_whole_body(small_scene, small_poses, small_trajectory):
    score = score_trajectory(small_trajectory, small_scene, poses=small_poses)
    assert score["slide_m"] < 0.05
    assert score["below_feet_at"] is None


def test_what_is_no_trajectory_of_the_scene_is_refused(small_scene):
    positions = np.repeat(np.array(small_scene.initial_state.position)[None], small_scene.num_frames, axis=0)
    with pytest.raises(MotionError, match="not those of the scene"):
        score_trajectory(positions[:-1], small_scene)
    with pytest.raises(ConfigError, match="1 or more"):
        score_trajectory(positions, small_scene, every=0)
    positions[4, 0] = np.nan
    with pytest.raises(NonFiniteError, match="frame 4"):
        score_trajectory(positions, small_scene)
