"""What training does where something goes wrong: updates skipped, trajectories started anew, runs ended."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eslr_jax import NonFiniteError, Status, TrainConfig, load_model
from eslr_jax.networks.normalizer import WARMUP_UPDATES
from eslr_jax.networks.registry import MODELS
from eslr_jax.training.checkpoint import Checkpoints
from eslr_jax.training.loop import train, window_metrics
from eslr_jax.training.loss import LossReport
from eslr_jax.training.pool import start_trajectory
from eslr_jax.training.step import _advance, init_train_state, make_train_step, slot_problem


def with_a_broken_vertex(state):
    """Return a training's state whose living trajectories have lost a vertex."""
    cloth = state.pools[0].state
    place = cloth.position.copy()
    place[:, 7] = np.nan
    alive = np.zeros_like(state.pools[0].is_done)
    return state.replace(pools=(state.pools[0].replace(state=cloth.replace(position=place), is_done=alive),))


@pytest.mark.slow
def test_of_two_data_sets_every_trajectory_is_trained(config, small_data):
    config = dataclasses.replace(config, slots_per_garment=2)
    state = init_train_state(config, (small_data, small_data))
    before = [np.array(pool.state.position) for pool in state.pools]
    steps = [make_train_step(config, place) for place in range(2)]
    for step in steps * 2:
        state, _ = step(state, small_data)
    for pool, start in zip(state.pools, before, strict=True):
        assert np.all(np.any(np.array(pool.state.position) != start, axis=(1, 2)))


def test_an_update_that_is_not_finite_is_skipped_and_counted_and_its_trajectory_starts_anew(
    config, small_data
):
    step = make_train_step(config, 0)

    def take_step(state):
        copied = jax.tree.map(jnp.array, state)  # a step donates its state
        state, metrics = step(copied, small_data)
        return jax.device_get(state), jax.device_get(metrics)

    first, metrics = take_step(init_train_state(config, (small_data,)))
    assert (first.skipped, metrics["resets"]) == (0, 0.0)
    assert first.pools[0].is_done[0], "it has reached its horizon of one frame"
    state, metrics = take_step(first)
    assert (metrics["resets"], state.pools[0].age[0], state.pools[0].is_done[0]) == (0.0, 1, False)

    broken = with_a_broken_vertex(state)
    bad, metrics = take_step(broken)
    assert not np.isfinite(metrics["loss"])
    assert (bad.skipped, metrics["skipped"], bad.step) == (1, 1.0, 3)
    jax.tree.map(np.testing.assert_array_equal, bad.network, state.network)
    jax.tree.map(np.testing.assert_array_equal, bad.optimizer, state.optimizer)
    assert metrics["resets"] == 1.0
    assert bad.pools[0].is_done[0]
    np.testing.assert_array_equal(bad.pools[0].state.position, broken.pools[0].state.position)
    assert bad.pools[0].age[0] == broken.pools[0].age[0], "it stays as it was, to be looked at"

    after, metrics = take_step(bad)
    assert np.isfinite(metrics["loss"])
    assert (after.skipped, metrics["skipped"]) == (0, 0.0), "one bad update is none in a row"
    assert (after.pools[0].age[0], metrics["resets"]) == (1, 0.0)
    assert np.isfinite(after.pools[0].state.position).all()
    moved = jax.tree.map(lambda new, old: np.any(new != old), after.network.params, bad.network.params)
    assert np.mean(jax.tree.leaves(moved)) > 0.8


def test_a_run_whose_updates_are_not_finite_ends_and_leaves_its_trajectories(
    config, cheap_model, small_data, tmp_path
):
    new = cheap_model.new_network()
    bad = new.replace(params=jax.tree.map(lambda leaf: jnp.full_like(leaf, jnp.nan), new.params))
    patient = dataclasses.replace(config, max_skipped=3, checkpoint_every=1000)
    with pytest.raises(
        NonFiniteError, match=r"^the last 4 updates were not finite at step 4; .* --start-from "
    ):
        train(patient, tmp_path, datasets=(small_data,), initial=bad)
    lines = (tmp_path / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(line)["step"] for line in lines] == [2, 4], "three updates may be skipped"
    assert not (tmp_path / "model.npz").exists()
    start = init_train_state(patient, (small_data,))
    assert Checkpoints(tmp_path).restore(start).step == 0
    kept = load_model(str(tmp_path / "last_finite.npz"))
    jax.tree.map(np.testing.assert_array_equal, kept, bad)
    empty = start.pools
    with np.load(tmp_path / "offending_state.npz") as arrays:
        leaves = [arrays[str(place)] for place in range(len(arrays.files))]
    (pool,) = jax.tree.unflatten(jax.tree.structure(empty), leaves)
    assert pool.state.position.shape == empty[0].state.position.shape
    assert np.isfinite(pool.state.position).all()
    assert np.ptp(pool.state.position[0], axis=0).max() > 0.05, "cloth, not an empty slot"
    assert pool.is_done[0]


