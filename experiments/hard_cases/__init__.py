"""Fifteen situations that break simulators, each with its measures and limits.

Any simulator runs them, as a library from `experiments/`: `run_case(find_case("hang"), solver_simulator())`;
or by the command `python experiments/hard_cases`, see `__main__.py`.
"""

from __future__ import annotations

import difflib

from eslr_jax.errors import ConfigError
from hard_cases.bad_mesh import BAD_MESH
from hard_cases.ball import DROP, START_INSIDE, STEPS_AND_FABRICS, drop_scene
from hard_cases.case import CaseScene, HardCase, Measure, Outcome, Run, Simulator, run_case, worst
from hard_cases.free import BAD_START, FREE_FALL, HANG, PULL, TWIST
from hard_cases.layers import LAYERS
from hard_cases.limbs import FAST_LIMB, PINCH, TURNED
from hard_cases.obstacles import NEEDLE, SLOPE

_ORDER = (
    *(FREE_FALL, TURNED, HANG, DROP, FAST_LIMB, START_INSIDE, BAD_START, PULL, STEPS_AND_FABRICS),
    *(TWIST, LAYERS, NEEDLE, PINCH, BAD_MESH, SLOPE),
)
CASES: dict[str, HardCase] = {case.name: case for case in _ORDER}


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


__all__ = [
    "CASES", "CaseScene", "HardCase", "Measure", "Outcome", "Run",
    "Simulator", "drop_scene", "find_case", "run_case", "worst",
]  # fmt: skip
