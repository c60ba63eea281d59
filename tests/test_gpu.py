"""What a GPU computes is what the CPU computes: `pytest -m gpu` on a machine with both."""

import dataclasses

import jax
import numpy as np
import pytest

from eslr_jax import SimConfig, TrainConfig, rollout_scene
from eslr_jax.networks.registry import MODELS
from eslr_jax.training.data import build_training_data
from eslr_jax.training.step import init_train_state, make_train_step

pytestmark = pytest.mark.gpu

NETWORK = dataclasses.replace(MODELS["eslr-small"], refinement_steps=2, latent_size=16)


@pytest.fixture(scope="module")
def devices():
    """The CPU, and a GPU."""
    try:
        return jax.devices("cpu")[0], jax.devices("gpu")[0]
    except RuntimeError:
        pytest.skip("no NVIDIA GPU")


@pytest.fixture(autouse=True)
def full_precision():
    """Keep all bits of float32 in products, which GPUs round to ten by default; let optax promote its counts."""
    with jax.default_matmul_precision("highest"), jax.numpy_dtype_promotion("standard"):
        yield


def run_on(device, function, *arguments):
    """Return a function's result on a device, fetched; it gets copies, which it may donate."""
    copies = jax.tree.map(np.array, arguments)
    with jax.default_device(device):
        result = function(*jax.device_put(copies, device))
        assert all(leaf.devices() == {device} for leaf in jax.tree.leaves(result))
        return jax.device_get(result)


@pytest.mark.parametrize(("model", "iterations"), [(None, 30), (NETWORK, 10)])
def test_a_rollout(devices, small_scene, model, iterations):
    network, config = None if model is None else model.new_network(), SimConfig(iterations=iterations)
    run = jax.jit(rollout_scene, static_argnames="config")
    cpu, gpu = (
        run_on(device, lambda network, scene: run(network, scene, config), network, small_scene)
        for device in devices
    )
    np.testing.assert_allclose(gpu.positions[:2], cpu.positions[:2], atol=1e-5)
    # Thirty iterations leave the sum of rounding: on an H100 one coordinate in a thousand is 1.3 mm off by then.
    np.testing.assert_allclose(gpu.positions, cpu.positions, atol=2e-3)
    np.testing.assert_array_equal(gpu.status, cpu.status)


@pytest.mark.parametrize("energy_set", ["consistent", "hood"])
def test_a_training_step(devices, small_garment, energy_set):
    from cloth import make_limb, swing_motion

    body = make_limb()
    data = build_training_data([small_garment], body, [swing_motion(body, 12)])
    model = dataclasses.replace(MODELS["mgn-5"], message_passing_steps=2, latent_size=16)
    config = TrainConfig(model=model, energy_set=energy_set)
    state = init_train_state(config, (data,))
    step = make_train_step(config, 0)
    (cpu, cpu_metrics), (gpu, gpu_metrics) = (run_on(device, step, state, data) for device in devices)
    for name, expected in cpu_metrics.items():
        np.testing.assert_allclose(gpu_metrics[name], expected, rtol=1e-3, atol=1e-6, err_msg=name)
    np.testing.assert_allclose(gpu.pools[0].state.position, cpu.pools[0].state.position, atol=1e-4)
    for name, expected in cpu.network.statistics.items():
        np.testing.assert_allclose(gpu.network.statistics[name].mean, expected.mean, atol=1e-4)
