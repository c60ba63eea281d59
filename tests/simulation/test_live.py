"""A simulation that goes on frame by frame: forth and back, with a hand, a wind and another fabric."""

from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest
from draped_ball import drifting_ball, square

from eslr_jax import scene_terms
from eslr_jax.fabric.materials import COTTON, fabric_material
from eslr_jax.pipeline.page.stage import (
    Stage,
    advance,
    changed,
    enlarged,
    grasp,
    nearest_vertex,
    no_hand,
    set_stage,
)
from eslr_jax.pose.motion import there_and_back
from eslr_jax.simulation.program import _program
from eslr_jax.terms import Contact

STILL = (0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def opening():
    """A stage, and how many programs were begun while it was set and while it was played for the first time.

    Without pairs, which take long to compile.
    """
    begun = [_program.cache_info().misses]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("eslr_jax.pipeline.page.stage.scene_terms", partial(scene_terms, without=(Contact,)))
        stage = set_stage(square(5, 0.2, is_pinned=np.array([0])), drifting_ball(4), COTTON)
    begun.append(_program.cache_info().misses)
    played(stage, 5)  # forth and back
    begun.append(_program.cache_info().misses)
    return stage, np.diff(begun).tolist()


@pytest.fixture
def stage(opening):
    return opening[0]


def played(stage, count, tolerance=0.01):
    state, reports = stage.scene.initial_state, []
    for step in range(count):
        state, report = advance(stage, state, there_and_back(step, stage.scene.num_frames), 40, tolerance)
        reports.append(report)
    assert int(state.status) == 0
    return np.asarray(state.position), reports


def test_a_motion_is_played_forth_and_back():
    frames = [there_and_back(step, 4) for step in range(8)]
    assert frames == [(0, 1), (1, 2), (2, 3), (3, 2), (2, 1), (1, 0), (0, 1), (1, 2)]
    after_two = [there_and_back(step, 5, 2) for step in range(7)]
    assert after_two == [(0, 1), (1, 2), (2, 3), (3, 4), (4, 3), (3, 2), (2, 3)]


def test_a_frame_that_had_too_little_room_gets_a_larger_stage(stage):
    scenes = (scene.replace(terms=(*scene.terms, Contact(rows=512))) for scene in stage[:2])
    tight = Stage(*scenes, stage.inputs, stage.back)
    _, (report, *_) = played(stage, 1)
    assert enlarged(tight, report._replace(demands={"contact": jnp.int32(512)})) is None
    larger = enlarged(tight, report._replace(demands={"contact": jnp.int32(513)}))
    assert [one.term(Contact).rows for one in (larger.scene, larger.constant)] == [1024, 1024]


def test_the_step_that_is_compiled_early_is_the_one_that_runs(opening):
    assert opening[1] == [2, 0]  # the scene's start, and the step


def test_the_body_carries_pins_forth_and_back(stage):
    moved = np.asarray(drifting_ball(4).joint_transforms)[:, 0, :, 3]
    for count, frame in ((3, 3), (5, 1), (6, 0)):
        positions, reports = played(stage, count)
        corner = np.asarray(stage.scene.garment.rest_positions)[0] + moved[frame]
        np.testing.assert_allclose(positions[0], corner, atol=1e-6)
        assert 0 < reports[-1].iterations <= 40


def test_a_hand_holds_its_vertex(stage):
    corner = 24
    place = np.add(stage.scene.initial_state.position[corner], [0.02, 0.1, 0.02])
    free, _ = played(stage, 12)
    held, _ = played(changed(stage, COTTON, STILL, grasp(corner, place)), 12)
    assert np.linalg.norm(held[corner] - place) < 0.03 < np.linalg.norm(free[corner] - place)


def test_wind_and_fabric_change_the_cloth_without_compiling_anew(stage):
    before = _program.cache_info().misses  # by what set the stage
    still, _ = played(changed(stage, COTTON, STILL, no_hand()), 8)
    blown, _ = played(changed(stage, COTTON, (0.0, 0.0, 6.0), no_hand()), 8)
    stiff, _ = played(changed(stage, fabric_material("denim"), STILL, no_hand()), 8)
    assert (blown - still)[:, 2].mean() > 0.005
    assert np.abs(stiff - still).max() > 1e-3
    assert _program.cache_info().misses == before


def test_a_tighter_tolerance_takes_more_iterations_and_compiles_nothing(stage):
    before = _program.cache_info().misses
    loose, tight = (played(stage, 8, tolerance)[1] for tolerance in (0.05, 0.001))
    for reports, tolerance in ((loose, 0.05), (tight, 0.001)):
        for report in reports:
            assert report.gap_bound <= tolerance or report.iterations == 40
    assert sum(int(report.iterations) for report in loose) < sum(int(report.iterations) for report in tight)
    left = [float(np.median([report.gap_bound for report in reports])) for reports in (loose, tight)]
    assert left[1] < 0.5 * left[0]
    assert _program.cache_info().misses == before


def test_a_ray_finds_the_vertex_in_front():
    points = np.array([[0.0, 0.0, 0.0], [0.001, 0.0, 1.0], [0.2, 0.0, 2.0], [0.0, 0.0, 9.0]])
    assert nearest_vertex(points, jnp.array([0.0, 0.0, 5.0]), jnp.array([0.0, 0.0, -1.0])) == 1
