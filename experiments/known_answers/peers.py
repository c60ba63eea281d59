"""Other simulators on the known answers, as far as they are installed: Newton's solvers, Blender's cloth."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

from blender_cloth import blender_simulator
from hard_cases import Simulator
from newton_cloth import Setting, newton_simulator

from eslr_jax.errors import MissingExtraError
from known_answers.cases import FOR_PEERS, Answer, slope

_NEWTON = {
    "Newton VBD 5x20": Setting("vbd", 5, 20),
    "Newton Style3D 2x20": Setting("style3d", 2, 20),
    "Newton XPBD": Setting("xpbd", None, 1),
}
_BLENDER = (45, 2)  # steps per frame, rounds of collision per step
_SLOPES = (35.0, 60.0)  # [degrees]


def peers() -> Iterator[Simulator]:
    """Yield the simulators that are installed."""
    for name, setting in _NEWTON.items():
        try:
            yield dataclasses.replace(newton_simulator(setting), name=name)
        except MissingExtraError as error:
            print(f"left out: {error}")
            break
    try:
        yield dataclasses.replace(blender_simulator(_BLENDER), name="Blender {}x{}".format(*_BLENDER))
    except MissingExtraError as error:
        print(f"left out: {error}")


def compare(is_smoke: bool) -> Iterator[Answer]:
    """Yield what other simulators find."""
    for simulator in peers():
        for case in FOR_PEERS[:1] if is_smoke else FOR_PEERS:
            yield from slope(simulator, _SLOPES) if case is slope else case(simulator)
