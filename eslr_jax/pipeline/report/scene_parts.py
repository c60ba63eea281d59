"""What a scene's compiled step holds, what was left out, and what each part costs (host)."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Hashable
from typing import TypeVar

import jax
import numpy as np

from eslr_jax.config import SimConfig
from eslr_jax.networks.network import Network
from eslr_jax.pipeline.report.report import describe_terms
from eslr_jax.simulation.frame import frame_inputs, frame_problem
from eslr_jax.simulation.rollout import step_frame
from eslr_jax.simulation.stepper import make_stepper
from eslr_jax.solver.guess import initial_guess
from eslr_jax.solver.potential import evaluate
from eslr_jax.solver.preconditioner import solve_stiffness, stretched_stiffness
from eslr_jax.solver.solve import solve
from eslr_jax.terms import Air, Damping, scene_terms
from eslr_jax.types import BodyMotion, Scene

Name = TypeVar("Name", bound=Hashable)
_TURNS = 15  # timings of every part, in turns; medians count
_ITERATIONS = 20  # of the solver's part


@dataclasses.dataclass(frozen=True)
class Modelled:
    """Parts of a scene by name, each with a word on its size."""

    modelled: dict[str, str]
    left_out: dict[str, str]


def describe_scene(scene: Scene, poses: BodyMotion, network: Network | None) -> Modelled:
    """Return what a scene of `prepare_scene` models, given the motion that it was made from, and a network."""
    modelled = describe_terms(scene)
    known = (*scene_terms(), Air((0.0, 0.0, 0.0)), Damping(0.0))
    names = {type(term).__name__.lower(): term for term in known}
    left_out = {name: term.unless_needed for name, term in names.items() if name not in modelled}

    def sort(name: str, is_modelled: bool, size: str, why: str) -> None:
        (modelled if is_modelled else left_out)[name] = size if is_modelled else why

    total = int(np.asarray(poses.faces).shape[0])
    faces = 0 if scene.body is None else scene.body.surface.faces.shape[0]
    sort("body", faces > 0, f"{faces} of {total} faces", "out of reach")
    pinned = int(np.sum(scene.garment.is_pinned))
    sort("pins", scene.pin_targets is not None, f"{pinned} vertices", "none")
    material = vars(scene.material).items()
    varied = [name for name, part in material if any(map(np.ndim, jax.tree.leaves(part)))]
    sort("fabric by part", bool(varied), ", ".join(varied), "one fabric: scalars")
    if scene.initial_state.past is not None:
        modelled["BDF2"] = "swinging cloth keeps its energy"
    if scene.substeps > 1:
        modelled["substeps"] = f"{scene.substeps} a frame"
    sort("network", network is not None, "before the solver", "solver alone")
    return Modelled(modelled, left_out)


def time_parts(network: Network | None, scene: Scene, config: SimConfig) -> dict[str, float]:
    """Return milliseconds of each part of one frame on this device; the parts are timed alternately."""
    state = scene.initial_state
    inputs = jax.tree.map(lambda leaf: leaf[0], frame_inputs(scene))
    problem = jax.jit(frame_problem)(scene, state, inputs)
    guess = jax.jit(initial_guess)(problem)
    stepper = make_stepper(network, config)
    parts: dict[str, tuple[Callable, tuple]] = {
        "gradient of the potential": (lambda x: evaluate(x, problem), (guess.position,)),
        "preconditioner": (lambda x: solve_stiffness(stretched_stiffness(problem, x), x), (guess.position,)),
        f"solver, {_ITERATIONS} iterations": (
            lambda guess: solve(problem, guess, iterations=_ITERATIONS).position,
            (guess,),
        ),
        "whole frame": (lambda state: step_frame(stepper, scene, state, inputs)[0], (state,)),
    }
    if scene.body is not None:
        parts["searches for contacts"] = (lambda state: frame_problem(scene, state, inputs), (state,))
    if network is not None:
        parts["network"] = (lambda state: network.predict(problem, state).position, (state,))
    return take_turns(parts)


def take_turns(parts: dict[str, tuple[Callable, tuple]], turns: int = _TURNS) -> dict[str, float]:
    """Return the median milliseconds of functions with arguments, which are jitted and called alternately."""
    jitted = {name: (jax.jit(function), arguments) for name, (function, arguments) in parts.items()}
    return {name: float(np.median(values)) for name, values in time_in_turns(jitted, turns).items()}


def time_in_turns(parts: dict[Name, tuple[Callable, tuple]], turns: int) -> dict[Name, list[float]]:
    """Return the milliseconds of every call of functions that are jitted already; see `take_turns`."""
    times: dict[Name, list[float]] = {name: [] for name in parts}
    for turn in range(turns + 1):
        for name, (function, arguments) in parts.items():
            began = time.perf_counter()
            jax.block_until_ready(function(*arguments))
            if turn:  # the first compiles
                times[name].append((time.perf_counter() - began) * 1e3)
    return times
