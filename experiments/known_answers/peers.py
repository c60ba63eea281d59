"""Other simulators on the known answers, as far as they are installed: Newton's solvers, Blender's cloth."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import newton_cloth
from blender_cloth import BEST, blender_simulator
from hard_cases import Simulator

from eslr_jax.errors import MissingExtraError
from known_answers.cases import FOR_PEERS, Answer, slope

_SLOPES = (35.0, 60.0)  # [degrees]


def peers() -> Iterator[Simulator]:
    """Yield the simulators that are installed."""
    for setting in newton_cloth.BEST:
        effort = f" {setting.substeps}x{setting.iterations}" if setting.substeps else ""
        try:
            yield dataclasses.replace(newton_cloth.newton_simulator(setting), name=setting.name + effort)
        except MissingExtraError as error:
            print(f"left out: {error}")
            break
    try:
        yield dataclasses.replace(blender_simulator(BEST), name="Blender {}x{}".format(*BEST))
    except MissingExtraError as error:
        print(f"left out: {error}")


def compare(is_smoke: bool) -> Iterator[Answer]:
    """Yield what other simulators find."""
    for simulator in peers():
        for case in FOR_PEERS[:1] if is_smoke else FOR_PEERS:
            yield from slope(simulator, _SLOPES) if case is slope else case(simulator)
