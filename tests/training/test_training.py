"""Training runs: what they leave, how they stop and resume, and what they learn from."""

import dataclasses
import json
import os
import shutil
import signal
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eslr_jax.assets import load_model, split_clips
from eslr_jax.config import TrainConfig, from_dict, to_dict
from eslr_jax.contact.nearest import find_contacts
from eslr_jax.errors import CheckpointError, ConfigError
from eslr_jax.models.registry import MODELS, init_model
from eslr_jax.physics.potential import potential
from eslr_jax.physics.problem import pushed_out_guess
from eslr_jax.scene.build import initial_state
from eslr_jax.simulation.network import refine
from eslr_jax.training.checkpoint import Checkpoints, read_run_config, write_run_config
from eslr_jax.training.loop import train
from eslr_jax.training.loss import physics_loss
from eslr_jax.training.pool import start_trajectory
from eslr_jax.training.recipe import load_recipe
from eslr_jax.training.step import make_schedule

RECIPES = Path(__file__).parents[2] / "experiments" / "configs"


@pytest.fixture(scope="module")
def config(cheap_model):
    return TrainConfig(
        model=cheap_model, steps=6, warmup=2, slots_per_garment=2, log_every=2, checkpoint_every=2
    )


@pytest.fixture(scope="module")
def finished(config, small_data, tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    return train(config, folder, datasets=(small_data,)), folder


def test_run_leaves_metrics_and_a_model(finished, config):
    state, folder = finished
    records = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    assert [record["step"] for record in records] == [2, 4, 6]
    assert all(np.isfinite(list(record.values())).all() for record in records)
    assert int(state.skipped) == 0
    params, model = load_model(folder / "model.npz")
    assert model == config.model
    jax.tree.map(np.testing.assert_array_equal, params["params"], state.params["params"])


def test_weights_move_as_far_as_adam_takes_them(finished, config):
    state, _ = finished
    before = init_model(config.model, config.seed)["params"]
    moved = jax.tree.map(lambda new, old: float(jnp.max(jnp.abs(new - old))), state.params["params"], before)
    rates = sum(float(make_schedule(config)(step)) for step in range(config.steps))
    largest = max(jax.tree.leaves(moved))
    # Its first step is the rate itself; a later one is at most 0.1 / sqrt(0.001) rates.
    assert 0.5 * rates < largest < 3.2 * rates
    assert sum(value > 0.0 for value in jax.tree.leaves(moved)) > 0.8 * len(jax.tree.leaves(moved))


@pytest.mark.slow
def test_interrupted_run_resumes_bit_by_bit(finished, config, small_data, tmp_path):
    whole, _ = finished

    def interrupt(done, total, metrics):
        if done == 4:
            os.kill(os.getpid(), signal.SIGTERM)

    part = train(config, tmp_path, datasets=(small_data,), on_progress=interrupt)
    assert int(part.step) < config.steps
    assert not (tmp_path / "model.npz").exists()
    resumed = train(config, tmp_path, datasets=(small_data,), resume=True)
    jax.tree.map(np.testing.assert_array_equal, resumed, whole)


@pytest.mark.slow
def test_interrupted_at_ten_points_it_ends_bit_by_bit_as_the_whole(config, small_data, tmp_path):
    config = dataclasses.replace(config, steps=12, log_every=1, checkpoint_every=4)
    whole = train(config, tmp_path / "whole", datasets=(small_data,))
    points = []

    def interrupt(done, total, metrics):
        points.append(done)
        os.kill(os.getpid(), signal.SIGTERM)

    for point in range(1, 11):
        part = train(
            config, tmp_path / "part", datasets=(small_data,), resume=point > 1, on_progress=interrupt
        )
        assert int(part.step) == point
    assert points == list(range(1, 11))
    resumed = train(config, tmp_path / "part", datasets=(small_data,), resume=True)
    jax.tree.map(np.testing.assert_array_equal, resumed, whole)


def test_a_folder_in_use_is_not_overwritten(finished, config):
    _, folder = finished
    before = (folder / "metrics.jsonl").read_text()
    with pytest.raises(CheckpointError, match="--resume"):
        train(config, folder)
    with pytest.raises(CheckpointError, match="another configuration"):
        train(dataclasses.replace(config, seed=1), folder, resume=True)
    assert (folder / "metrics.jsonl").read_text() == before


def test_resuming_nothing_is_refused(config, tmp_path):
    with pytest.raises(CheckpointError, match="no training run"):
        train(config, tmp_path, resume=True)


def test_half_written_checkpoint_is_not_taken(finished):
    """A folder that orbax has not renamed yet is no checkpoint."""
    _, folder = finished
    latest = Checkpoints(folder).latest()
    (folder / "checkpoints" / f"{latest + 1}.orbax-checkpoint-tmp-1").mkdir()
    assert Checkpoints(folder).latest() == latest


@pytest.mark.slow
def test_a_damaged_checkpoint_gives_way_to_the_one_before(finished, config, small_data, tmp_path):
    _, folder = finished
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    for path in (tmp_path / "checkpoints" / "6").rglob("*"):
        if path.is_file():
            path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.warns(UserWarning, match="checkpoint 6 can't be read and was removed; going on from 4"):
        state = train(config, tmp_path, datasets=(small_data,), resume=True)
    whole, _ = finished
    for ours, theirs in zip(jax.tree.leaves(state), jax.tree.leaves(whole), strict=True):
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.slow
def test_a_finished_run_is_extended_but_not_cut(finished, config, small_data, tmp_path):
    _, folder = finished
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    with pytest.raises(CheckpointError, match="it can be extended to more, not cut to 4"):
        train(dataclasses.replace(config, steps=4), tmp_path, resume=True)
    longer = dataclasses.replace(config, steps=8)
    assert int(train(longer, tmp_path, datasets=(small_data,), resume=True).step) == 8
    assert read_run_config(tmp_path) == longer
    records = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert [record["step"] for record in records] == [2, 4, 6, 8]


def test_a_folder_without_a_checkpoint_starts_anew(config, small_data, tmp_path):
    write_run_config(tmp_path, config)
    with pytest.raises(CheckpointError, match="no checkpoint to resume from; start without --resume"):
        train(config, tmp_path, datasets=(small_data,), resume=True)
    assert int(train(config, tmp_path, datasets=(small_data,)).step) == config.steps


def test_unknown_split_lists_what_exists():
    with pytest.raises(ConfigError, match="validation"):
        split_clips("holdout")


def test_overrides_may_name_another_model(tmp_path):
    recipe = tmp_path / "recipe.toml"
    recipe.write_text('model = "eslr-small"')
    config = load_recipe(recipe, {"model": "mgn-small", "model.refinement_steps": 4})
    assert config.model == dataclasses.replace(MODELS["mgn-small"], refinement_steps=4)


def test_bodies_of_trajectories_differ_in_girth_and_cloth_starts_outside_them(config, small_data):
    config = dataclasses.replace(config, girth=0.01, noise=0.0)
    garment = small_data.garment(0)
    start = jax.jit(partial(start_trajectory, data=small_data, garment=garment, config=config))
    slots = [start(jax.random.key(seed)) for seed in range(4)]
    girths = np.array([slot.girth for slot in slots])
    assert np.ptp(girths) > 2e-3
    assert np.all(np.abs(girths) <= 0.01)
    for slot in slots:
        transforms = small_data.transforms(slot.frame, slot.yaw)
        thin, own = small_data.body(transforms, jnp.float32(0.0)), small_data.body(transforms, slot.girth)
        np.testing.assert_allclose(np.linalg.norm(own - thin, axis=-1), abs(slot.girth), rtol=0.1)
        contacts = find_contacts(slot.state.position, own, own, small_data.surface)
        assert np.min(contacts.distances) > 0


def test_contraction_weighs_each_refinement_step_by_what_it_leaves(config, small_problem):
    """The mean share of the gap that a step leaves; the last energy stands for the optimum."""
    model = dataclasses.replace(config.model, refinement_steps=3)
    config = dataclasses.replace(config, model=model, refinement_weights="contraction")
    params = init_model(model)
    state = initial_state(small_problem.position, jnp.zeros_like(small_problem.position))

    @jax.jit
    def loss_and_energies(problem):
        loss, _ = physics_loss(params, problem, state, config)
        positions = refine(params, problem, state, model).positions
        points = jnp.concatenate([pushed_out_guess(problem)[None], positions])
        return loss, jax.lax.map(lambda x: potential(x, problem), points)

    loss, energies = jax.device_get(loss_and_energies(small_problem))
    gaps = energies[:-1] - energies[-1]
    assert gaps[0] > 0
    expected = np.mean((energies[1:] - energies[-1]) / np.maximum(gaps, 0.01 * gaps[0]))
    np.testing.assert_allclose(loss, expected, rtol=1e-4)


@pytest.mark.slow
def test_a_network_for_the_solver_trains_from_optima(config, small_data, tmp_path):
    """Gap and distance to where the solver ends shrink."""
    model = dataclasses.replace(MODELS["smooth-small"], latent_size=16)
    config = dataclasses.replace(config, model=model, steps=60, iterations=10, log_every=10)
    state = train(config, tmp_path, datasets=(small_data,))
    losses = [json.loads(line)["loss"] for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert int(state.skipped) == 0
    assert np.mean(losses[-2:]) < losses[0] - 0.03
    with pytest.raises(ConfigError, match="iterations"):
        from_dict(TrainConfig, {**to_dict(config), "energy_set": "hood"})


@pytest.mark.slow
def test_hoods_recipe_takes_finite_steps(small_data, tmp_path):
    overrides = {
        "steps": 3,
        "log_every": 1,
        "model": "mgn-15",
        "model.message_passing_steps": 2,
        "model.latent_size": 16,
    }
    config = load_recipe(RECIPES / "paper" / "full-size.toml", overrides)
    assert config.energy_set == "hood"
    state = train(config, tmp_path, datasets=(small_data,))
    assert int(state.skipped) == 0
    counts = [float(entry.count) for entry in state.params["statistics"].values()]
    assert min(counts) >= 3 * 60, "three frames of sixty vertices, or more edges"
