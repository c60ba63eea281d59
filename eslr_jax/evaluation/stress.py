"""Run the hard cases with any simulator, and show what came of them (host)."""

from __future__ import annotations

import importlib.metadata
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from eslr_jax.evaluation.hard_cases import CASES, Outcome, Run, Simulator, find_case, play
from eslr_jax.evaluation.report import environment
from eslr_jax.render import render_frame, side_by_side, write_png
from eslr_jax.render.pictures import BODY_COLOR, GARMENT_COLOR

_PICTURE_SIZE = (240, 240)  # width, height [pixels]
_CAMERA = 35.0  # [degrees] from the front towards the side
_COLUMNS = 5  # of the sheet


def stress(
    simulator: Simulator,
    cases: Sequence[str] = (),
    *,
    on_case: Callable[[str, Outcome, float], None] = lambda name, outcome, seconds: None,
) -> list[Outcome]:
    """Run hard cases one after the other.

    Args:
        simulator: Of `physics_simulator` or `network_simulator`, or any other.
        cases: Names; all fifteen if empty.
        on_case: Called after each case with its name, its outcome and the seconds it took.

    Raises:
        ConfigError: There is no such case.
    """
    chosen = [find_case(name) for name in cases] or list(CASES.values())
    outcomes = []
    for case in chosen:
        began = time.perf_counter()
        outcomes.append(play(case, simulator))
        on_case(case.name, outcomes[-1], time.perf_counter() - began)
    return outcomes


def rows(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """Return plain values, one row per measure: case, passed, measure, value and bar."""
    return [row for outcome in outcomes for row in outcome.rows()]


def summary(simulator: Simulator, outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Return everything worth keeping of a run, with device and versions.

    Args:
        simulator: What ran.
        outcomes: Of `stress`.
    """
    environs = environment()
    environs["versions"]["ipctk"] = importlib.metadata.version("ipctk")
    return {
        "simulator": simulator.name,
        "passed": sum(outcome.is_passed for outcome in outcomes),
        "cases": {
            outcome.case: {
                "passed": outcome.is_passed,
                "reason": CASES[outcome.case].reason,
                "limit": CASES[outcome.case].limit,
            }
            for outcome in outcomes
        },
        "measures": rows(outcomes),
        **environs,
    }


def write_pictures(
    outcomes: Sequence[Outcome], folder: Path, *, on_picture: Callable[[int, int], None] | None = None
) -> None:
    """Write a picture of each case, and all of them on one sheet.

    Args:
        outcomes: Of `stress`.
        folder: Where to write `<case>.png` and `sheet.png`.
        on_picture: Called with the pictures done and the pictures in all.

    Raises:
        MissingExtraError: The extra `render` is not installed.
    """
    pictures, labels = [], []
    for number, outcome in enumerate(outcomes):
        picture = render_outcome(outcome)
        if picture is not None:
            write_png(folder / f"{outcome.case}.png", picture)
            pictures.append(picture)
            labels.append(outcome.case.replace("_", " ") + ("" if outcome.is_passed else ": failed"))
        if on_picture is not None:
            on_picture(number + 1, len(outcomes))
    if pictures:
        write_png(folder / "sheet.png", side_by_side(pictures, labels, columns=_COLUMNS))


def render_outcome(outcome: Outcome, size: tuple[int, int] = _PICTURE_SIZE) -> np.ndarray | None:
    """Return a picture of the end of a case's own scene; None if there is nothing finite to show.

    Args:
        outcome: Of one case.
        size: Width and height [pixels].
    """
    chosen = outcome.runs.get(CASES[outcome.case].picture)
    candidates = [chosen] if chosen is not None and chosen.trajectory is not None else []
    candidates += [run for run in outcome.runs.values() if run.trajectory is not None]
    for run in candidates:
        finite = np.flatnonzero(np.isfinite(run.positions).all(axis=(1, 2)))
        if len(finite):
            return _render(run, int(finite[-1]), size)
    return None


def _render(run: Run, frame: int, size: tuple[int, int]) -> np.ndarray:
    """Render cloth and body as one mesh, so that the camera takes in both."""
    assert run.stress is not None
    positions, faces = run.positions[frame], run.faces
    colors = np.broadcast_to(GARMENT_COLOR, positions.shape)
    body = run.stress.scene.body_positions
    if body is not None and run.stress.body_faces is not None:
        obstacle = np.asarray(body[frame], np.float64)
        faces = np.concatenate([faces, run.stress.body_faces + len(positions)])
        positions = np.concatenate([positions, obstacle])
        colors = np.concatenate([colors, np.broadcast_to(BODY_COLOR, obstacle.shape)])
    return render_frame(None, None, positions, faces, camera=_CAMERA, size=size, vertex_colors=colors)
