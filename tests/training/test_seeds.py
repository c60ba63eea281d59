"""Several seeds in one compiled step train as each does alone."""

import dataclasses
import json
import os
import signal
from functools import partial

import jax
import numpy as np
import pytest

from eslr_jax import TrainConfig, load_model
from eslr_jax.pipeline.assets.models import model_record
from eslr_jax.training.loop import make_seeds_step, stack_seeds, take_seed, train
from eslr_jax.training.step import init_train_state, make_train_step

STEPS = 5


@pytest.mark.slow
def test_seeds_together_are_each_alone(small_data, cheap_model):
    # Trajectories of at most two frames: some start anew while others go on.
    config = TrainConfig(model=cheap_model, steps=STEPS, horizon=2, horizon_growth=1)
    configs = [dataclasses.replace(config, seed=seed) for seed in (3, 4)]
    alone = [init_train_state(one, (small_data,)) for one in configs]
    together = stack_seeds([init_train_state(one, (small_data,)) for one in configs])
    step, seeds_step = make_train_step(config, 0), make_seeds_step(config, 0)
    losses = []
    for _ in range(STEPS):
        together, metrics = seeds_step(together, small_data)
        results = [step(state, small_data) for state in alone]
        alone = [state for state, _ in results]
        losses.append((np.asarray(metrics["loss"]), np.array([own["loss"] for _, own in results])))
    found, expected = np.array(losses).swapaxes(0, 1)
    np.testing.assert_allclose(found, expected, rtol=1e-3)
    assert abs(expected[:, 0] - expected[:, 1]).min() > 0  # the seeds differ
    for place, state in enumerate(alone):
        found = take_seed(together, place).network
        jax.tree.map(partial(np.testing.assert_allclose, atol=1e-4), found, state.network)
        assert int(take_seed(together, place).step) == STEPS


@pytest.mark.slow
def test_a_run_of_two_seeds_goes_on_and_exports_both(small_data, cheap_model, tmp_path):
    config = TrainConfig(model=cheap_model, steps=STEPS, seeds=2, seed=3, log_every=1, checkpoint_every=2)

    def interrupt(done, total, metrics):
        if done == 3:
            os.kill(os.getpid(), signal.SIGTERM)

    train(config, tmp_path, datasets=(small_data,), on_progress=interrupt)
    assert not list(tmp_path.rglob("model.npz"))
    state = train(config, tmp_path, datasets=(small_data,), resume=True)
    for place, folder in enumerate((tmp_path / "seed-3", tmp_path / "seed-4")):
        records = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
        assert [record["step"] for record in records] == [1, 2, 3, 4, 5]
        network = load_model(str(folder / "model.npz"))
        hours = records[-1]["core_seconds"] / 3600
        assert model_record(str(folder / "model.npz"))["core_hours"] == pytest.approx(hours / 2)
        jax.tree.map(np.testing.assert_array_equal, network, take_seed(state, place).network)
