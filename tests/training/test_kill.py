"""SIGKILL at random moments: a run resumes each time and ends where an undisturbed one does."""

import json
import random
import subprocess
import sys
import time

import numpy as np
import pytest

RECIPE = """
garments = ["tshirt"]
split = "validation"
steps = 120
log_every = 5
checkpoint_every = 10
[model]
base = "mgn-small"
refinement_steps = 1
latent_size = 16
"""
KILLS = 10


def run(out, *options):
    return subprocess.Popen(
        [sys.executable, "-m", "eslr_jax.pipeline.cli", "train", "--out", str(out), *options],
        stderr=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
    )


def newest_checkpoint(out):
    folder = out / "checkpoints"
    return max((int(path.name) for path in folder.glob("*") if path.name.isdigit()), default=0)


@pytest.mark.slow
def test_ten_kills_lose_nothing_but_the_steps_since_a_checkpoint(tmp_path):
    config = tmp_path / "recipe.toml"
    config.write_text(RECIPE)
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    assert run(whole, "--config", str(config)).wait(timeout=900) == 0
    generator = random.Random(0)
    kills = 0
    options = ("--config", str(config))
    while kills < KILLS:
        process = run(killed, *options)
        before, began = newest_checkpoint(killed), time.monotonic()
        # from the first new checkpoint on, any moment may be the last; compiling ones are killed too
        while newest_checkpoint(killed) == before and process.poll() is None:
            if before and generator.random() < 0.002:
                break
            assert time.monotonic() - began < 300
            time.sleep(0.01)
        time.sleep(generator.uniform(0, 0.3))
        if process.poll() is not None:
            break  # done before it could be killed
        process.kill()
        process.wait()
        kills += 1
        assert newest_checkpoint(killed) >= before
        options = ("--resume",)
    assert run(killed, "--resume").wait(timeout=900) == 0
    assert kills >= KILLS - 1
    records = [json.loads(line) for line in (killed / "metrics.jsonl").read_text().splitlines()]
    assert [record["step"] for record in records] == list(range(5, 121, 5))
    with np.load(whole / "model.npz") as ours, np.load(killed / "model.npz") as theirs:
        for name in ours.files:
            np.testing.assert_array_equal(ours[name], theirs[name])
