"""One training run on one device, on four, and on two processes: the same losses."""

import json
import socket
import subprocess
import sys

import numpy as np
import pytest

RECIPE = """
garments = ["tshirt"]
split = "validation"
steps = 3
batch_size = 4
log_every = 1
[model]
base = "mgn-small"
refinement_steps = 1
latent_size = 16
"""


def start(out, config, devices, *options):
    arguments = ["train", "--out", str(out), "--config", str(config), *options]
    flags = f"import os; os.environ['XLA_FLAGS'] = '--xla_force_host_platform_device_count={devices}'; "
    code = flags + "from eslr_jax.pipeline.cli import main; main()"
    with (out.parent / f"{out.name}.log").open("ab") as log:
        return subprocess.Popen([sys.executable, "-c", code, *arguments], stdout=log, stderr=log)


def finish(process, out):
    assert process.wait(timeout=600) == 0, (out.parent / f"{out.name}.log").read_text()


def losses(out):
    lines = (out / "metrics.jsonl").read_text().splitlines()
    return np.array([[json.loads(line)[name] for name in ("loss", "gradient_norm")] for line in lines])


@pytest.mark.slow
def test_devices_and_processes_do_not_change_the_losses(tmp_path):
    config = tmp_path / "recipe.toml"
    config.write_text(RECIPE)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{probe.getsockname()[1]}"
    runs = {"one": 1, "four": 4}
    for name, devices in runs.items():
        finish(start(tmp_path / name, config, devices), tmp_path / name)
    pair = [
        start(
            tmp_path / "pair",
            config,
            2,
            *("--coordinator", address, "--num-processes", "2", "--process-id", str(index)),
        )
        for index in range(2)
    ]
    for process in pair:
        finish(process, tmp_path / "pair")
    expected = losses(tmp_path / "one")
    assert expected.shape == (3, 2)
    for name in ("four", "pair"):
        found = losses(tmp_path / name)
        np.testing.assert_allclose(found[:, 0], expected[:, 0], rtol=1e-5)
        # Sums in another order: Adam turns the rounding of a gradient near zero into a step of full length.
        np.testing.assert_allclose(found[:, 1], expected[:, 1], rtol=1e-3)
    assert (tmp_path / "pair" / "model.npz").exists()
