"""Fields of a run: values by which a garment is coloured."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from eslr_jax.evaluation.hard_cases.build import join_meshes, make_cloth, sheet
from eslr_jax.simulate.step import FrameInput, frame_problem, solve
from example_runs import write_run

from eslr_jax.config import SimConfig
from eslr_jax.errors import AssetError
from eslr_jax.evaluation.fields import _prepared, _scene, energy_shares, gap_shares, run_field
from eslr_jax.evaluation.gap import trajectory_states
from eslr_jax.io.run import read_run
from eslr_jax.physics.materials import COTTON
from eslr_jax.physics.potential import PotentialTerms, potential, potential_terms
from eslr_jax.physics.problem import PhysicsParameters, start_guess
from eslr_jax.scene import initial_state


@pytest.fixture(scope="module")
def runs(tmp_path_factory, body):
    folder = tmp_path_factory.mktemp("runs")
    return [
        read_run(write_run(folder, body, name, scale)) for name, scale in (("loose", 1.0), ("tight", 1.2))
    ]


def test_stretch_of_uniform_stretch(runs):
    field = run_field(runs[0], "stretch")
    np.testing.assert_allclose(field.values[0], 1.0, atol=1e-4)
    assert field.values[1].min() > 1.0
    assert 1.05 < np.median(field.values[1]) <= field.values[1].max() < 1.1 + 1e-3
    np.testing.assert_allclose(field.values[2], field.values[0], atol=1e-4)


@pytest.fixture(scope="module")
def last_problem(runs):
    """The last frame of a run as its simulation stated it, with garment and fabric."""
    garment, material = _prepared(runs[0])
    scene = _scene(runs[0], garment, material, has_contact=True)
    parameters = PhysicsParameters()
    state, inputs = jax.tree.map(
        lambda leaf: leaf[-1], trajectory_states(runs[0].trajectory, scene, parameters)
    )
    config = SimConfig(simulator="physics", self_contact=True)
    problem = frame_problem(garment, state, inputs, scene.surface, scene.timestep, parameters, config)
    return problem, garment, material


@pytest.mark.slow
@pytest.mark.parametrize("term", PotentialTerms._fields)
def test_energy_shares_add_up_to_the_energy(runs, last_problem, term):
    problem, garment, material = last_problem
    answer = jnp.asarray(runs[0].trajectory.positions[-1])
    whole = float(getattr(potential_terms(answer, problem, garment, material), term))
    shares = run_field(runs[0], f"{term}-energy").values[-1] * np.asarray(garment.vertex_areas)
    assert shares.sum() == pytest.approx(whole, rel=1e-3, abs=1e-6)
    assert whole != 0 or term == "repulsion"  # no two layers meet


@pytest.mark.slow
def test_gap_shares_add_up_to_the_optimality_gap(runs, last_problem):
    problem, garment, material = last_problem
    answer = start_guess(problem, garment)
    minimum = solve(problem, garment, material, answer, iterations=500, memory=8, tolerance=1e-3)
    gap = float(potential(answer, problem, garment, material) - minimum.value)
    shares = np.asarray(gap_shares(answer, problem, garment, material))
    assert gap > 1e-3
    assert shares.sum() == pytest.approx(gap, rel=0.01)  # contacts have kinks
    assert -shares[shares < 0].sum() < 0.5 * gap
    at_optimum = gap_shares(minimum.position, problem, garment, material)
    assert abs(float(at_optimum.sum())) < 0.01 * gap


@pytest.mark.slow
def test_repulsion_counts_where_layers_meet():
    """Two sheets 1 mm apart: the pairs' energy goes to both layers."""
    lower = sheet(6, 6, (0.1, 0.1))
    upper = lower[0] + np.array([0.003, 1e-3, 0.002]), lower[1]
    garment = make_cloth(join_meshes(lower, upper), {}, allow_components=True)
    still = jnp.asarray(garment.rest_positions)
    state = initial_state(still, jnp.zeros_like(still))
    problem = frame_problem(
        garment,
        state,
        FrameInput(None, None, None),
        None,
        jnp.float32(1 / 30),
        PhysicsParameters(),
        SimConfig(simulator="physics", self_contact=True),
    )
    whole = float(potential_terms(still, problem, garment, COTTON).repulsion)
    shares = np.asarray(energy_shares("repulsion", still, problem, garment, COTTON))
    assert whole > 0
    assert shares.sum() == pytest.approx(whole, rel=1e-4)
    assert min(shares[:36].sum(), shares[36:].sum()) > 0.2 * whole


@pytest.mark.parametrize(("name", "change", "message"), [
    ("gap", {"contact_faces": None, "body_rest_positions": None}, "rest pose, which contacts need"),
    ("friction-energy", {"body_positions": None, "body_faces": None}, "has no body, and so no friction-energy"),
    ("distance", {"body_positions": None, "body_faces": None}, "has no body"),
])  # fmt: skip
def test_what_a_run_lacks_for_a_field_is_said(runs, name, change, message):
    run = dataclasses.replace(runs[0], trajectory=dataclasses.replace(runs[0].trajectory, **change))
    with pytest.raises(AssetError, match=message) as caught:
        run_field(run, name)
    assert "\n" not in str(caught.value)


def test_a_run_without_self_contact_has_no_repulsion(runs):
    with pytest.raises(AssetError, match="without --self-contact"):
        run_field(dataclasses.replace(runs[0], report={}), "repulsion-energy")


def test_distance_grows_by_what_the_cloth_is_moved(runs):
    field = run_field(runs[0], "distance")
    assert np.all(field.values[0] > 0)
    np.testing.assert_allclose(field.values[0], field.values[3])
    with pytest.raises(AssetError, match="no field 'warmth'"):
        run_field(runs[0], "warmth")
