"""Training runs: what they leave, how they stop and resume, and what they learn from."""

import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
import pytest
from draped_ball import drifting_ball, square

from eslr_jax import CheckpointError, ConfigError, TrainConfig, load_model, prepare_scene
from eslr_jax.networks.normalizer import WARMUP_UPDATES
from eslr_jax.networks.registry import MODELS
from eslr_jax.pipeline.assets.models import load_training_data, model_record
from eslr_jax.simulation.frame import first_problem
from eslr_jax.solver.guess import pushed_out_guess
from eslr_jax.solver.potential import potential
from eslr_jax.terms import FAST
from eslr_jax.training.checkpoint import Checkpoints, read_earlier, read_run_config, write_run_config
from eslr_jax.training.loop import export, train
from eslr_jax.training.loss import physics_loss
from eslr_jax.training.recipe import describe_train_config, load_recipe, read_train_config
from eslr_jax.training.step import curriculum, init_train_state, make_schedule, make_train_step

RECIPES = Path(__file__).parents[2] / "experiments" / "configs"


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
    network = load_model(folder / "model.npz")
    assert network.config == config.model
    jax.tree.map(np.testing.assert_array_equal, network, state.network)


@pytest.mark.parametrize(
    "earlier", [{"steps": 100, "core_hours": 2.0}, {"steps": 100}, {"converted_from": "hood.pth"}]
)
def test_the_record_counts_the_training_of_the_weights_that_a_run_started_from(
    finished, config, tmp_path, earlier
):
    state, folder = finished
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    write_run_config(tmp_path, config, earlier)
    own = model_record(folder / "model.npz")
    export(state, config, [tmp_path / "model.npz"], read_earlier(tmp_path))
    record = model_record(tmp_path / "model.npz")
    assert record["steps"] == own["steps"] + earlier.get("steps", 0)
    expected = own["core_hours"] + earlier["core_hours"] if "core_hours" in earlier else None
    assert record.get("core_hours") == pytest.approx(expected), "unknown where a stage's is unknown"


def test_weights_move_as_far_as_adam_takes_them(finished, config):
    state, _ = finished
    before = config.model.new_network(config.seed).params
    moved = jax.tree.map(lambda new, old: float(jnp.max(jnp.abs(new - old))), state.network.params, before)
    rates = sum(float(make_schedule(config)(step)) for step in range(config.steps))
    largest = max(jax.tree.leaves(moved))
    # Its first step is the rate itself; a later one is at most 0.1 / sqrt(0.001) rates.
    assert 0.5 * rates < largest < 3.2 * rates
    assert sum(value > 0.0 for value in jax.tree.leaves(moved)) > 0.8 * len(jax.tree.leaves(moved))


@pytest.mark.slow
@pytest.mark.parametrize("frames", [1, 3])
def test_interrupted_at_ten_points_it_ends_bit_by_bit_as_the_whole(frames, config, small_data, tmp_path):
    config = dataclasses.replace(config, steps=12, log_every=1, checkpoint_every=4, frames=frames)
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


def test_a_part_of_a_run_ends_by_the_clock(config, small_data, tmp_path):
    part = train(config, tmp_path, datasets=(small_data,), most_seconds=0.0)
    assert int(part.step) == 1
    assert Checkpoints(tmp_path).restore(part).step == 1
    assert not (tmp_path / "model.npz").exists()


def test_a_folder_in_use_is_not_overwritten(finished, config):
    _, folder = finished
    before = (folder / "metrics.jsonl").read_text()
    with pytest.raises(CheckpointError, match="--resume"):
        train(config, folder, datasets=())
    with pytest.raises(CheckpointError, match="another configuration"):
        train(dataclasses.replace(config, seed=1), folder, datasets=(), resume=True)
    assert (folder / "metrics.jsonl").read_text() == before


def test_resuming_nothing_is_refused(config, tmp_path):
    with pytest.raises(CheckpointError, match="no training run"):
        train(config, tmp_path, datasets=(), resume=True)


def test_half_written_checkpoint_is_not_taken(finished):
    """A folder that orbax has not renamed yet is no checkpoint."""
    state, folder = finished
    (folder / "checkpoints" / f"{int(state.step) + 1}.orbax-checkpoint-tmp-1").mkdir()
    assert Checkpoints(folder).restore(state).step == state.step


def test_a_checkpoint_that_cannot_be_written_says_what_to_do(finished, tmp_path, monkeypatch):
    """orbax raises the error of the checkpoint before when the next one is saved."""
    state, _ = finished
    checkpoints = Checkpoints(tmp_path)

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(ocp.CheckpointManager, "save", full)
    with pytest.raises(CheckpointError, match="No space left on device; free some space and resume"):
        checkpoints.save(state)


