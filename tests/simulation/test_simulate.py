"""The host's door: checks, chunks, pace, buffers, errors."""

import time
from functools import cache, partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cloth import make_garment
from draped_ball import drifting_ball, square

from eslr_jax import (
    CapacityError,
    ConfigError,
    MotionError,
    SimConfig,
    Status,
    prepare_scene,
    rollout_scene,
    simulate,
)
from eslr_jax.fabric.materials import COTTON
from eslr_jax.pipeline.cli.method import Actor
from eslr_jax.pipeline.cli.options import Options
from eslr_jax.pipeline.cli.simulate import Unfinished
from eslr_jax.pipeline.report.gap import GapOptions, measure_gap
from eslr_jax.simulation.archive import read_tree, write_tree
from eslr_jax.simulation.plan import first_frames
from eslr_jax.simulation.program import _program, find_program
from eslr_jax.simulation.simulate import (
    begin_compiling,
    enlarge_buffers,
    good_frames,
    hold_last,
    raise_for_status,
)
from eslr_jax.terms import CLOTH, FAST, Contact, Friction

SOLVER = SimConfig(iterations=12)


@pytest.fixture(scope="module")
def scene():
    """Without pairs, which take long to compile; see `crossing_sheets`."""
    return prepare_scene(square(), drifting_ball(14), terms=FAST)


@pytest.fixture(scope="module")
def whole(scene):
    return simulate(None, scene, config=SOLVER).trajectory


@pytest.mark.slow
def test_chunks_equal_one_scan(scene):
    told = []
    trajectory, timing, _ = simulate(
        None, scene, config=SOLVER, on_frames=lambda *counts: told.append(counts)
    )
    whole = rollout_scene(None, scene, SOLVER)
    # Two programs round differently, which folds amplify.
    np.testing.assert_allclose(trajectory.positions[:3], whole.positions[:3], atol=1e-5)
    np.testing.assert_allclose(trajectory.positions, whole.positions, atol=2e-3)
    np.testing.assert_allclose(
        sum(trajectory.energies.values())[:3], sum(whole.energies.values())[:3], atol=1e-6
    )
    assert told == [(10, 13), (13, 13)]
    assert timing.frame_ms < 1e3


def test_a_simulation_that_was_stopped_goes_on_to_the_same_end(scene, whole):
    first = simulate(None, scene, config=SOLVER, is_stopping=lambda: True).trajectory
    assert first.num_frames == 11
    told = []
    joined = simulate(
        None, scene, config=SOLVER, done=first, on_frames=lambda *counts: told.append(counts)
    ).trajectory
    assert told == [(13, 13)]
    again = simulate(None, scene, config=SOLVER, done=joined).trajectory  # nothing is left to do
    assert again.num_frames == joined.num_frames
    jax.tree.map(np.testing.assert_array_equal, joined, whole)


def crossing_sheets(num_frames=3, side=8, *, gap=0.004, slide=0.0, below=0.0, **options):
    """Two squares a few millimetres apart [m], the ball `below` them; the upper one may slide [m/s]."""
    lower, count = square(side), side * side
    rest = np.concatenate([lower.rest_positions, np.add(lower.rest_positions, [0, 0.02, 0])])
    garment = make_garment(rest, np.concatenate([lower.faces, np.add(lower.faces, count)]))
    scene = prepare_scene(garment, drifting_ball(num_frames, below=below), starts_at_rest=True, **options)
    close = scene.initial_state.position.at[count:, 1].set(rest[count:, 1] - 0.02 + gap)
    velocity = scene.initial_state.velocity.at[count:, 0].set(slide)
    return scene.replace(initial_state=scene.initial_state.replace(position=close, velocity=velocity))


@cache
def simulated(kind):
    """A simulation of fourteen frames, whose buffers need not grow any more."""
    stepping = {"euler": {}, "bdf2": {"integrator": "bdf2"}, "substeps": {"substeps": 2}}
    if kind == "self-contact in substeps of bdf2":
        options = {"terms": (*CLOTH, Friction(), Contact(rows=32768)), "integrator": "bdf2", "substeps": 2}
        scene = crossing_sheets(14, 5, gap=0.0015, slide=0.3, below=5.0, **options)  # with rows enough
    else:
        scene = prepare_scene(square(), drifting_ball(14), terms=FAST, **stepping[kind])
    return simulate(None, scene, config=SOLVER)


