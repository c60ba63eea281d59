"""HOOD's six terms over a trajectory."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from eslr_jax.terms.hood import (
    METRIC_PARAMETERS,
    BodyFrames,
    Criterion,
    HoodParameters,
    HoodProblem,
    hood_terms,
)
from eslr_jax.types import Scene

_ORIGIN = np.zeros(3, np.float32)


@partial(jax.jit, static_argnames="criterion")
def hood_metrics(
    positions: Float[Array, "frames vertices 3"],
    scene: Scene,
    *,
    origin: Float[np.ndarray, " 3"] = _ORIGIN,
    parameters: HoodParameters = METRIC_PARAMETERS,
    criterion: Criterion = "metric",
) -> dict[str, Float[Array, " frames"]]:
    """Return the terms [J] of every frame from the third on, each with the two frames before it: [frames - 2].

    The paper's Total is the mean over frames of the sum of the terms. Its collision column most likely uses the
    training criterion at 5e3: `HoodParameters()` with "postcvpr". Heights count from `origin` [m].

    Source: HOOD, repository at 9bc1076, utils/metrics.py.
    """
    garment, body = scene.garment, scene.body
    if body is None:
        raise ValueError("HOOD's measures need a scene with a body")

    def measure(frames):
        (previous, current, position), obstacles = frames
        bodies = BodyFrames(*obstacles, body.surface.faces)
        problem = HoodProblem(current, previous, bodies, garment, scene.material, scene.timestep, parameters)
        return hood_terms(position, problem, criterion=criterion)

    def triples(moving: Array) -> tuple[Array, Array, Array]:
        moving = moving - jnp.asarray(origin)[None, None]
        return moving[:-2], moving[1:-1], moving[2:]

    return jax.lax.map(measure, (triples(positions), triples(body.positions)))
