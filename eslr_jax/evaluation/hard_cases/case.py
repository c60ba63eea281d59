"""A hard case, and how it is run."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from eslr_jax.errors import EslrError, Status
from eslr_jax.evaluation.hard_cases.measures import Measure, not_finite
from eslr_jax.evaluation.hard_cases.simulators import Run, Simulator, StressScene, run_scene, shorten

Scenes = dict[str, StressScene | EslrError]  # an error: the scene itself was refused
Runs = dict[str, Run]


@dataclasses.dataclass(frozen=True)
class HardCase:
    """One situation that breaks simulators."""

    name: str
    reason: str  # why it is hard, in a line
    build: Callable[[dict[str, Any]], Scenes]  # from what the simulator asks of `prepare_garment`
    measure: Callable[[Runs], list[Measure]]
    picture: str  # the scene to show
    may_refuse: bool = False  # a named error is an answer
    limit: str = ""  # what the solver itself can't do here, with figures


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What a simulator made of a case."""

    case: str
    measures: list[Measure]
    runs: Runs

    @property
    def is_passed(self) -> bool:
        """Whether every measure is within its bar."""
        return all(measure.is_passed for measure in self.measures)

    def rows(self) -> list[dict[str, Any]]:
        """Return plain values, one row per measure."""
        return [
            {
                "case": self.case,
                "passed": measure.is_passed,
                "measure": measure.name,
                "value": float(measure.value) if np.isfinite(measure.value) else None,
                "bar": measure.bar,
            }
            for measure in self.measures
        ]


def play(case: HardCase, simulator: Simulator, *, max_frames: int | None = None) -> Outcome:
    """Simulate all scenes of a case and measure them.

    Args:
        case: The case.
        simulator: Anything that simulates a scene.
        max_frames: Cut every scene short, to see whether it runs at all; nothing is measured but finiteness,
            nor is it where a scene is not finite.
    """
    scenes = case.build(simulator.garment_options)
    runs: Runs = {}
    for label, stress in scenes.items():
        whole = stress if isinstance(stress, EslrError) else shorten(stress, max_frames)
        runs[label] = run_scene(simulator, whole)
    refused = {label: run for label, run in runs.items() if run.trajectory is None}
    ran = [run for run in runs.values() if run.trajectory is not None]
    measures = [Measure("frames not finite", sum(map(not_finite, ran)), 0)]
    if refused and not case.may_refuse:
        measures.append(Measure(f"scenes refused ({', '.join(refused)})", len(refused), 0))
        return Outcome(case.name, measures, runs)
    overflowed = [label for label, run in runs.items() if Status.SELF_CONTACT_OVERFLOW in run.status]
    if overflowed:
        measures.append(
            Measure(f"scenes with too many self-contacts ({', '.join(overflowed)})", len(overflowed), 0)
        )
    if max_frames is None and measures[0].is_passed:
        measures += case.measure(runs)
    return Outcome(case.name, measures, runs)