@pytest.mark.parametrize(
    "kind",
    [
        "euler",
        pytest.param("bdf2", marks=pytest.mark.slow),
        pytest.param("substeps", marks=pytest.mark.slow),
        "self-contact in substeps of bdf2",
    ],
)
def test_from_any_frame_on_it_goes_on_bit_by_bit_though_all_chunks_begin_elsewhere(kind):
    whole, _, scene = simulated(kind)
    for count in (6, 2):
        first = good_frames(whole.replace(first_bad_frame=jnp.int32(count)))
        assert first.num_frames == count
        programs = _program.cache_info().misses
        joined = simulate(None, scene, config=SOLVER, done=first).trajectory
        assert _program.cache_info().misses == programs, "it is the same program"
        jax.tree.map(np.testing.assert_array_equal, joined, whole)


def kept(path, trajectory, scene):
    """Write what was interrupted, and read it again."""
    options = Options(frames=30, garment=("two", "sheets"), wind=(0.0, 1.5, 0.0))
    whole = Unfinished(
        options, Actor(drifting_ball(2).surface, drifting_ball(2), "turn", 0.5), 5, scene, trajectory
    )
    write_tree(path / "unfinished.npz", whole, content="interrupted simulation")
    again = read_tree(path / "unfinished.npz", Unfinished, content="interrupted simulation", remedy="")
    assert jax.tree.structure(again) == jax.tree.structure(whole)
    assert again.options == options
    return again


def test_an_unfinished_simulation_with_self_contact_is_read_as_it_was_written(tmp_path):
    part, _, scene = simulated("self-contact in substeps of bdf2")
    demand = np.asarray(part.demands["contact"])
    assert demand.shape == (14,)
    assert demand[1] > 0
    again = kept(tmp_path, part, scene)
    jax.tree.map(
        partial(np.testing.assert_array_equal, strict=True), (again.scene, again.done), (scene, part)
    )


@pytest.mark.slow
def test_interrupted_at_any_of_ten_points_it_ends_bit_by_bit_as_the_whole(tmp_path):
    scene = prepare_scene(square(), drifting_ball(115))
    whole = simulate(None, scene, config=SOLVER).trajectory
    for point in range(1, 11):
        done = []
        part = simulate(
            None,
            scene,
            config=SOLVER,
            on_frames=lambda count, total, done=done: done.append(count),
            is_stopping=lambda done=done, point=point: len(done) == point,
        ).trajectory
        assert part.num_frames == 10 * point + 1
        again = kept(tmp_path, part, scene)
        resumed = simulate(None, again.scene, config=SOLVER, done=again.done).trajectory
        jax.tree.map(np.testing.assert_array_equal, resumed, whole)


def test_frames_before_a_bad_one_are_good(whole):
    kept = good_frames(whole.replace(status=jnp.int32(Status.NON_FINITE), first_bad_frame=jnp.int32(4)))
    assert (kept.num_frames, int(kept.status), int(kept.first_bad_frame)) == (4, Status.OK, -1)
    np.testing.assert_array_equal(kept.positions, whole.positions[:4])


def test_a_rollout_that_ended_early_stands_still(whole):
    bad = whole.replace(status=jnp.int32(Status.NON_FINITE), first_bad_frame=jnp.int32(5))
    held = hold_last(bad, 14)
    np.testing.assert_array_equal(held.positions[:5], whole.positions[:5])
    np.testing.assert_array_equal(np.ptp(held.positions[4:], axis=0), 0.0)
    assert int(held.status) == Status.NON_FINITE
    assert hold_last(whole, whole.num_frames) is whole


@pytest.mark.usefixtures("whole")
def test_a_program_is_compiled_once_for_scenes_of_any_length(scene):
    again = simulate(None, first_frames(scene, 12), config=SOLVER)
    assert again.timing.compile_s < 0.05
    assert again.trajectory.num_frames == 12


def compiled_early(pace):
    """Simulate by a program that was compiled while the scene was prepared; return the trajectory."""
    config = SimConfig(iterations=10)  # of no other test, whose programs are kept
    prepare_scene(square(), drifting_ball(14), terms=CLOTH)  # its start is a program too
    before = _program.cache_info().misses
    scene = prepare_scene(
        square(),
        drifting_ball(14),
        terms=CLOTH,
        on_shapes=lambda shapes: begin_compiling(None, shapes, config, is_paced=pace is not None),
    )
    assert _program.cache_info().misses == before + 1
    trajectory = simulate(None, scene, config=config, pace=pace).trajectory
    assert _program.cache_info().misses == before + 1, "another program runs"
    return trajectory


