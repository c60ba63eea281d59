"""The hard cases as a library: what passes, what fails, what is refused, and that layers stay apart."""

import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest

from eslr_jax.errors import ConfigError, MeshError
from eslr_jax.evaluation.hard_cases import (
    CASES,
    Measure,
    Simulator,
    find_case,
    physics_simulator,
    play,
    run_case,
)
from eslr_jax.evaluation.hard_cases.build import FRAME
from eslr_jax.evaluation.hard_cases.simulators import join_substeps, split_frames
from eslr_jax.types import Trajectory

pytest.importorskip("ipctk")


def ballistic(drift=0.0):
    """A simulator that knows only backward Euler's free fall, and pushes to one side."""

    def simulate(stress):
        steps = np.arange(stress.scene.num_frames)[:, None, None]
        fall = -9.81 * FRAME**2 * steps * (steps + 1) / 2
        positions = np.asarray(stress.scene.start.position)[None] + fall * [0.0, 1.0, 0.0]
        positions = positions + drift * FRAME * steps * [1.0, 0.0, 0.0]
        frames = len(positions)
        return Trajectory(
            positions=jnp.asarray(positions, jnp.float32),
            velocities=jnp.zeros(positions.shape),
            residuals=jnp.zeros(frames),
            iterations=jnp.zeros(frames, jnp.int32),
            status=jnp.int32(0),
            first_bad_frame=jnp.int32(-1),
        )

    return Simulator("ballistic", simulate)


def replace_positions(simulator, change):
    def simulate(stress):
        trajectory = simulator.simulate(stress)
        return dataclasses.replace(trajectory, positions=change(trajectory.positions))

    return Simulator("changed", simulate)


def swing(turn):
    """A simulator that turns a curtain about its upper boundary, before the limb comes, by a share of a full turn."""

    def turned(positions):
        start, frames = np.asarray(positions[0], np.float64), np.arange(len(positions))
        angle = 2 * np.pi * turn * np.minimum(frames / 8, 1)[:, None]
        hanging = 0.2 - start[:, 1]  # below the boundary, which is 20 cm above the limb's axis
        path = np.stack(
            [
                np.broadcast_to(start[:, 0], (len(frames), len(start))),
                0.2 - hanging * np.cos(angle),
                start[:, 2] + hanging * np.sin(angle),
            ],
            axis=-1,
        )
        return jnp.asarray(path, jnp.float32)

    return replace_positions(ballistic(), turned)


def test_a_limb_goes_through_a_curtain_that_stays_and_not_through_one_that_swings_over_it():
    for turn, expected in ((0.0, 100.0), (0.42, 0.0)):
        rows = {row["measure"]: row["value"] for row in run_case("fast_limb", swing(turn))}
        for speed in (4, 8):  # slower ones do not get as far
            assert rows[f"curtain, {speed} m/s: cloth the limb went through, untold [%]"] == expected


def test_there_are_fifteen_with_a_reason_each():
    assert len(CASES) == 15
    assert all(case.reason and len(case.reason) < 120 for case in CASES.values())


def test_an_unknown_case_is_refused_with_a_hint():
    with pytest.raises(ConfigError, match="did you mean free_fall"):
        find_case("freefall")


def test_exact_free_fall_passes_and_a_drift_fails():
    rows = run_case("free_fall", ballistic())
    assert [set(row) for row in rows] == [{"case", "passed", "measure", "value", "bar"}] * 3
    assert all(row["passed"] for row in rows)
    blown = {row["measure"]: row for row in run_case("free_fall", ballistic(drift=0.03))}
    moved = blown["displacement beyond free fall, largest [mm]"]
    assert moved["value"] == pytest.approx(30.0, rel=1e-3)  # one second at 3 cm/s
    assert not moved["passed"]
    assert blown["fall of the centre against backward Euler [%]"]["passed"]


def test_what_is_not_finite_fails_and_is_not_measured():
    broken = replace_positions(ballistic(), lambda x: x.at[20:, 3].set(jnp.nan))
    outcome = play(CASES["free_fall"], broken)
    (row,) = outcome.rows()
    assert (row["measure"], row["value"], row["passed"]) == ("frames not finite", 11.0, False)
    assert not outcome.is_passed
    json.dumps(outcome.rows(), allow_nan=False)
    assert not Measure("a value", float("nan"), 1.0).is_passed


def test_a_refusal_fails_unless_the_case_allows_it():
    def refuse(stress):
        raise MeshError("too hard; give another")

    simulator = Simulator("choosy", refuse)
    failed = play(CASES["free_fall"], simulator)
    assert not failed.is_passed
    assert "refused" in failed.rows()[-1]["measure"]
    lenient = dataclasses.replace(CASES["free_fall"], may_refuse=True, measure=lambda runs: [])
    assert play(lenient, simulator).is_passed


def test_substeps_split_and_join():
    stress = CASES["twist"].build({})["twist"]
    short = dataclasses.replace(stress.scene, pin_targets=stress.scene.pin_targets[:4], num_frames=4)
    fine = split_frames(short, 3)
    assert fine.num_frames == 10
    np.testing.assert_allclose(fine.pin_targets[::3], short.pin_targets, atol=1e-6)
    np.testing.assert_allclose(fine.timestep * 3, short.timestep, rtol=1e-6)
    frames = np.arange(10)
    trajectory = Trajectory(
        positions=jnp.asarray(frames)[:, None, None] * jnp.ones((1, 2, 3)),
        velocities=jnp.zeros((10, 2, 3)),
        residuals=jnp.zeros(10),
        iterations=jnp.asarray(np.minimum(frames, 1)),
        status=jnp.int32(4),
        first_bad_frame=jnp.int32(5),
        needed_capacity=jnp.asarray(np.stack([frames, 10 - frames], axis=1)),
    )
    joined = join_substeps(trajectory, 3)
    np.testing.assert_array_equal(joined.positions[:, 0, 0], [0, 3, 6, 9])
    np.testing.assert_array_equal(joined.iterations, [0, 3, 3, 3])
    np.testing.assert_array_equal(joined.needed_capacity, [[0, 10], [3, 9], [6, 6], [9, 3]])
    assert int(joined.first_bad_frame) == 2


@pytest.mark.slow
@pytest.mark.parametrize("name", ["free_fall", "hang", "drop_on_ball", "pull", "pinch"])
def test_the_solver_passes(name):
    failed = [row for row in run_case(name, physics_simulator()) if not row["passed"]]
    assert not failed


@pytest.mark.slow
def test_a_folded_layer_and_a_skirt_over_trousers_stay_apart():
    """Two free sheets that crumple do not, see the case's `limit`."""
    case = CASES["layers"]
    scenes = {label: scene for label, scene in case.build({}).items() if label != "two sheets"}
    outcome = play(dataclasses.replace(case, build=lambda options: scenes), physics_simulator())
    assert len(outcome.runs) == 2
    assert outcome.is_passed, [row for row in outcome.rows() if not row["passed"]]


@pytest.mark.slow
def test_without_self_contact_layers_pass_through_each_other():
    """Else the case would prove nothing."""
    rows = run_case("layers", physics_simulator(iterations=50, self_contact=False))
    assert any("intersecting pairs after" in row["measure"] and not row["passed"] for row in rows)
