"""A hard case, the simulators that run it, and what comes of it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from eslr_jax import Network, SimConfig, Trajectory, simulate
from eslr_jax.errors import EslrError, Status
from eslr_jax.simulation.scene import Integrator, start_integrator
from eslr_jax.types import Scene
from hard_cases.colliders import Collider

_SHIFT = 1e-5  # [m] by which vertices of another start are shifted at most: folds are chaotic

Colliders = Callable[[int], Sequence[Collider]]
"""From a frame to the solids that the body stands for."""


@dataclasses.dataclass(frozen=True)
class CaseScene:
    """A scene of a case, with its body in closed form."""

    scene: Scene
    colliders: Colliders = lambda frame: ()


@dataclasses.dataclass(frozen=True)
class Simulator:
    """Anything that simulates a scene; it may refuse by raising an `EslrError`."""

    name: str
    simulate: Callable[[Scene], Trajectory]
    garment_options: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # of `prepare_garment`
    integrator: Integrator = "euler"
    substeps: int = 1  # of every frame

    def prepare(self, scene: Scene, start: int = 0) -> Scene:
        """Return a case's scene with what this simulator models, from a start of `shifted`."""
        state = start_integrator(scene.initial_state, self.integrator)
        return shifted(scene.replace(initial_state=state, substeps=self.substeps), start)


def shifted(scene: Scene, start: int) -> Scene:
    """Return a scene whose cloth begins a little beside its first state; start 0 is that state."""
    shift = _SHIFT * np.random.default_rng(start).uniform(-1.0, 1.0, scene.initial_state.position.shape)
    is_moved = np.asarray(scene.garment.vertex_mask & ~scene.garment.is_pinned)[:, None] & (start > 0)
    position = scene.initial_state.position + np.where(is_moved, shift, 0.0).astype(np.float32)
    return scene.replace(initial_state=scene.initial_state.replace(position=position))


def solver_simulator(
    iterations: int | None = None, integrator: Integrator = "bdf2", *, substeps: int = 1
) -> Simulator:
    """Return the L-BFGS solver as a simulator, see `Simulator`: by default as `eslr simulate` has it."""
    config = SimConfig() if iterations is None else SimConfig(iterations=iterations)

    def run(scene: Scene) -> Trajectory:
        return simulate(None, scene, config=config, raises=False).trajectory

    parts = ["physics", integrator, f"{substeps} substeps" * (substeps > 1)]
    parts.append(f"{iterations} iterations" if iterations else f"a gap of {100 * config.tolerance:g} %")
    return Simulator(", ".join(filter(None, parts)), run, integrator=integrator, substeps=substeps)


def network_simulator(name: str, network: Network, iterations: int = 0) -> Simulator:
    """Return a network as a simulator, with so many iterations of the solver behind it."""

    def run(scene: Scene) -> Trajectory:
        config = SimConfig(iterations=iterations)
        return simulate(network, scene, config=config, raises=False).trajectory

    label = f"{name}, {iterations} iterations" if iterations else name
    return Simulator(label, run, network.garment_options)


@dataclasses.dataclass(frozen=True)
class Run:
    """A scene that was simulated."""

    scene: Scene
    colliders: Colliders
    trajectory: Trajectory

    @cached_property
    def positions(self) -> Float[np.ndarray, "frames vertices 3"]:
        """Positions of the vertices that are no padding, float64 [m], shape [frames, vertices, 3]."""
        is_real = np.asarray(self.scene.garment.vertex_mask)
        return np.asarray(self.trajectory.positions, np.float64)[:, is_real]

    @cached_property
    def faces(self) -> Int[np.ndarray, "faces 3"]:
        """Faces that are no padding, shape [faces, 3]."""
        return np.asarray(self.scene.garment.faces)[np.asarray(self.scene.garment.rest_areas) > 0]

    @property
    def timestep(self) -> float:
        """Seconds between frames."""
        return float(self.scene.timestep)

    @property
    def status(self) -> Status:
        """What the simulator itself found wrong."""
        return Status(int(self.trajectory.status))

    @cached_property
    def is_finite(self) -> np.ndarray:
        """Which frames hold neither NaN nor infinity, shape [frames]."""
        return np.isfinite(self.positions).all(axis=(1, 2))


