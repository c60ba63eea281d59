# SPDX-License-Identifier: GPL-3.0-or-later
"""Commands of `eslr` that run one after the other in a process of their own; knows nothing of Blender."""

from __future__ import annotations

import json
import os
import re
import subprocess
import threading
from dataclasses import dataclass
from pathlib import Path

_PROGRESS = re.compile(r"(?:compiling|simulating)\D.*?(\d+)/(\d+)")
_WARNING = "warning: "
_PATIENCE = 10.0  # [s] that a cancelled process gets to end by itself


@dataclass(frozen=True)
class Step:
    """One command and what the user is told meanwhile."""

    text: str
    command: list[str]
    output: str  # file in the job's folder that takes what the command prints


class JobError(Exception):
    """A command failed; the message is its own, or says what to do."""


class Job:
    """Runs steps; `poll` is called again and again, and never waits."""

    def __init__(self, steps: list[Step], folder: Path) -> None:
        """Take steps and a folder to work in; nothing runs before the first poll."""
        self._steps, self._folder, self._log = steps, folder, folder / "log.txt"
        self._process: subprocess.Popen | None = None
        self.text = "starting"
        self.share = 0.0  # of all frames that are simulated
        self.num_done = 0  # steps
        self.warnings: list[str] = []  # of the steps that are done

    def poll(self) -> bool:
        """Go on; return whether all steps are done.

        Raises:
            JobError: A step failed, or can't be started.
        """
        if self._process is None:
            self._process = self._start(self._steps[self.num_done])
        code = self._process.poll()
        log = _read(self._log)
        if found := _PROGRESS.findall(log):
            done, total = map(int, found[-1])
            self.share = done / max(total, 1)
            self.text = f"simulating, {done} of {total} frames" if done else "compiling"
        if code is None:
            return False
        self._process = None
        if code:
            raise JobError(_reason(log, code))
        printed = _read(self._folder / self._steps[self.num_done].output)
        try:
            self.warnings += json.loads(printed).get("warnings", ())  # as `eslr fit --json` has them
        except ValueError:  # lines of `eslr simulate`
            lines = printed.splitlines()
            self.warnings += [line.removeprefix(_WARNING) for line in lines if line.startswith(_WARNING)]
        self.num_done += 1
        return self.num_done == len(self._steps)

    def _start(self, step: Step) -> subprocess.Popen:
        """Start a step."""
        self.text = step.text
        # The terminal's progress bar is written also where there is no terminal. A Python of its own must not
        # look for its library in Blender's.
        environment = {name: value for name, value in os.environ.items() if name != "PYTHONHOME"}
        environment |= {"FORCE_COLOR": "1", "COLUMNS": "200", "PYTHONUNBUFFERED": "1"}
        try:
            with (self._folder / step.output).open("wb") as out, self._log.open("wb") as log:
                return subprocess.Popen(
                    step.command,
                    stdout=out,
                    stderr=log,
                    stdin=subprocess.DEVNULL,
                    cwd=self._folder,
                    env=environment,
                )
        except OSError as error:
            raise JobError(
                f"{step.command[0]} can't be started ({error.strerror}); name the Python that has eslr_jax in "
                "the add-on's preferences"
            ) from error

    def cancel(self) -> None:
        """End what runs, and don't wait for it."""
        process, self._process = self._process, None
        if process is None or process.poll() is not None:
            return
        process.terminate()

        def insist() -> None:
            try:
                process.wait(_PATIENCE)
            except subprocess.TimeoutExpired:
                process.kill()

        threading.Thread(target=insist, daemon=True).start()


def _read(path: Path) -> str:
    """Return what a command printed, without the codes that colour it in a terminal."""
    return re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", path.read_text(encoding="utf-8", errors="replace"))


def _reason(log: str, code: int) -> str:
    """Return why a command failed: its own line, or the last one that it wrote."""
    lines = [line.strip() for line in log.splitlines() if line.strip()]
    if any("No module named" in line and "eslr_jax" in line for line in lines):
        return (
            "this Python has no eslr_jax; install it there (pip install), or name another in the preferences"
        )
    # What `eslr simulate` keeps lies in the job's folder, which goes with it.
    own = [
        line.removeprefix("eslr: ").partition("; the frames before are kept")[0]
        for line in lines
        if line.startswith("eslr: ")
    ]
    return own[-1] if own else (lines[-1] if lines else f"the command ended with code {code}")


def simulation_steps(python: str, folder: Path, fabric: str, tolerance: str, has_layers: bool) -> list[Step]:
    """Return the steps from `body.glb` and `garment.obj` in a folder to `motion.npz` beside them.

    Args:
        python: Path of the Python that has eslr_jax.
        folder: Folder of the job.
        fabric: As for `eslr simulate --fabric`.
        tolerance: As for `eslr simulate --tolerance`.
        has_layers: Let nothing pass through cloth.
    """

    def step(text: str, *words: object) -> Step:
        return Step(text, [python, "-m", "eslr_jax.pipeline.cli", *map(str, words)], f"{words[0]}.txt")

    body, garment, run = folder / "body.glb", folder / "garment.npz", folder / "run"
    # The garment is where it belongs, so nothing about it has to be recognised.
    place = ("--units", "m", "--up", "y", "--front", "z", "--keep-place", "--arms", "rest")
    fit = ("fit", folder / "garment.obj", "--out", garment, "--body", body, *place, "--no-picture", "--json")
    layers = () if has_layers else ("--contact", "fast")
    simulate = ("simulate", "--garment", garment, "--body", body, "--fabric", *fabric.split())
    simulate += ("--tolerance", tolerance, *layers, "--no-pictures", "--out", run)
    export = ("export", run, "--out", folder / "motion.npz", "--content", "garment")
    return [
        step("fitting the garment", *fit),
        step("reading body and motion", *simulate),
        step("reading the result", *export),
    ]
