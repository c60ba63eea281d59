"""What a frame costs, and what a budget pays for, from measurements that are given."""

import numpy as np
import pytest

from eslr_jax import AssetError, ConfigError
from eslr_jax.pipeline.assets.budget import (
    SOLVER,
    Calibration,
    Cost,
    first_iterations,
    keep_budget,
    read_calibration,
    write_calibration,
)
from eslr_jax.pipeline.report.calibrate import calibrate, example_scene, fit_costs, read_coarse_edges

PLAIN = Cost(SOLVER, 1000, 1.0, 1.0)
NET = Cost("net", 1000, 21.0, 1.0)
LARGE = Cost(SOLVER, 4000, 4.0, 4.0)


def test_a_budget_pays_for_iterations():
    assert first_iterations(PLAIN, 22.0) == 21
    assert first_iterations(PLAIN, 1e6) == 160  # more gain little
    assert first_iterations(NET, 23.0) == 2
    with pytest.raises(ConfigError, match=r"fastest frame here takes 2\.0 ms"):
        first_iterations(PLAIN, 1.0)


def test_a_budget_is_kept_on_a_machine_of_another_speed():
    assert first_iterations(PLAIN, 31.0) == 30  # 1 ms, and 1 ms an iteration
    pace = keep_budget(PLAIN, 31.0)
    assert pace(30, 31.0) == 30
    assert pace(30, 62.0) == 14  # twice as slow: 2 ms, and 2 ms an iteration
    assert pace(14, 30.0) == 14
    assert pace(30, 15.5) == 61
    assert pace(30, 3100.0) == 5  # fewer would be no cloth
    assert pace(30, 0.31) == 160


def test_costs_grow_with_the_garment_from_the_nearest_size_and_with_substeps():
    calibration = Calibration("here", (PLAIN, NET, LARGE))
    assert calibration.cost(8000) == Cost(SOLVER, 8000, 8.0, 8.0)
    assert calibration.cost(500) == Cost(SOLVER, 500, 0.5, 0.5)
    assert calibration.cost(1000, "net").frame_ms(10) == pytest.approx(31.0)
    assert calibration.cost(1000, "unknown") == PLAIN
    assert calibration.cost(1000, SOLVER, 3).frame_ms(10) == pytest.approx(33.0)


def test_an_iteration_costs_the_same_behind_every_method():
    """Two speeds of the machine, one per turn, and one disturbed timing."""
    times = {("solver", 20): [10.0, 20.0, 10.0, 10.0], ("solver", 60): [22.0, 44.0, 22.0, 22.0]}
    times |= {("net", 20): [12.0, 24.0, 12.0, 12.0], ("net", 60): [24.0, 48.0, 24.0, 90.0]}
    fixed, iteration = fit_costs(times)
    assert iteration == pytest.approx(0.3)
    assert fixed == pytest.approx({"solver": 4.0, "net": 6.0})


def test_methods_are_compared_within_turns():
    """Turns that take longer for all, and one in which the first method alone was disturbed."""
    added = np.array([0.0, 3.0, 0.0, 5.0, 8.0])
    disturbed = np.array([9.0, 3.0, 0.0, 5.0, 8.0])
    times = {("solver", 20): 10.0 + disturbed, ("solver", 60): 22.0 + disturbed}
    times |= {("net", 20): 12.0 + added, ("net", 60): 24.0 + added}
    fixed, _ = fit_costs({run: list(values) for run, values in times.items()})
    assert fixed["net"] - fixed["solver"] == pytest.approx(2.0)


def test_calibrations_survive_a_round_trip_and_damage_is_named(tmp_path):
    path = tmp_path / "calibration.json"
    calibration = Calibration("here", (PLAIN, NET))
    write_calibration(calibration, path, {"jax": "0.10.2"})
    assert read_calibration(path) == calibration
    path.write_text(path.read_text()[:100])
    with pytest.raises(AssetError, match="eslr calibrate"):
        read_calibration(path)


@pytest.mark.slow
def test_the_machine_is_calibrated():
    costs = calibrate((), sizes=("1k",)).costs
    assert [cost.name for cost in costs] == [SOLVER]
    assert 900 < costs[0].vertices < 2000
    assert 0 < costs[0].iteration_ms < costs[0].fixed_ms


def test_scenes_have_the_coarse_edges_that_their_networks_read():
    assert not read_coarse_edges((SOLVER, "mgn-5-correction"))
    assert read_coarse_edges(("hood-5-correction",))
    scene = example_scene("tshirt", "1k", "cmu_016_32", 2, has_coarse_edges=True)
    assert scene.garment.coarse is not None