class Measure(NamedTuple):
    """One figure and its bar."""

    name: str  # with the unit
    value: float
    bar: float | None  # the value passes at or below it; None is for information alone

    @property
    def is_passed(self) -> bool:
        """Whether the value is a number at or below the bar."""
        return self.bar is None or bool(np.isfinite(self.value) and self.value <= self.bar)


Scenes = dict[str, CaseScene | EslrError]  # an error: the scene itself was refused
Runs = dict[str, Run]


@dataclasses.dataclass(frozen=True)
class HardCase:
    """One situation that breaks simulators."""

    name: str
    reason: str  # why it is hard, in a line
    build: Callable[[Mapping[str, Any]], Scenes]  # from options of `prepare_garment`
    measure: Callable[[Runs], list[Measure]]
    picture: str  # the scene to show
    may_refuse: bool = False  # a named error is an answer
    limit: str = ""  # what the solver itself can't do here, with figures


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What a simulator made of a case."""

    case: HardCase
    measures: list[Measure]
    runs: Runs

    @property
    def is_passed(self) -> bool:
        """Whether every measure is within its bar."""
        return all(measure.is_passed for measure in self.measures)

    def rows(self) -> list[dict[str, Any]]:
        """Return plain values, one row per measure: case, passed, measure, value and bar."""
        return [
            {
                "case": self.case.name,
                "passed": measure.is_passed,
                "measure": measure.name,
                "value": float(measure.value) if np.isfinite(measure.value) else None,
                "bar": measure.bar,
            }
            for measure in self.measures
        ]


def worst(outcomes: Sequence[Outcome]) -> Outcome:
    """Return what came of several starts of a case: their largest figures, and how many starts failed."""
    if len(outcomes) == 1:
        return outcomes[0]
    found: dict[str, Measure] = {}
    for measure in (measure for outcome in outcomes for measure in outcome.measures):
        largest = found.setdefault(measure.name, measure)
        if not np.isfinite(measure.value) or measure.value > largest.value:
            found[measure.name] = measure
    failed = [outcome for outcome in outcomes if not outcome.is_passed]
    count = Measure(f"starts of {len(outcomes)} that failed", len(failed), 0)
    return dataclasses.replace((failed or outcomes)[0], measures=[count, *found.values()])


def run_case(case: HardCase, simulator: Simulator, start: int = 0) -> Outcome:
    """Simulate all scenes of a case and measure them, from a start of `Simulator.prepare`.

    Nothing else is measured where a frame is not finite, or where a simulator says that it failed.
    """
    runs: Runs = {}
    refusals: dict[str, EslrError] = {}
    for label, built in case.build(simulator.garment_options).items():
        try:
            if isinstance(built, EslrError):
                raise built
            scene = simulator.prepare(built.scene, start)
            runs[label] = Run(scene, built.colliders, simulator.simulate(scene))
        except EslrError as error:
            refusals[label] = error
    measures = [Measure("frames not finite", sum(int(np.sum(~run.is_finite)) for run in runs.values()), 0)]
    failed = [f"{label}: {run.status.name}" for label, run in runs.items() if run.status != Status.OK]
    if failed:
        measures.append(Measure(f"scenes that failed ({', '.join(failed)})", len(failed), 0))
    if refusals and not case.may_refuse:
        measures.append(Measure(f"scenes refused ({', '.join(refusals)})", len(refusals), 0))
    if all(measure.is_passed for measure in measures):
        measures += [Measure(f"{label}: refused, {error}"[:100], 0, 0) for label, error in refusals.items()]
        measures += case.measure(runs)
    return Outcome(case, measures, runs)
