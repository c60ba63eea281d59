"""Fields of a run: values by which a garment is coloured."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cloth import make_limb
from draped_ball import drifting_ball, square
from example_runs import write_run as write_run_by_hand
from garment_files import stored
from own_term import Push

from eslr_jax import (
    AssetError,
    SimConfig,
    prepare_scene,
    rollout_scene,
    save_scene,
    scene_terms,
    score_trajectory,
)
from eslr_jax.pipeline.report.fields import energy_shares, gap_shares, run_field
from eslr_jax.pipeline.report.run import ClothTrack, read_run, run_poses, run_trajectory, write_run
from eslr_jax.simulation.frame import first_problem
from eslr_jax.simulation.plan import first_frames
from eslr_jax.solver.guess import Start, pushed_out_guess
from eslr_jax.solver.potential import potential, potential_terms
from eslr_jax.solver.solve import solve
from eslr_jax.terms import FAST, Gravity


@pytest.fixture(scope="module")
def runs(tmp_path_factory, body):
    folder = tmp_path_factory.mktemp("runs")
    return [
        read_run(write_run_by_hand(folder, body, name, scale))
        for name, scale in (("loose", 1.0), ("tight", 1.2))
    ]


def test_stretch_of_uniform_stretch(runs):
    field = run_field(runs[0], "stretch")
    np.testing.assert_allclose(field.values[0], 1.0, atol=1e-4)
    assert field.values[1].min() > 1.0
    assert 1.05 < np.median(field.values[1]) <= field.values[1].max() < 1.1 + 1e-3
    np.testing.assert_allclose(field.values[2], field.values[0], atol=1e-4)


@pytest.fixture(scope="module")
def problem():
    """The first frame of a square that lies on a ball, by vertices and by faces."""
    scene = prepare_scene(square(), drifting_ball(4), terms=FAST)
    start = scene.initial_state
    loaded = start.replace(friction_load=jnp.full_like(start.friction_load, 1e-3))
    return jax.jit(first_problem)(scene.replace(initial_state=loaded))


@pytest.mark.parametrize("term", ["stretch", "bending", "inertia", "gravity", "collision", "friction"])
def test_energy_shares_add_up_to_the_energy(problem, term):
    noise = 5e-4 * np.random.default_rng(0).standard_normal(problem.position.shape)
    position = problem.position + jnp.asarray(noise + np.array([2e-3, -6e-3, 0.0]), jnp.float32)
    whole = float(potential_terms(position, problem)[term])
    shares = np.asarray(energy_shares(term, position, problem))
    assert shares.sum() == pytest.approx(whole, rel=1e-3)
    assert abs(whole) > 1e-9


@pytest.mark.slow
def test_gap_shares_add_up_to_the_optimality_gap(problem):
    position = pushed_out_guess(problem)
    start = Start(position, potential(position, problem))
    minimum = solve(problem, start, iterations=500, tolerance=1e-3)
    gap = float(potential(position, problem) - minimum.value)
    shares = np.asarray(gap_shares(position, problem))
    assert shares.sum() == pytest.approx(gap, rel=0.01)  # contacts have kinks
    assert -shares[shares < 0].sum() < 0.5 * gap
    at_optimum = gap_shares(minimum.position, problem)
    assert abs(float(at_optimum.sum())) < 0.01 * gap


@pytest.mark.slow
def test_a_run_with_an_energy_of_ones_own_is_scored_from_its_files(tmp_path, small_garment, small_poses):
    """Its term is found where its module is imported."""
    terms = scene_terms(Gravity(1.62), Push(2.0))
    scene = prepare_scene(small_garment, small_poses, terms=terms, integrator="bdf2")
    whole = rollout_scene(None, scene, SimConfig(iterations=60))
    garment = stored(*map(np.asarray, (scene.garment.rest_positions, scene.garment.faces)))
    track = ClothTrack(whole.positions, whole.velocities, whole.friction_loads, whole.residuals)
    write_run(tmp_path, track, scene, (make_limb(), small_poses, garment), report={})
    run = read_run(tmp_path)
    jax.tree.map(np.testing.assert_array_equal, run.scene, scene)
    scores = [
        score_trajectory(trajectory, each, poses=run_poses(run), every=1)
        for trajectory, each in ((run_trajectory(run), run.scene), (whole, scene))
    ]
    assert scores[0]["terms"]["push"] == pytest.approx(scores[1]["terms"]["push"], rel=1e-4)
    assert scores[0]["gap_median_j"] == pytest.approx(scores[1]["gap_median_j"], rel=1e-2, abs=1e-7)
    assert scores[0]["gap_relative_max"] < 0.5


@pytest.mark.parametrize("spoil", ["missing", "damaged", "another"])
def test_a_run_without_its_scene_is_shown_and_not_scored(tmp_path, body, spoil):
    folder = write_run_by_hand(tmp_path, body, "run")
    if spoil == "missing":
        (folder / "scene.npz").unlink()
    elif spoil == "damaged":
        (folder / "scene.npz").write_bytes(b"PK")
    else:
        scene = read_run(folder).scene
        save_scene(folder / "scene.npz", first_frames(scene, 3))
    run = read_run(folder)
    assert run_field(run, "distance").values.shape == (6, len(run.garment.rest_positions))
    with pytest.raises(AssetError, match=r"scene\.npz") as caught:
        run_trajectory(run)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["friction-energy", "distance"])
def test_a_run_without_a_body_has_no_field_of_it(runs, name):
    run = dataclasses.replace(runs[0], trajectory=dataclasses.replace(runs[0].trajectory, body=None))
    with pytest.raises(AssetError, match=f"has no body, and so no {name}") as caught:
        run_field(run, name)
    assert "\n" not in str(caught.value)


def test_distance_grows_by_what_the_cloth_is_moved(runs):
    field = run_field(runs[0], "distance")
    assert np.all(field.values[0] > 0)
    np.testing.assert_allclose(field.values[0], field.values[3])
    with pytest.raises(AssetError, match="no field 'warmth'"):
        run_field(runs[0], "warmth")
