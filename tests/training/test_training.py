import dataclasses
import json
import os
import shutil
import signal
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eslr_jax.assets import load_model
from eslr_jax.config import TrainConfig, from_dict, to_dict
from eslr_jax.contact.nearest import find_contacts
from eslr_jax.errors import CheckpointError, ConfigError
from eslr_jax.models.registry import MODELS
from eslr_jax.training import data, loop
from eslr_jax.training.checkpoint import read_run_config, write_run_config
from eslr_jax.training.loop import train
from eslr_jax.training.loss import _mean_contraction
from eslr_jax.training.pool import start_trajectory

MODEL = dataclasses.replace(MODELS["mgn-small"], refinement_steps=1, latent_size=16)
CONFIG = TrainConfig(
    model=MODEL,
    garments=("tshirt",),
    steps=6,
    warmup=2,
    slots_per_garment=2,
    log_every=2,
    checkpoint_every=2,
)


@pytest.fixture(scope="module", autouse=True)
def one_clip_and_one_compilation():
    """Train on one clip, and let the runs of this file share data and compiled steps."""
    patch = pytest.MonkeyPatch()
    patch.setattr(data, "split_clips", lambda split: ["cmu_016_32"])
    loaded = data.load_training_data(CONFIG, "1k")
    patch.setattr(loop, "load_training_data", lambda config, vertices: loaded)
    steps = {}
    make = loop.make_train_step

    def make_once(config, resolution, mesh):
        key = dataclasses.replace(config, seed=0)
        if key not in steps:
            steps[key] = make(config, resolution, mesh)
        return steps[key]

    patch.setattr(loop, "make_train_step", make_once)
    yield
    patch.undo()


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    return train(CONFIG, folder), folder


def test_run_leaves_metrics_and_a_model(finished):
    state, folder = finished
    records = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    assert [record["step"] for record in records] == [2, 4, 6]
    assert all(np.isfinite(list(record.values())).all() for record in records)
    assert int(state.skipped) == 0
    params, config = load_model(folder / "model.npz")
    assert config == MODEL
    for loaded, trained in zip(jax.tree.leaves(params), jax.tree.leaves(state.params), strict=True):
        np.testing.assert_array_equal(loaded, trained)


