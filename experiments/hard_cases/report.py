"""What is kept of the hard cases: figures with device and versions, and a picture of all."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Sequence
from typing import Any

import numpy as np

from eslr_jax.pipeline.formats.palette import GARMENT_COLORS, SKIN_COLOR
from eslr_jax.pipeline.pictures import render_frame, side_by_side
from eslr_jax.pipeline.report.report import environment
from hard_cases import CASES
from hard_cases.case import Outcome, Run

_PICTURE_SIZE = (240, 240)  # width, height [pixels]
_CAMERA = 35.0  # [degrees] from the front towards the side
_COLUMNS = 5  # of the sheet


def summarize(simulator: str, outcome: Outcome) -> dict[str, Any]:
    """Return plain values: the figures of one case with its simulator, the device and versions."""
    case, environs = outcome.case, environment()
    environs["versions"]["ipctk"] = importlib.metadata.version("ipctk")
    return {
        "simulator": simulator,
        "passed": int(outcome.is_passed),
        "cases": {case.name: {"passed": outcome.is_passed, "reason": case.reason, "limit": case.limit}},
        "measures": outcome.rows(),
        **environs,
    }


def merge_summaries(old: dict[str, Any], new: dict[str, Any]) -> dict[str, Any]:
    """Return the new summary with the cases that only the old one holds, in the order of `CASES`."""
    merged = {**old["cases"], **new["cases"]}
    cases = {name: merged[name] for name in CASES if name in merged}
    kept = [row for row in old["measures"] if row["case"] in cases and row["case"] not in new["cases"]]
    measures = sorted(kept + new["measures"], key=lambda row: list(CASES).index(row["case"]))
    passed = sum(case["passed"] for case in cases.values())
    return {**new, "passed": passed, "cases": cases, "measures": measures}


def draw_sheet(outcomes: Sequence[Outcome]) -> np.ndarray | None:
    """Return a picture of the end of every case, uint8, shape [height, width, 3]; None if nothing is finite.

    Raises:
        MissingExtraError: The extra `render` is not installed.
    """
    pictures, labels = [], []
    for outcome in outcomes:
        first = outcome.runs.get(outcome.case.picture)
        runs = [run for run in (first, *outcome.runs.values()) if run is not None and run.is_finite.any()]
        if runs:
            pictures.append(_render(runs[0], int(np.flatnonzero(runs[0].is_finite)[-1])))
            labels.append(outcome.case.name.replace("_", " ") + ("" if outcome.is_passed else ": failed"))
    return side_by_side(pictures, labels, columns=_COLUMNS) if pictures else None


def _render(run: Run, frame: int) -> np.ndarray:
    """Return a picture of one frame; cloth and body are one mesh, so that the camera takes in both."""
    positions, faces = run.positions[frame], run.faces
    colors = np.broadcast_to(GARMENT_COLORS[0], positions.shape)
    if run.scene.body is not None:
        obstacle = np.asarray(run.scene.body.positions[frame], np.float64)
        faces = np.concatenate([faces, np.asarray(run.scene.body.surface.faces) + len(positions)])
        positions = np.concatenate([positions, obstacle])
        colors = np.concatenate([colors, np.broadcast_to(SKIN_COLOR, obstacle.shape)])
    return render_frame(
        None, None, positions, faces, camera=_CAMERA, size=_PICTURE_SIZE, vertex_colors=colors
    )
