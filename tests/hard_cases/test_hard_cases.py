"""The hard cases as a library: what passes, what fails, what is refused, and that layers stay apart."""

import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest
from hard_cases import CASES, CaseScene, Measure, Run, Simulator, find_case, run_case
from hard_cases.build import FRAME, hanging_sheet, make_cloth, make_scene, sheet
from hard_cases.case import solver_simulator
from hard_cases.colliders import Sphere
from hard_cases.measures import depths, mechanical_energy, optimality_gaps, settle, triangle_depths

from eslr_jax import ConfigError, MeshError, Status
from eslr_jax.pipeline.report.score import foreign_trajectory
from eslr_jax.terms import Contact


def kinematic(path):
    """Return a simulator that moves vertices along `path(start [m], frames)`."""

    def simulate(scene):
        start = np.asarray(scene.initial_state.position, np.float64)
        return foreign_trajectory(path(start, np.arange(scene.num_frames)[:, None, None]), scene)

    return Simulator("kinematic", simulate)


def ballistic(drift=0.0):
    """Return a simulator that knows only backward Euler's free fall, and pushes to one side [m/s]."""

    def path(start, frames):
        fall = -9.81 * FRAME**2 * frames * (frames + 1) / 2
        return start + fall * [0.0, 1.0, 0.0] + drift * FRAME * frames * [1.0, 0.0, 0.0]

    return kinematic(path)


def swing(turn):
    """Return a simulator that turns a curtain about its upper edge by a share of a turn before the limb comes."""

    def path(start, frames):
        angle = 2 * np.pi * turn * np.minimum(frames[..., 0] / 8, 1)
        hanging = 0.2 - start[:, 1]  # below the edge, which is 20 cm above the limb's axis
        x = np.broadcast_to(start[:, 0], (len(frames), len(start)))
        return np.stack([x, 0.2 - hanging * np.cos(angle), start[:, 2] + hanging * np.sin(angle)], axis=-1)

    return kinematic(path)


def changed(simulator, change):
    return Simulator("changed", lambda scene: change(simulator.simulate(scene)))


def only(case, *labels):
    """Return a case with some of its scenes."""

    def build(options):
        scenes = case.build(options)
        return {label: scenes[label] for label in labels}

    return dataclasses.replace(case, build=build)


def values(outcome):
    return {row["measure"]: row["value"] for row in outcome.rows()}


def test_unknown_case_is_refused_with_a_hint():
    with pytest.raises(ConfigError, match="did you mean free_fall"):
        find_case("freefall")


def test_exact_free_fall_passes_and_a_drift_fails():
    outcome = run_case(CASES["free_fall"], ballistic())
    assert [set(row) for row in outcome.rows()] == [{"case", "passed", "measure", "value", "bar"}] * 3
    assert outcome.is_passed
    blown = run_case(CASES["free_fall"], ballistic(drift=0.03))
    # One second at 3 cm/s.
    assert values(blown)["displacement beyond free fall, largest [mm]"] == pytest.approx(30.0, rel=1e-3)
    assert [measure.is_passed for measure in blown.measures] == [True, False, True]


def test_what_is_not_finite_fails_and_is_not_measured():
    broken = changed(
        ballistic(), lambda result: result.replace(positions=result.positions.at[20:, 3].set(jnp.nan))
    )
    outcome = run_case(CASES["free_fall"], broken)
    (row,) = outcome.rows()
    assert (row["measure"], row["value"], row["passed"]) == ("frames not finite", 11.0, False)
    assert not outcome.is_passed
    json.dumps(outcome.rows(), allow_nan=False)
    assert not Measure("a value", float("nan"), 1.0).is_passed


def test_error_status_fails_and_is_named():
    full = changed(ballistic(), lambda result: result.replace(status=jnp.int32(Status.SELF_CONTACT_OVERFLOW)))
    measure = run_case(CASES["free_fall"], full).measures[-1]
    assert "fall: SELF_CONTACT_OVERFLOW" in measure.name
    assert not measure.is_passed


