"""A network of one's own, in a file of its own, is trained, exported and simulated like the package's."""

import json

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

OWN = read_system({"base": "own_network:nudge", "width": 4})


def test_it_is_trained_and_its_file_simulates(small_data, tmp_path):
    config = TrainConfig(model=OWN, steps=4, warmup=1, slots_per_garment=1, log_every=2, checkpoint_every=2)
    state = train(config, tmp_path / "run", datasets=(small_data,))
    assert int(state.skipped) == 0
    assert read_run_config(tmp_path / "run") == config
    loaded = load_model(tmp_path / "run" / "model.npz")
    assert loaded.config == OWN
    jax.tree.map(np.testing.assert_array_equal, loaded, state.network)
    simulate = jax.jit(
        lambda network: rollout(
            network, square(), drifting_ball(3), config=SimConfig(iterations=0), terms=CLOTH
        )
    )
    still = jax.tree.map(jnp.zeros_like, loaded)  # predicts the solver's guess
    # With the last layer's bias along x.
    pushing = jax.tree.map(lambda leaf: leaf.at[0].set(1.0) if leaf.shape == (3,) else leaf, still)
    moved, guessed, pushed = (simulate(network).positions for network in (loaded, still, pushing))
    assert np.isfinite(moved).all()
    assert 1e-7 < np.abs(moved - guessed).max() < 0.1
    way = np.asarray(pushed[1] - guessed[1])
    np.testing.assert_allclose(way, np.broadcast_to([1e-3, 0.0, 0.0], way.shape), atol=1e-6)


def test_a_module_that_is_not_there_is_named(tmp_path):
    for name, message in (
        ("nowhere:net", "No module named 'nowhere'; run the command where nowhere.py is"),
        ("own_network:other", "unknown model 'own_network:other'"),
    ):
        with pytest.raises(ConfigError, match=message):
            read_system(name)
    with pytest.raises(ConfigError, match=r"did you mean model\.width"):
        read_system({"base": "own_network:nudge", "widht": 4})
    record = {"format": 1, "model": {"base": "nowhere:net"}, "training": {}}
    (tmp_path / "model.json").write_text(json.dumps(record))
    np.savez(tmp_path / "model.npz", a=np.zeros(1))
    with pytest.raises(CheckpointError, match="No module named 'nowhere'"):
        load_model(tmp_path / "model.npz")