@pytest.mark.parametrize("wrong", ["nothing", "horizon", "stretch", "displacement", "not a number"])
def test_a_trajectory_is_astray_where_it_stretches_or_jumps_too_far_and_done_at_its_horizon_too(
    advance, wrong
):
    slot, at = advance
    place = np.asarray(slot.state.position)
    middle = place.mean(axis=0)
    onward = {
        "stretch": middle + 2.6 * (place - middle),  # moves no vertex by 0.3 m
        "displacement": place + np.array([0.0, 0.31, 0.0], np.float32),
        "not a number": np.where(np.arange(len(place))[:, None] == 7, np.float32(np.nan), place),
    }.get(wrong, place)
    moved, is_astray = at(onward, 1 if wrong == "horizon" else 2)
    assert bool(is_astray) == (wrong not in ("nothing", "horizon"))
    assert bool(moved.is_done) == (wrong != "nothing")
    assert (int(moved.age), int(moved.before)) == (1, int(slot.frame))
    np.testing.assert_array_equal(moved.state.position, onward)


def test_a_body_that_contacts_cannot_follow_ends_a_trajectory(advance):
    slot, at = advance
    state = slot.state.replace(status=jnp.int32(Status.BODY_TOO_FAST))
    moved, is_astray = at(np.asarray(slot.state.position), 2, state)
    assert bool(is_astray)
    assert bool(moved.is_done)


@pytest.fixture(scope="module")
def advance(config, small_data):
    """A trajectory at its start, and a function that moves it to where the network would take it."""
    index = jnp.int32(0)
    slot = jax.jit(lambda key: start_trajectory(key, small_data, index, config))(jax.random.key(0))
    problem = jax.jit(lambda slot: slot_problem(slot, small_data, index, config))(slot)

    @jax.jit
    def at(onward, frames, state):
        report = LossReport(onward, {}, jnp.float32(0.0))
        return _advance(slot.replace(state=state), problem, report, small_data, config, frames)

    return slot, lambda onward, frames, state=slot.state: at(
        jnp.asarray(onward, jnp.float32), jnp.int32(frames), state
    )


@pytest.mark.slow
def test_statistics_come_first_and_then_weights_move(small_data):
    """HOOD: a hundred graphs for the normalisers, with the skinned garment's acceleration; then updates."""
    model = dataclasses.replace(MODELS["mgn-15"], message_passing_steps=1, latent_size=8)
    config = TrainConfig(model=model, steps=4, warmup=1, slots_per_garment=1, noise=0.0, horizon=1)
    step = make_train_step(config, 0)
    start = jax.device_get(init_train_state(config, (small_data,)))
    state, _ = step(jax.tree.map(jnp.array, start), small_data)
    jax.tree.map(np.testing.assert_array_equal, state.network.params, start.network.params)
    output = state.network.statistics["output"]
    assert int(output.num_updates) == 1
    frames = [
        small_data.skinned(jnp.int32(0), small_data.transforms(jnp.int32(k), jnp.float32(0.0)))
        for k in range(12)
    ]
    largest = np.abs(np.diff(np.stack(frames), 2, axis=0)).max()  # [m per frame^2]
    size = np.sqrt(np.asarray(output.mean) ** 2 + np.asarray(output.squared_deviations) / float(output.count))
    assert 0.01 * largest < size.max() < 1.5 * largest
    bad, metrics = step(jax.tree.map(jnp.array, with_a_broken_vertex(jax.device_get(state))), small_data)
    assert not np.isfinite(metrics["loss"])
    jax.tree.map(np.testing.assert_array_equal, bad.network, state.network)
    for name, one in start.network.statistics.items():
        start.network.statistics[name] = one.replace(num_updates=jnp.int32(WARMUP_UPDATES))
    moved = jax.tree.map(jnp.array, start)
    for _ in range(2):  # the first has a learning rate of zero
        moved, _ = step(moved, small_data)
    changed = jax.tree.map(
        lambda one, other: np.any(one != other), moved.network.params, start.network.params
    )
    assert np.mean(jax.tree.leaves(changed)) > 0.8


def test_a_skipped_update_does_not_hide_the_others_of_a_line():
    good = {"loss": np.float32([2.0, 3.0]), "skipped": np.float32([0.0, 0.0])}
    bad = {"loss": np.float32([np.nan, 3.0]), "skipped": np.float32([1.0, 0.0])}
    first, second = window_metrics([good, good, bad, good], 2)
    assert first == {"loss": 2.0, "skipped": 0.25}
    assert second == {"loss": 3.0, "skipped": 0.0}