def test_refusal_fails_unless_the_case_allows_it():
    def refuse(scene):
        raise MeshError("too hard; give another")

    simulator = Simulator("choosy", refuse)
    failed = run_case(CASES["free_fall"], simulator)
    assert not failed.is_passed
    assert "refused" in failed.rows()[-1]["measure"]
    lenient = dataclasses.replace(CASES["free_fall"], may_refuse=True, measure=lambda runs: [])
    allowed = run_case(lenient, simulator)
    assert allowed.is_passed
    assert "too hard" in allowed.rows()[-1]["measure"]


def test_limb_goes_through_a_curtain_that_stays_and_not_through_one_that_swings_over_it():
    struck = only(CASES["fast_limb"], "curtain, 4 m/s", "curtain, 8 m/s")  # slower limbs do not get as far
    for turn, expected in ((0.0, 100.0), (0.42, 0.0)):
        found = values(run_case(struck, swing(turn)))
        assert [v for name, v in found.items() if "went through" in name] == [expected] * 2


def test_triangle_depth_sees_a_ball_between_vertices():
    mesh = sheet(2, 2, (0.1, 0.1))
    scene = make_scene(make_cloth(mesh, {}), mesh[0] + np.array([0, 0.245, 0]), 2)
    still = foreign_trajectory(np.repeat(scene.initial_state.position[None], 2, axis=0), scene)
    run = Run(scene, lambda frame: (Sphere(np.zeros(3), 0.25),), still)
    assert depths(run).max() < -4.0
    np.testing.assert_allclose(triangle_depths(run).max(), 5.0, atol=1e-3)


@pytest.mark.slow
def test_settled_cloth_stays_and_its_gap_is_its_distance_from_the_optimum():
    mesh = hanging_sheet(7, 7, (0.3, 0.3))
    garment = make_cloth(mesh, {}, is_pinned=mesh[0][:, 1] > -1e-9)
    rest = settle(make_scene(garment, mesh[0], 2), *[jnp.asarray(mesh[0], jnp.float32)] * 2)
    scene = make_scene(garment, np.asarray(rest), 11, pin_targets=mesh[0][None])
    solver = solver_simulator(50)
    run = Run(scene, CaseScene(scene).colliders, solver.simulate(scene))
    assert np.abs(run.positions - run.positions[0]).max() < 2e-5  # float32 on 0.3 m
    assert np.ptp(mechanical_energy(run)) < 1e-6
    gaps = optimality_gaps(run, 5)
    assert gaps.shape == (2,)
    np.testing.assert_allclose(gaps, 0.0, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["free_fall", "hang", "drop_on_ball", "pull", "pinch"])
def test_the_solver_passes(name):
    failed = [row for row in run_case(CASES[name], solver_simulator()).rows() if not row["passed"]]
    assert not failed


@pytest.mark.slow
def test_folded_layer_and_a_skirt_over_trousers_stay_apart():
    """Two free sheets that crumple do not, see the case's `limit`."""
    pytest.importorskip("ipctk")
    outcome = run_case(only(CASES["layers"], "folded", "skirt over trousers"), solver_simulator())
    assert len(outcome.runs) == 2
    assert outcome.is_passed, [row for row in outcome.rows() if not row["passed"]]


@pytest.mark.slow
def test_without_self_contact_layers_pass_through_each_other():
    """Else the case would prove nothing."""
    pytest.importorskip("ipctk")
    solver = solver_simulator(50)

    def simulate(scene):
        bare = tuple(term for term in scene.terms if not isinstance(term, Contact))
        return solver.simulate(scene.replace(terms=bare))

    blind = Simulator("blind", simulate)
    found = values(run_case(only(CASES["layers"], "two sheets", "skirt over trousers"), blind))
    assert max(value for name, value in found.items() if "intersecting pairs after" in name) >= 10
