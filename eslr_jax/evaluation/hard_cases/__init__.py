"""The hard cases: fifteen situations that break simulators, each with its measures and bars.

Any simulator runs all of them: `run_case("hang", physics_simulator())`.
"""

from __future__ import annotations

import difflib
from typing import Any

from eslr_jax.errors import ConfigError
from eslr_jax.evaluation.hard_cases.body import (
    DROP,
    FAST_LIMB,
    START_INSIDE,
    STEPS_AND_FABRICS,
    TURNED,
)
from eslr_jax.evaluation.hard_cases.case import HardCase, Outcome, play
from eslr_jax.evaluation.hard_cases.cloth import BAD_MESH, BAD_START, FREE_FALL, HANG, PULL, TWIST
from eslr_jax.evaluation.hard_cases.layers import LAYERS
from eslr_jax.evaluation.hard_cases.measures import Measure
from eslr_jax.evaluation.hard_cases.obstacles import NEEDLE, PINCH, SLOPE
from eslr_jax.evaluation.hard_cases.simulators import (
    Run,
    Simulator,
    StressScene,
    network_simulator,
    physics_simulator,
)

CASES: dict[str, HardCase] = {
    case.name: case
    for case in (
        FREE_FALL,
        TURNED,
        HANG,
        DROP,
        FAST_LIMB,
        START_INSIDE,
        BAD_START,
        PULL,
        STEPS_AND_FABRICS,
        TWIST,
        LAYERS,
        NEEDLE,
        PINCH,
        BAD_MESH,
        SLOPE,
    )
}


def find_case(name: str) -> HardCase:
    """Return a case by name.

    Raises:
        ConfigError: There is no such case; the message names the nearest one.
    """
    if name in CASES:
        return CASES[name]
    close = difflib.get_close_matches(name, CASES, n=1)
    hint = f"did you mean {close[0]}? " if close else ""
    raise ConfigError(f"no hard case named {name!r}: {hint}there are {', '.join(CASES)}")


def run_case(name: str, simulator: Simulator) -> list[dict[str, Any]]:
    """Run one hard case.

    Args:
        name: Of `CASES`.
        simulator: Of `physics_simulator` or `network_simulator`, or any other.

    Returns:
        A row per measure: case, passed, measure, value and bar. A value passes at or below its bar; a bar of
        None is for information.
    """
    return play(find_case(name), simulator).rows()


__all__ = [
    "CASES",
    "HardCase",
    "Measure",
    "Outcome",
    "Run",
    "Simulator",
    "StressScene",
    "find_case",
    "network_simulator",
    "physics_simulator",
    "play",
    "run_case",
]
