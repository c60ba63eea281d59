"""What is chosen for a budget or a tolerance, from measurements that are given."""

import numpy as np
import pytest
from eslr_jax.cli.budget import parse_budget, parse_request, parse_share

from eslr_jax.errors import AssetError, ConfigError
from eslr_jax.evaluation.calibrate import example_scene, fit_costs, read_coarse_edges
from eslr_jax.simulation.budget import (
    SOLVER,
    Calibration,
    Method,
    choose,
    expected_ms,
    keep_budget,
    read_calibration,
    write_calibration,
)

# The solver falls tenfold every ten iterations; the network saves the first ten, and costs as much as 20.
SLOW = Method("net", 1000, 21.0, 1.0, {"0": 0.1, "20": 1e-3, "40": 1e-5}, {"0": 0.2, "10": 0.02, "20": 2e-3})
PLAIN = Method(SOLVER, 1000, 1.0, 1.0, {"1": 0.9, "10": 0.1, "50": 1e-5}, {"1": 0.95, "10": 0.2, "30": 2e-3})
# Another device: there the network's passes are nearly free.
FAST = Method("net", 1000, 2.0, 1.0, SLOW.median, SLOW.p99)
LARGE = Method(SOLVER, 4000, 4.0, 4.0, PLAIN.median, PLAIN.p99)


def test_a_budget_buys_the_least_gap():
    choice = choose(Calibration("here", (PLAIN, SLOW)), 1000, budget_ms=22.0)
    assert (choice.method, choice.iterations) == (SOLVER, 21)
    assert choice.expected_ms <= 22.0
    assert "net" in choice.reason
    choice = choose(Calibration("here", (PLAIN, SLOW)), 1000, budget_ms=20.5)  # the network alone takes 21 ms
    assert "net" not in choice.reason
    choice = choose(Calibration("there", (PLAIN, FAST)), 1000, budget_ms=12.0)
    assert (choice.method, choice.iterations) == ("net", 10)
    assert choice.expected_gap == pytest.approx(0.01)


def test_a_budget_is_kept_on_a_machine_of_another_speed():
    choice = choose(Calibration("here", (PLAIN,)), 1000, budget_ms=31.0)  # 1 ms, and 1 ms an iteration
    assert choice.iterations == 30
    pace = keep_budget(choice, 31.0)
    assert pace(30, 31.0) == 30
    assert pace(30, 62.0) == 14  # twice as slow: 2 ms, and 2 ms an iteration
    assert pace(14, 30.0) == 14
    assert pace(30, 15.5) == 61
    assert pace(30, 3100.0) == 5  # fewer would be no cloth
    assert pace(30, 0.31) == 160  # beyond it nothing was measured


def test_a_tolerance_takes_the_least_time():
    choice = choose(Calibration("here", (PLAIN, SLOW)), 1000, tolerance=0.0201)
    assert choice.method == SOLVER
    assert choice.tolerance == 0.0201
    # Kept after 20 iterations; frames stop where the median is 0.07 of it, a decade in ten from 0.1 at 10.
    assert choice.expected_ms == pytest.approx(30.0)
    assert choice.iterations >= 20  # room for hard frames
    choice = choose(Calibration("there", (PLAIN, FAST)), 1000, tolerance=0.0201)
    assert (choice.method, choice.expected_ms) == ("net", 21.0)


def test_a_frame_that_ends_in_another_minimum_forbids_no_tolerance():
    stuck = {**PLAIN.p99, "160": 2e-3}  # whatever the iterations
    choice = choose(
        Calibration("here", (Method(SOLVER, 1000, 1.0, 1.0, PLAIN.median, stuck),)), 1000, tolerance=1e-3
    )
    assert choice.method == SOLVER
    assert choice.expected_ms == pytest.approx(161.0)
    assert "in the median frame" in choice.reason


def test_costs_grow_with_the_garment_from_the_nearest_size():
    calibration = Calibration("here", (PLAIN, LARGE))
    assert choose(calibration, 8000, budget_ms=100.0).iterations == 11  # 8 ms, and 8 ms an iteration
    assert choose(calibration, 500, budget_ms=10.0).iterations == 19