def test_a_start_for_the_solver_trains_from_optima(tmp_path):
    """OptimalityGap and distance to where the solver ends shrink."""
    model = dataclasses.replace(MODELS["smooth-small"], latent_size=16)
    config = dataclasses.replace(CONFIG, model=model, steps=60, iterations=10, log_every=10)
    state = train(config, tmp_path)
    losses = [json.loads(line)["loss"] for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert int(state.skipped) == 0
    assert np.mean(losses[-2:]) < losses[0] - 0.03
    with pytest.raises(ConfigError, match="iterations"):
        from_dict(TrainConfig, {**to_dict(config), "energy_set": "hood"})


def test_training_moves_the_weights(finished):
    from eslr_jax.models.registry import init_model

    state, _ = finished
    pairs = zip(
        jax.tree.leaves(state.params["params"]), jax.tree.leaves(init_model(MODEL)["params"]), strict=True
    )
    assert any(not np.array_equal(trained, initial) for trained, initial in pairs)


def test_interrupted_run_resumes_bit_by_bit(finished, tmp_path):
    whole, _ = finished

    def interrupt(done, total, metrics):
        if done == 4:
            os.kill(os.getpid(), signal.SIGTERM)

    part = train(CONFIG, tmp_path, on_progress=interrupt)
    assert int(part.step) < CONFIG.steps
    assert not (tmp_path / "model.npz").exists()
    resumed = train(CONFIG, tmp_path, resume=True)
    for ours, theirs in zip(jax.tree.leaves(resumed), jax.tree.leaves(whole), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_a_folder_in_use_is_not_overwritten(finished):
    _, folder = finished
    before = (folder / "metrics.jsonl").read_text()
    with pytest.raises(CheckpointError, match="--resume"):
        train(CONFIG, folder)
    with pytest.raises(CheckpointError, match="another configuration"):
        train(dataclasses.replace(CONFIG, seed=1), folder, resume=True)
    assert (folder / "metrics.jsonl").read_text() == before


def test_resuming_nothing_is_refused(tmp_path):
    with pytest.raises(CheckpointError, match="no training run"):
        train(CONFIG, tmp_path, resume=True)


def test_half_written_checkpoint_is_not_taken(finished, tmp_path):
    """A folder that orbax has not renamed yet is no checkpoint."""
    _, folder = finished
    from eslr_jax.training.checkpoint import Checkpoints

    checkpoints = Checkpoints(folder)
    latest = checkpoints.latest()
    (folder / "checkpoints" / f"{latest + 1}.orbax-checkpoint-tmp-1").mkdir()
    assert Checkpoints(folder).latest() == latest


def test_a_damaged_checkpoint_gives_way_to_the_one_before(finished, tmp_path):
    _, folder = finished
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    for path in (tmp_path / "checkpoints" / "6").rglob("*"):
        if path.is_file():
            path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.warns(UserWarning, match="checkpoint 6 can't be read and was removed; going on from 4"):
        state = train(CONFIG, tmp_path, resume=True)
    whole, _ = finished
    for ours, theirs in zip(jax.tree.leaves(state), jax.tree.leaves(whole), strict=True):
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.slow
def test_a_finished_run_is_extended_but_not_cut(finished, tmp_path):
    _, folder = finished
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    with pytest.raises(CheckpointError, match="it can be extended to more, not cut to 4"):
        train(dataclasses.replace(CONFIG, steps=4), tmp_path, resume=True)
    longer = dataclasses.replace(CONFIG, steps=8)
    assert int(train(longer, tmp_path, resume=True).step) == 8
    assert read_run_config(tmp_path) == longer
    records = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert [record["step"] for record in records] == [2, 4, 6, 8]


def test_a_folder_without_a_checkpoint_starts_anew(tmp_path):
    write_run_config(tmp_path, CONFIG)
    with pytest.raises(CheckpointError, match="no checkpoint to resume from; start without --resume"):
        train(CONFIG, tmp_path, resume=True)
    assert int(train(CONFIG, tmp_path).step) == CONFIG.steps


def test_unknown_split_lists_what_exists():
    from eslr_jax.assets import split_clips

    with pytest.raises(ConfigError, match="validation"):
        split_clips("holdout")


@pytest.mark.slow
def test_hoods_recipe_takes_finite_steps(tmp_path):
    from eslr_jax.training.recipe import load_recipe

    overrides = {
        "garments": ["tshirt"],
        "vertices": ["1k"],
        "steps": 3,
        "log_every": 1,
        "model": "mgn-15",
        "model.message_passing_steps": 2,
        "model.latent_size": 16,
    }
    config = load_recipe("experiments/configs/hood.toml", overrides)
    assert config.energy_set == "hood"
    state = train(config, tmp_path)
    assert int(state.skipped) == 0
    counts = [entry.count for entry in state.params["statistics"].values()]
    assert all(count > 0 for count in counts)


def test_overrides_may_name_another_model(tmp_path):
    from eslr_jax.training.recipe import load_recipe

    recipe = tmp_path / "recipe.toml"
    recipe.write_text('model = "eslr-small"')
    config = load_recipe(recipe, {"model": "mgn-small", "model.refinement_steps": 4})
    assert config.model == dataclasses.replace(MODELS["mgn-small"], refinement_steps=4)


def test_bodies_of_trajectories_differ_in_girth_and_cloth_starts_outside_them():
    config = dataclasses.replace(CONFIG, girth=0.01, noise=0.0)
    loaded = data.load_training_data(config, "1k")
    garment = loaded.garment(0)
    start = jax.jit(partial(start_trajectory, data=loaded, garment=garment, config=config))
    slots = [start(jax.random.key(seed)) for seed in range(4)]
    girths = np.array([slot.girth for slot in slots])
    assert np.ptp(girths) > 2e-3
    assert np.all(np.abs(girths) <= 0.01)
    for slot in slots:
        transforms = loaded.transforms(slot.frame, slot.yaw)
        thin, own = loaded.body(transforms, jnp.float32(0.0)), loaded.body(transforms, slot.girth)
        np.testing.assert_allclose(np.linalg.norm(own - thin, axis=-1), abs(slot.girth), rtol=0.1)
        contacts = find_contacts(slot.state.position, own, own, loaded.surface)
        inside = np.asarray(contacts.distances)[np.asarray(garment.vertex_mask)] < -1e-3
        assert inside.mean() < 0.02


def test_contraction_weighs_each_pass_by_what_it_leaves():
    """Passes from 10 J to 1 J to 0.1 J to 0 leave a tenth each; the last one's gap is known to 1 % of 10 J."""
    energies = jnp.array([10.0, 1.0, 0.1, 0.0])
    np.testing.assert_allclose(_mean_contraction(energies), (0.1 + 0.1 + 0.0) / 3, rtol=1e-6)
    np.testing.assert_allclose(
        jax.grad(_mean_contraction)(energies), [0.0, 1 / 30, 1 / 3, 1 / 3 / 0.1], rtol=1e-6
    )
    flat = jnp.ones(4)
    assert np.isfinite(jax.grad(_mean_contraction)(flat)).all()