@pytest.mark.slow
def test_a_program_that_is_compiled_early_is_the_one_that_runs():
    compiled_early(None)


def test_a_pace_sets_the_iterations_of_the_next_chunk():
    asked = []

    def pace(iterations, took_ms):
        asked.append(iterations)
        return iterations + 5

    paced = compiled_early(pace)
    assert asked == [10, 15]
    np.testing.assert_array_equal(paced.iterations, [0] + [10] * 10 + [15] * 3)


@pytest.mark.slow
def test_tolerance_stops_early_and_is_kept(scene):
    loose = simulate(None, scene, config=SimConfig(iterations=300, tolerance=0.01)).trajectory
    assert int(loose.iterations[1:].max()) < 150
    gap = measure_gap(None, loose, scene, GapOptions(iterations=()))
    # The solver's bound is an estimate: where the sheet first touches the ball it leaves 1.4 %.
    shares = np.sort(gap.share(gap.reached))
    assert shares[-2] <= 0.01
    assert shares[-1] <= 0.02


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"material": COTTON.replace(density=-0.2)}, "material density = -0.2; give a value from"),
        ({"material": COTTON.replace(density=np.ones(7))}, r"one per vertex \(64\)"),
        ({"timestep": jnp.float32(0.0)}, "timestep = 0; give a value from"),
        ({"terms": (*CLOTH, Friction(-1.0))}, "friction coefficient = -1"),
    ],
)
def test_unphysical_scenes_are_refused_by_name(scene, changes, message):
    with pytest.raises(ConfigError, match=message):
        simulate(None, scene.replace(**changes))


def slow_first_program(monkeypatch, seconds):
    """Make every run of the first program slower by `seconds`; return a list of waits for programs [s]."""
    waits = []

    def find(*arguments, **static):
        began = time.perf_counter()
        program = find_program(*arguments, **static).wait()
        waits.append(time.perf_counter() - began)
        if len(waits) == 1:
            return SimpleNamespace(wait=lambda: lambda *values: (time.sleep(seconds), program(*values))[1])
        return program

    monkeypatch.setattr("eslr_jax.simulation.simulate.find_program", find)
    return waits


@pytest.mark.slow
def test_self_contact_that_overflows_gets_the_buffers_it_needs(monkeypatch):
    scene = crossing_sheets()
    few = scene.with_term(scene.term(Contact).replace(rows=512))
    short = rollout_scene(None, few, SOLVER)
    assert Status.SELF_CONTACT_OVERFLOW in Status(int(short.status))
    with pytest.raises(CapacityError, match=r"frame 1: .*: \d+ rows or more"):
        raise_for_status(short)
    assert enlarge_buffers(few, short.demands).term(Contact).rows > 512
    waits = slow_first_program(monkeypatch, 5.0)
    found = simulate(None, few, config=SOLVER)
    assert len(waits) > 1, "a program for every buffer"
    assert found.timing.compile_s >= sum(waits)
    assert found.timing.frame_ms * 2 * len(waits) > 5e3, "the mean is over the two frames of every pass"
    assert found.scene.term(Contact).rows > 512
    expected = rollout_scene(None, found.scene, SOLVER)
    assert Status(int(expected.status)) == Status.OK
    np.testing.assert_allclose(found.trajectory.positions, expected.positions, atol=1e-5)
    assert enlarge_buffers(found.scene, expected.demands) is None
    stopped = simulate(None, few, config=SOLVER, is_stopping=lambda: True)
    assert stopped.trajectory.num_frames == 1, "whoever stops is not told of buffers that would have grown"
    assert Status(int(stopped.trajectory.status)) == Status.OK


