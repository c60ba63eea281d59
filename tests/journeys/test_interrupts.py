"""Ctrl-C at several moments: `simulate` and `train` lose little, and go on to the same result."""

import json
import signal
import subprocess
import sys
import time
from functools import partial

import numpy as np
import pytest
from commands import eslr

pytestmark = pytest.mark.slow
SIMULATE = ("--simulator", "physics", "--iterations", 150, "--frames", 141, "--settle", 5, "--no-pictures")
RECIPE = """
garments = ["tshirt"]
split = "validation"
steps = 40
log_every = 5
checkpoint_every = 10
[model]
base = "mgn-small"
refinement_steps = 1
latent_size = 16
"""


def start(*words):
    command = [sys.executable, "-m", "eslr_jax.pipeline.cli", *map(str, words)]
    # A shell without job control starts its background commands, such as this suite, deaf to Ctrl-C.
    hear = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen(command, **pipes, text=True, preexec_fn=hear)


def interrupt_after(seconds, *words):
    """Run a command, press Ctrl-C after a time; return exit code, words and the seconds that it took to end."""
    process = start(*words)
    time.sleep(seconds)
    process.send_signal(signal.SIGINT)
    began = time.monotonic()
    _, text = process.communicate(timeout=120)
    return process.returncode, text, time.monotonic() - began


def test_a_simulation_interrupted_again_and_again_ends_as_the_whole_one(tmp_path):
    whole, part = tmp_path / "whole", tmp_path / "part"
    for _ in range(2):  # the second has everything compiled, as those that follow
        began = time.monotonic()
        assert eslr("simulate", *SIMULATE, "--out", whole).returncode == 0
        usual = time.monotonic() - began
    words, lengths = ("simulate", *SIMULATE, "--out", part), []
    delay = 0.6 * usual
    for _ in range(8):
        code, text, _ = interrupt_after(delay, *words)
        if code == 0:
            break
        assert "Traceback" not in text
        assert code in (130, -signal.SIGINT)
        if not (part / "unfinished.npz").exists():
            assert not part.exists() or not list(part.iterdir())
            delay += 0.1 * usual
            continue
        report = json.loads((part / "report.json").read_text())
        with np.load(part / "trajectory.npz") as arrays:
            assert len(arrays["positions"]) == report["interrupted_at"]["frame"] + 1
        lengths.append(report["interrupted_at"]["frame"])
        words = ("simulate", "--out", part, "--resume", "--no-pictures")
    assert lengths
    assert lengths == sorted(lengths)
    refused = eslr("simulate", "--out", part, "--resume", "--iterations", 30)
    assert refused.returncode == 2
    assert eslr("simulate", "--out", part, "--resume", "--no-pictures").returncode == (0 if code else 2)
    with np.load(whole / "trajectory.npz") as ours, np.load(part / "trajectory.npz") as theirs:
        for name in ours.files:
            np.testing.assert_array_equal(ours[name], theirs[name])
    reports = [json.loads((folder / "report.json").read_text()) for folder in (whole, part)]
    for key in ("terms", "worst_stretch", "worst_skin_through", "interrupted_at", "num_frames"):
        assert reports[0][key] == reports[1][key]
    assert not (part / "unfinished.npz").exists()


STOPPED_WHILE_IT_IS_MEASURED = """
import os, signal, sys
from eslr_jax.pipeline.cli import main
from eslr_jax.pipeline.report import report

measure = report.environment
def stop():
    os.kill(os.getpid(), signal.SIGINT)
    return measure()
report.environment = stop
sys.argv = ["eslr", "simulate", "--simulator", "physics", "--iterations", "20", "--frames", "4", "--settle", "0",
            "--out", sys.argv[1]]
main()
"""


def test_ctrl_c_while_a_run_is_measured_loses_no_frame(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", STOPPED_WHILE_IT_IS_MEASURED, tmp_path / "run"], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert "stopping when these frames are written" in done.stderr
    with np.load(tmp_path / "run" / "trajectory.npz") as arrays:
        assert len(arrays["positions"]) == 4
    assert not (tmp_path / "run" / "unfinished.npz").exists()
    assert not (tmp_path / "run" / "sheet.png").exists(), "pictures are not waited for"


def test_a_training_stops_at_once_while_it_compiles_and_resumes(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))  # nothing is compiled yet
    (tmp_path / "recipe.toml").write_text(RECIPE)
    whole, part = tmp_path / "whole", tmp_path / "part"
    process = start("train", "--config", tmp_path / "recipe.toml", "--out", part)
    began = time.monotonic()
    while not (part / "checkpoints" / "0").exists():
        assert process.poll() is None
        assert time.monotonic() - began < 240
        time.sleep(0.05)
    time.sleep(1.0)  # now it compiles
    process.send_signal(signal.SIGINT)
    began = time.monotonic()
    _, text = process.communicate(timeout=60)
    assert time.monotonic() - began < 5
    assert process.returncode == 130
    assert "Traceback" not in text
    assert not (part / "metrics.jsonl").read_text()
    assert eslr("train", "--out", part, "--resume").returncode == 0
    assert eslr("train", "--config", tmp_path / "recipe.toml", "--out", whole).returncode == 0
    with np.load(whole / "model.npz") as ours, np.load(part / "model.npz") as theirs:
        for name in ours.files:
            np.testing.assert_array_equal(ours[name], theirs[name])