def damage(checkpoint):
    """Cut every file of a checkpoint in half."""
    for path in checkpoint.rglob("*"):
        if path.is_file():
            path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def test_a_damaged_checkpoint_is_kept_under_another_name_and_its_step_written_again(finished, tmp_path):
    state, folder = finished
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    for name in ("6.damaged", "6.damaged1"):  # as a run whose last step is damaged twice
        damage(tmp_path / "checkpoints" / "6")
        checkpoints = Checkpoints(tmp_path)
        with pytest.warns(UserWarning, match="checkpoint 6 can't be read"):
            assert checkpoints.restore(state).step == 4
        assert any((tmp_path / "checkpoints" / name).rglob("*"))
        checkpoints.save(state)
        checkpoints.close()
        assert Checkpoints(tmp_path).restore(state).step == 6


@pytest.mark.slow
def test_a_finished_run_is_extended_but_not_cut(finished, config, small_data, tmp_path):
    _, folder = finished
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    with pytest.raises(CheckpointError, match="it can be extended to more, not cut to 4"):
        train(dataclasses.replace(config, steps=4), tmp_path, datasets=(), resume=True)
    longer = dataclasses.replace(config, steps=8)
    assert int(train(longer, tmp_path, datasets=(small_data,), resume=True).step) == 8
    assert read_run_config(tmp_path) == longer
    records = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert [record["step"] for record in records] == [2, 4, 6, 8]


@pytest.mark.slow
def test_a_folder_without_a_checkpoint_starts_anew(config, small_data, tmp_path):
    write_run_config(tmp_path, config, {})
    (tmp_path / "metrics.jsonl").write_text('{"step": 2, "core_seconds": 1e6}\n')  # of a run that was deleted
    with pytest.raises(CheckpointError, match="no checkpoint to resume from; start without --resume"):
        train(config, tmp_path, datasets=(small_data,), resume=True)
    assert int(train(config, tmp_path, datasets=(small_data,)).step) == config.steps
    records = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert [record["step"] for record in records] == [2, 4, 6]
    assert records[-1]["core_seconds"] < 1e6


def test_overrides_may_name_another_model(tmp_path):
    recipe = tmp_path / "recipe.toml"
    recipe.write_text('model = "eslr-small"')
    config = load_recipe(recipe, {"model": "mgn-small", "model.refinement_steps": 4})
    assert config.model == dataclasses.replace(MODELS["mgn-small"], refinement_steps=4)


@pytest.mark.skipif(sys.platform != "linux", reason="needs glibc")
def test_kept_memory_is_not_asked_for_again():
    code = """
import resource
import numpy as np
from eslr_jax.training.loop import keep_memory
faults = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_minflt
def of_four_arrays():
    np.ones(2**23)  # 64 MB
    before = faults()
    for _ in range(4):
        np.ones(2**23)
    return faults() - before
given_back = of_four_arrays()
keep_memory()
print(of_four_arrays(), given_back)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    kept, given_back = map(int, done.stdout.split())
    assert kept < 100
    assert given_back > 4 * kept


@pytest.mark.slow
def test_a_batch_larger_than_the_pool_gets_more_slots(config, small_data):
    small = init_train_state(dataclasses.replace(config, slots_per_garment=1), (small_data,))
    assert small.pools[0].is_done.shape == (1,)
    config = dataclasses.replace(config, slots_per_garment=1, batch_size=5)
    state = init_train_state(config, (small_data,))
    assert state.pools[0].is_done.shape == (5,)
    state, metrics = make_train_step(config, 0)(state, small_data)
    assert np.isfinite(float(metrics["loss"]))
    assert np.all(np.array(state.pools[0].age) == 1), "every trajectory went on once"


@pytest.mark.slow
def test_the_criterion_changes_the_loss(cheap_model, small_data):
    """The body moves: the three readings look at different frames of it, and weigh collision differently."""
    config = TrainConfig(model=cheap_model, energy_set="hood", slots_per_garment=1, noise=0.0)
    losses = {}
    for criterion in ("postcvpr", "cvpr", "metric"):
        chosen = dataclasses.replace(config, criterion=criterion)
        state = init_train_state(chosen, (small_data,))
        losses[criterion] = float(make_train_step(chosen, 0)(state, small_data)[1]["loss"])
    assert np.isfinite(list(losses.values())).all()
    assert abs(losses["cvpr"] - losses["postcvpr"]) > 1e-3 * abs(losses["postcvpr"])
    assert abs(losses["metric"] - losses["postcvpr"]) > 1e-3 * abs(losses["postcvpr"])
    with pytest.raises(ConfigError, match='"cvpr" needs energy_set = "hood"'):
        read_train_config({**describe_train_config(config), "energy_set": "consistent", "criterion": "cvpr"})


def test_hoods_curriculum_counts_trajectories(config):
    """Steps of HOOD's run by which its iterations, and so its horizon and its collision ramp, are known."""
    hood = TrainConfig(model=config.model, schedule="hood", horizon=5, horizon_growth=5000)
    table = {0: (1, 0), 4_999: (1, 4_999), 5_000: (2, 5_000), 15_000: (3, 10_000), 29_999: (3, 14_999)}
    table |= {50_000: (5, 20_000), 200_000: (5, 50_000), 450_000: (5, 100_000)}
    for step, expected in table.items():
        assert tuple(int(value) for value in curriculum(hood, jnp.int32(step))) == expected
    plain = dataclasses.replace(config, horizon=3, horizon_growth=10)
    assert [int(curriculum(plain, jnp.int32(step)).horizon) for step in (9, 10, 20, 900)] == [1, 2, 3, 3]


