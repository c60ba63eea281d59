"""Search by gradients beside search without, at equal cost."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from scipy.optimize import minimize

from eslr_jax.pipeline.report.scene_parts import time_in_turns

_STEP = 0.5  # bound of a parameter's change in a step: the loss is no parabola far from its minimum


class Search(NamedTuple):
    """What a search found, and its way there."""

    best: np.ndarray
    losses: list[float]  # of every evaluation
    refused: int = 0  # gradients that were NaN


def descend(value_and_grad: Callable, start: np.ndarray, steps: int) -> Search:
    """Search by L-BFGS of optax, one gradient a step.

    A step that made the loss much higher, or whose gradient was refused, is halved from the best point on.
    """
    optimizer = optax.chain(optax.lbfgs(learning_rate=1.0, linesearch=None), optax.clip(_STEP))
    update = jax.jit(optimizer.update)
    parameters = best = jnp.asarray(start, jnp.float32)
    state, losses, refused, lowest = optimizer.init(parameters), [], 0, np.inf
    for _ in range(steps):
        value, gradient = value_and_grad(parameters)
        is_refused = not bool(jnp.all(jnp.isfinite(gradient)))
        refused += is_refused
        losses.append(float(value))
        if is_refused or not losses[-1] < 1.5 * lowest:
            parameters = 0.5 * (parameters + best)
            continue
        if losses[-1] < lowest:
            best, lowest = parameters, losses[-1]
        updates, state = update(gradient, state, parameters)
        parameters = optax.apply_updates(parameters, updates)
    return Search(np.asarray(best), losses, refused)


def search_simplex(value: Callable, start: np.ndarray, evaluations: int) -> Search:
    """Search by SciPy's Nelder-Mead, with so many evaluations at most."""
    losses: list[float] = []

    def record(parameters: np.ndarray) -> float:
        losses.append(float(value(jnp.asarray(parameters, jnp.float32))))
        return losses[-1]

    corners = np.concatenate([np.zeros((1, len(start))), _STEP * np.eye(len(start))]) + start
    limits = {"initial_simplex": corners, "maxfev": evaluations, "fatol": 0.0, "xatol": 0.0}
    return Search(minimize(record, start, method="Nelder-Mead", options=limits).x, losses)


def race(
    loss: Callable, start: np.ndarray, steps: int, turns: int, unit: float = 1.0
) -> tuple[Callable, float, int, Search, Search]:
    """Search for the least of a loss by gradients, and without in as much time; searches see it in a unit.

    The loss returns more besides. Returned are the loss, compiled; how many evaluations of it a gradient takes
    the time of; how many the second search had; and both searches.
    """
    both, slope = jax.jit(loss), jax.jit(jax.value_and_grad(loss, has_aux=True))

    def value_and_grad(parameters: jax.Array) -> tuple[jax.Array, jax.Array]:
        (value, _), gradient = slope(parameters)
        return value / unit, gradient / unit

    cost = gradient_cost(both, slope, start, turns)
    evaluations = round(cost * steps)
    simplex = search_simplex(lambda parameters: both(parameters)[0] / unit, start, evaluations)
    return both, cost, evaluations, descend(value_and_grad, start, steps), simplex


def gradient_cost(value: Callable, value_and_grad: Callable, at: np.ndarray, turns: int) -> float:
    """Return how many evaluations of the loss a gradient takes the time of: least times, measured in turns."""
    at = jnp.asarray(at, jnp.float32)
    times = time_in_turns({"value": (value, (at,)), "gradient": (value_and_grad, (at,))}, turns)
    return float(min(times["gradient"]) / min(times["value"]))