def test_a_frame_costs_as_much_as_its_substeps():
    calibration = Calibration("here", (PLAIN,))  # 1 ms, and 1 ms an iteration
    choice = choose(calibration, 1000, budget_ms=22.0, substeps=2)
    assert (choice.iterations, choice.expected_ms) == (10, pytest.approx(22.0))
    assert expected_ms(calibration, 1000, SOLVER, 10, 3) == pytest.approx(33.0)


def test_an_iteration_costs_the_same_behind_every_method():
    """Two speeds of the machine, one per turn, and one disturbed timing."""
    times = {("solver", 10): [7.0, 14.0, 7.0, 7.0], ("solver", 60): [22.0, 44.0, 22.0, 22.0]}
    times |= {("net", 10): [9.0, 18.0, 9.0, 9.0], ("net", 60): [24.0, 48.0, 24.0, 90.0]}
    fixed, iteration = fit_costs(times)
    assert iteration == pytest.approx(0.3)
    assert fixed == pytest.approx({"solver": 4.0, "net": 6.0})


def test_methods_are_compared_within_turns():
    """Turns that take longer for all, and one in which the first method alone was disturbed."""
    added = np.array([0.0, 3.0, 0.0, 5.0, 8.0])
    disturbed = np.array([9.0, 3.0, 0.0, 5.0, 8.0])
    times = {("solver", 10): 7.0 + disturbed, ("solver", 60): 22.0 + disturbed}
    times |= {("net", 10): 9.0 + added, ("net", 60): 24.0 + added}
    fixed, _ = fit_costs({run: list(values) for run, values in times.items()})
    assert fixed["net"] - fixed["solver"] == pytest.approx(2.0)


def test_what_is_out_of_reach_is_said():
    calibration = Calibration("here", (PLAIN,))
    with pytest.raises(ConfigError, match=r"fastest frame here takes 2\.0 ms"):
        choose(calibration, 1000, budget_ms=1.0)
    with pytest.raises(ConfigError, match=r"best that was measured here is 0\.001%"):
        choose(calibration, 1000, tolerance=1e-6)
    with pytest.raises(ConfigError, match="either"):
        choose(calibration, 1000)


def test_calibrations_survive_a_round_trip_and_damage_is_named(tmp_path):
    path = tmp_path / "calibration.json"
    calibration = Calibration("here", (PLAIN, SLOW))
    write_calibration(calibration, path, {"jax": "0.10.2"})
    assert read_calibration(path) == calibration
    path.write_text(path.read_text()[:100])
    with pytest.raises(AssetError, match="eslr calibrate"):
        read_calibration(path)


@pytest.mark.parametrize(("text", "value"), [("20ms", 20.0), ("0.1s", 100.0), (None, None)])
def test_budgets_are_times(text, value):
    assert parse_budget(text) == (None if value is None else pytest.approx(value))


@pytest.mark.parametrize("text", ["20", "fast", "-3ms", "nanms", "infs", "ms"])
def test_other_budgets_are_refused(text):
    with pytest.raises(ConfigError, match="20ms"):
        parse_budget(text)


@pytest.mark.parametrize(("text", "value"), [("1%", 0.01), ("0.02", 0.02), (None, None)])
def test_tolerances_are_shares(text, value):
    assert parse_share(text) == (None if value is None else pytest.approx(value))


@pytest.mark.parametrize("text", ["0", "100%", "1", "-1%", "nan", "few"])
def test_other_tolerances_are_refused(text):
    with pytest.raises(ConfigError, match="1%"):
        parse_share(text)


def test_nothing_asked_for_is_a_tolerance():
    assert parse_request(None, None, is_chosen=True) == (None, 0.01)
    assert parse_request(None, "2%", is_chosen=True) == (None, 0.02)
    assert parse_request("20ms", None, is_chosen=True) == (20.0, None)
    assert parse_request(None, None, is_chosen=False) == (None, None)


@pytest.mark.parametrize(
    ("models", "has_coarse_edges"), [((SOLVER, "mgn-5-correction"), False), (("hood-5-correction",), True)]
)
def test_scenes_have_the_coarse_edges_that_their_networks_read(models, has_coarse_edges):
    scene = example_scene("tshirt", "1k", "cmu_016_32", 2, has_coarse_edges=read_coarse_edges(models))
    assert (scene.garment.coarse is not None) == has_coarse_edges
