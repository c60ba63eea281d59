"""What is left of a network without a part of it."""

from __future__ import annotations

import dataclasses
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from draped_ball import drifting_ball, square

from eslr_jax import (
    ConfigError,
    Network,
    SimConfig,
    load_body,
    load_garment,
    load_motion,
    pose_body,
    prepare_scene,
    rollout_scene,
    score_trajectory,
    simulate,
)
from eslr_jax.mesh.padding import choose_bucket, pad_garment
from eslr_jax.networks.eslr import Eslr
from eslr_jax.networks.registry import MODELS
from eslr_jax.pipeline.report.evaluate import (
    Control,
    EvaluationOptions,
    control_garment,
    control_network,
    evaluate,
)
from eslr_jax.pipeline.report.gap import stepped_potentials, trajectory_gap
from eslr_jax.simulation.frame import first_problem
from eslr_jax.simulation.plan import shared_surface
from eslr_jax.terms import CLOTH

SIZES = {"message_passing_steps": 1, "latent_size": 8, "attention_size": 4, "attention_features": 8}
CONFIG = dataclasses.replace(MODELS["eslr-5"], correction_scale=0.005, attention_blocks=1, **SIZES)


@pytest.fixture(scope="module")
def trained():
    network = CONFIG.new_network(seed=3)
    return network.replace(params=jax.tree.map(lambda leaf: leaf + 0.05, network.params))


@pytest.fixture(scope="module")
def scene():
    options = {"terms": CLOTH, "starts_at_rest": True}
    return prepare_scene(square(6), drifting_ball(4), **options)


@pytest.fixture(scope="module")
def moves(trained, scene):
    """How far the prediction is from the solver's guess [m], by control."""

    @jax.jit
    def move(network, scene):
        prediction = network.predict(first_problem(scene), scene.initial_state)
        return prediction.position - prediction.guess.position

    return {
        control: move(
            trained if control is None else control_network(control, trained),
            scene if control is None else scene.replace(garment=control_garment(control, scene.garment)),
        )
        for control in (None, *get_args(Control))
    }


def test_without_a_decoder_the_guess_is_left(moves):
    assert np.abs(moves[None]).max() > 1e-4
    np.testing.assert_array_equal(moves["no_decoder"], 0)


def test_untrained_weights_and_other_embeddings_predict_otherwise(moves):
    for control in ("untrained", "no_embedding", "random_embedding"):
        assert not np.array_equal(moves[control], moves[None]), control


def test_a_network_without_attention_has_no_coordinates_to_lose():
    with pytest.raises(ConfigError, match="only attention reads"):
        control_network("no_embedding", Network({}, MODELS["mgn-5"]))


def test_random_coordinates_keep_their_spread(scene):
    given = scene.garment.geodesic_embedding
    drawn = control_garment("random_embedding", scene.garment).geodesic_embedding
    np.testing.assert_allclose(jnp.std(drawn, axis=0), jnp.std(given, axis=0), rtol=0.5)
    assert not np.allclose(drawn, given)


def test_random_coordinates_are_those_of_the_garment_in_any_bucket():
    given = square(6)
    padded = pad_garment(given, choose_bucket(given))
    count = len(given.vertex_mask)
    assert len(padded.vertex_mask) > count
    drawn = control_garment("random_embedding", given).geodesic_embedding
    again = control_garment("random_embedding", padded).geodesic_embedding
    np.testing.assert_allclose(again[:count], drawn, rtol=1e-5)
    np.testing.assert_array_equal(again[count:], 0)


@pytest.mark.slow
def test_single_frames_of_the_solver_reach_its_own_potentials(scene):
    config = SimConfig(iterations=20)
    trajectory = rollout_scene(None, scene, config)
    gap = trajectory_gap(trajectory, scene, every=1)
    again = stepped_potentials(None, trajectory, scene, config, 1)
    np.testing.assert_allclose(again, gap.reached, rtol=1e-4, atol=1e-7)


# --- how good a network is ----------------------------------------------------------------------------------

TINY = Eslr(message_passing_steps=1, attention_blocks=0, latent_size=8)


@pytest.mark.slow
def test_a_network_s_rollout_scores_as_evaluate_says():
    network = TINY.new_network()
    frames, every = 6, 2
    options = EvaluationOptions(
        garments=("tshirt",), clips=("cmu_016_32",), gap_frames=frames, every=every, rollout_frames=4
    )
    expected = evaluate(network, options, iterations=5)["on_policy"]
    body, garment = load_body(), load_garment("tshirt", pad=True)
    poses = pose_body(body, load_motion("cmu_016_32"), num_frames=frames)
    scene = prepare_scene(garment, poses, surface=shared_surface([garment], body))
    own = simulate(network, scene, config=SimConfig(iterations=5)).trajectory
    score = score_trajectory(own, scene, every=every)
    assert score["gap_frames"] == expected["frames"]
    assert score["gap_relative_median"] == pytest.approx(expected["gap_relative_median"], rel=0.02)
    assert score["gap_median_j"] == pytest.approx(expected["gap_median_j"], rel=0.02)


@pytest.mark.slow
def test_an_evaluation_without_the_gap_has_the_rollouts():
    network = TINY.new_network()
    options = EvaluationOptions(garments=("tshirt",), clips=("cmu_016_32",), gap_frames=0, rollout_frames=4)
    result = evaluate(network, options)
    assert not {"gap_median_j", "on_policy"} & set(result)
    assert [(row["garment"], row["clip"]) for row in result["scenes"]] == [("tshirt", "cmu_016_32")]
    assert result["rollout"]["drift_mm_s_of"].keys() == {"tshirt"}