@pytest.mark.slow
def test_contraction_weighs_each_refinement_step_by_what_it_leaves(config):
    """The mean share of the gap that a step leaves; the last energy stands for the optimum."""
    model = dataclasses.replace(config.model, refinement_steps=3)
    config = dataclasses.replace(config, model=model, refinement_weights="contraction")
    network = model.new_network()
    scene = prepare_scene(square(), drifting_ball(2), terms=FAST)
    state = scene.initial_state.replace(position=1.1 * scene.initial_state.position)  # stretched

    @jax.jit
    def loss_and_energies(scene):
        problem = first_problem(scene.replace(initial_state=state))
        loss, _ = physics_loss(network, problem, state, config)
        positions = network.predict(problem, state).positions
        points = jnp.concatenate([pushed_out_guess(problem)[None], positions])
        return loss, jax.lax.map(lambda x: potential(x, problem), points)

    loss, energies = jax.device_get(loss_and_energies(scene))
    gaps = energies[:-1] - energies[-1]
    assert gaps[0] > 0
    expected = np.mean((energies[1:] - energies[-1]) / np.maximum(gaps, 0.01 * gaps[0]))
    np.testing.assert_allclose(loss, expected, rtol=1e-4)


@pytest.mark.slow
def test_a_network_for_the_solver_trains_from_optima(config, small_data, tmp_path):
    """Gap and distance to where the solver ends shrink."""
    model = dataclasses.replace(MODELS["smooth-small"], latent_size=16)
    config = dataclasses.replace(
        config, model=model, steps=60, iterations=10, log_every=10, slots_per_garment=2, horizon_growth=60
    )
    state = train(config, tmp_path, datasets=(small_data,))
    losses = [json.loads(line)["loss"] for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert int(state.skipped) == 0
    assert np.mean(losses[-2:]) < losses[0] - 0.03
    with pytest.raises(ConfigError, match="iterations"):
        read_train_config({**describe_train_config(config), "energy_set": "hood"})


@pytest.mark.slow
@pytest.mark.parametrize("name", ["eslr-15", "hood", "mgn-48"])
def test_full_size_networks_take_five_steps(name):
    """The paper's networks at their own width and 4k vertices, on one garment and the validation clips."""
    config = load_recipe(RECIPES / "paper" / f"{name}.toml", {"split": "validation", "garments": ["tshirt"]})
    data = load_training_data(config, *config.vertices)
    assert data.garments.rest_positions.shape[1] > 4000
    state, step = init_train_state(config, (data,)), make_train_step(config, 0)
    state, _ = step(
        state, data
    )  # the normalisers see a frame; HOOD's see a hundred before anything is learned
    measured = {
        key: entry.replace(num_updates=jnp.int32(WARMUP_UPDATES))
        for key, entry in state.network.statistics.items()
    }
    state = state.replace(network=state.network.replace(statistics=measured))
    before = jax.device_get(state.network.params)
    for _ in range(5):
        state, metrics = step(state, data)
        assert all(np.isfinite(float(value)) for value in metrics.values())
    assert int(state.skipped) == 0
    moved = jax.tree.map(
        lambda new, old: float(np.max(np.abs(new - old))), jax.device_get(state.network.params), before
    )
    assert np.mean([value > 0 for value in jax.tree.leaves(moved)]) > 0.9
    # Adam moves a weight by at most its rate at first, 3.2 rates later.
    assert config.learning_rate < max(jax.tree.leaves(moved)) < 5 * 3.2 * 1.01 * config.learning_rate