def test_buffers_double_until_they_hold_the_fullest_frame_and_half_as_much_more(scene, whole):
    tight = scene.replace(terms=(*scene.terms, Contact(rows=512)))
    for most, rows in ((513, 1024), (1500, 4096), (600, 1024)):
        demand = jnp.array([0] * 5 + [most] + [10] * 8)
        full = whole.replace(demands={"contact": demand}, status=jnp.int32(Status.SELF_CONTACT_OVERFLOW))
        assert enlarge_buffers(tight, full.demands).term(Contact).rows == rows
    with pytest.raises(CapacityError, match="600 rows or more"):
        raise_for_status(full)
    full = full.replace(first_bad_frame=jnp.int32(5))
    with pytest.raises(CapacityError, match=r"^frame 3: "):
        raise_for_status(full, settle=2)
    with pytest.raises(CapacityError, match=r"^before frame 0, while the garment settled: "):
        raise_for_status(full, settle=6)


def with_jump(scene, height):
    """Return a scene whose body jumps by so much [m] before frame 5."""
    jumped = scene.body.positions.at[5:].add(jnp.array([0.0, height, 0.0]))
    return scene.replace(body=scene.body.replace(positions=jumped))


def test_a_body_too_fast_to_follow_is_told(scene):
    fast = with_jump(scene, 0.35)
    ended = simulate(None, fast, config=SOLVER, raises=False).trajectory
    assert int(ended.first_bad_frame) == 5
    assert ended.num_frames == 11, "it ends with the chunk of the first bad frame"
    with pytest.raises(MotionError, match="frame 5: the body moved farther"):
        simulate(None, fast, config=SOLVER)
    away = simulate(None, with_jump(scene, -0.4), config=SOLVER).trajectory
    assert (away.num_frames, int(away.first_bad_frame)) == (14, -1), "it jumps away from the cloth"


def test_a_scene_of_one_frame_is_refused(scene):
    with pytest.raises(MotionError, match="1 frame"):
        simulate(None, first_frames(scene, 1), config=SOLVER)


def test_frames_after_a_bad_one_are_simulated_again(scene, whole):
    bad = whole.replace(
        positions=whole.positions.at[7:].set(jnp.nan),
        status=jnp.int32(Status.NON_FINITE),
        first_bad_frame=jnp.int32(7),
    )
    again = simulate(None, scene, config=SOLVER, done=bad).trajectory
    np.testing.assert_array_equal(again.positions, whole.positions)
    assert int(again.status) == Status.OK


def test_the_first_bad_frame_is_a_row_of_the_trajectory(scene):
    """A scene that begins later counts its frames from there: gusts depend on the time."""
    nothing = jnp.full_like(scene.initial_state.velocity, jnp.nan)
    late = scene.initial_state.replace(frame=jnp.int32(50), velocity=nothing)
    ended = simulate(None, scene.replace(initial_state=late), config=SOLVER, raises=False).trajectory
    assert int(ended.first_bad_frame) == 1
    assert good_frames(ended).num_frames == 1


# A corner that is pulled away; and one pulled along a hem that is pinned, so that only its last edge tears.
@pytest.mark.parametrize(("pinned", "pull"), [([0, 7], 0.4), (range(8), [0.0, 0.0, 0.027])])
def test_frames_that_tear_cloth_are_simulated_again_in_four_steps(pinned, pull):
    scene = prepare_scene(square(is_pinned=np.array(pinned)), drifting_ball(13), terms=FAST)
    pins = scene.pin_targets.at[5:, 7].add(jnp.asarray(pull))
    torn = scene.replace(pin_targets=pins)
    trajectory = simulate(None, torn, config=SOLVER).trajectory
    assert np.asarray(trajectory.substeps).tolist() == [1] + 12 * [4]
    parted = simulate(None, torn.replace(substeps=4), config=SOLVER).trajectory
    np.testing.assert_array_equal(trajectory.positions, parted.positions)
    stopped = simulate(None, torn, config=SOLVER, is_stopping=lambda: True).trajectory
    resumed = simulate(None, torn, config=SOLVER, done=stopped).trajectory
    np.testing.assert_array_equal(resumed.substeps, trajectory.substeps)
    np.testing.assert_array_equal(resumed.positions, trajectory.positions)


def test_it_goes_on_from_a_rollout(scene):
    done = rollout_scene(None, first_frames(scene, 5), SOLVER)
    trajectory = simulate(None, scene, config=SOLVER, done=done).trajectory
    assert np.asarray(trajectory.substeps).tolist() == 14 * [1]
    np.testing.assert_array_equal(trajectory.positions[:5], done.positions)
