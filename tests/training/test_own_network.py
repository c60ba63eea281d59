"""A network of one's own, in a file of its own, is trained, exported and simulated like the package's."""

import json
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from draped_ball import drifting_ball, square

from eslr_jax import CheckpointError, ConfigError, SimConfig, TrainConfig, load_model, rollout
from eslr_jax.networks.registry import read_system
from eslr_jax.terms import CLOTH
from eslr_jax.training.checkpoint import read_run_config
from eslr_jax.training.loop import train

CODE = """
from flax import linen as nn
from eslr_jax.networks.network import System, network
from eslr_jax.solver.guess import initial_guess

@network("nudge")
class Nudge(nn.Module, System):
    width: int = 8

    @nn.compact
    def __call__(self, problem, state):
        rows = nn.relu(nn.Dense(self.width)(state.velocity))
        return initial_guess(problem).position + 1e-3 * nn.Dense(3)(rows)
"""


@pytest.fixture
def own(tmp_path, monkeypatch):
    (tmp_path / "ownnet.py").write_text(CODE)
    monkeypatch.syspath_prepend(tmp_path)
    yield read_system({"base": "ownnet:nudge", "width": 4})
    del sys.modules["ownnet"]


def test_it_is_trained_and_its_file_simulates(own, small_data, tmp_path):
    config = TrainConfig(model=own, steps=4, warmup=1, slots_per_garment=1, log_every=2, checkpoint_every=2)
    state = train(config, tmp_path / "run", datasets=(small_data,))
    assert int(state.skipped) == 0
    assert read_run_config(tmp_path / "run") == config
    loaded = load_model(tmp_path / "run" / "model.npz")
    assert loaded.config == own
    jax.tree.map(np.testing.assert_array_equal, loaded, state.network)
    simulate = jax.jit(
        lambda network: rollout(
            network, square(), drifting_ball(3), config=SimConfig(iterations=0), terms=CLOTH
        )
    )
    still = jax.tree.map(jnp.zeros_like, loaded)  # predicts the solver's guess
    moved, guessed = (simulate(network).positions for network in (loaded, still))
    assert np.isfinite(moved).all()
    assert 1e-7 < np.abs(moved - guessed).max() < 0.1


def test_a_module_that_is_not_there_is_named(own, tmp_path):
    for name, message in (
        ("nowhere:net", "No module named 'nowhere'; run the command where nowhere.py is"),
        ("ownnet:other", "unknown model 'ownnet:other'"),
    ):
        with pytest.raises(ConfigError, match=message):
            read_system(name)
    with pytest.raises(ConfigError, match=r"did you mean model\.width"):
        read_system({"base": "ownnet:nudge", "widht": 4})
    record = {"format": 1, "model": {"base": "nowhere:net"}, "training": {}}
    (tmp_path / "model.json").write_text(json.dumps(record))
    np.savez(tmp_path / "model.npz", a=np.zeros(1))
    with pytest.raises(CheckpointError, match="No module named 'nowhere'"):
        load_model(tmp_path / "model.npz")
