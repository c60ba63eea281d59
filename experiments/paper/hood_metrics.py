"""HOOD's measures of a trajectory: its six terms, penetration and the norm of the gradient."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from eslr_jax.numerics import masked_sum, safe_norm
from eslr_jax.physics.hood import (
    METRIC_PARAMETERS,
    BodyFrames,
    Criterion,
    HoodParameters,
    HoodProblem,
    criterion_depths,
    hood_terms,
)
from eslr_jax.types import PotentialTerms, Scene

_ORIGIN = np.zeros(3, np.float32)


class HoodMetrics(NamedTuple):
    """What HOOD's evaluation reports of every frame from the third on."""

    terms: PotentialTerms  # [J], each of shape [frames - 2]
    penetrating_share: Float[Array, " steps"]  # of vertices within the thickness, HOOD's `perc`
    gradient_norm: Float[Array, " steps"]  # mean over vertices of the total's gradient [N]


@partial(jax.jit, static_argnames="criterion")
def hood_metrics(
    positions: Float[Array, "frames vertices 3"],
    scene: Scene,
    *,
    origin: Float[np.ndarray, " 3"] = _ORIGIN,
    parameters: HoodParameters = METRIC_PARAMETERS,
    criterion: Criterion = "metric",
) -> HoodMetrics:
    """Measure every frame of a trajectory from the third on, each with the two frames before it.

    The paper's Total is the mean over frames of the sum of the terms. Its collision column most likely uses the
    training criterion at 5e3: `HoodParameters()` with "postcvpr".

    Args:
        positions: Garment vertices of all frames [m], shape [frames, vertices, 3].
        scene: Their scene, with a body; every face that it searches counts.
        origin: Point from which heights count [m], shape [3].
        parameters: Weights and thresholds.
        criterion: Frames of the body that count, see `physics.hood`.

    Source: HOOD, repository at 9bc1076, utils/metrics.py.
    """
    garment, body = scene.garment, scene.body
    if body is None:
        raise ValueError("HOOD's measures need a scene with a body")

    def total(position: Array, problem: HoodProblem):
        terms = hood_terms(position, problem, criterion=criterion)
        return sum(terms), terms

    def measure(frames):
        (previous, current, position), obstacles = frames
        bodies = BodyFrames(*obstacles, body.surface.faces)
        problem = HoodProblem(current, previous, bodies, garment, scene.material, scene.timestep, parameters)
        gradient, terms = jax.grad(total, has_aux=True)(position, problem)
        depth = criterion_depths(position, problem, criterion)
        is_real = garment.vertex_mask
        count = jnp.sum(is_real).astype(position.dtype)
        inside = jnp.sum(is_real & (depth > 0), dtype=depth.dtype) / count
        return HoodMetrics(terms, inside, masked_sum(safe_norm(gradient), is_real) / count)

    def triples(moving: Array) -> tuple[Array, Array, Array]:
        moving = moving - jnp.asarray(origin)[None, None]
        return moving[:-2], moving[1:-1], moving[2:]

    return jax.lax.map(measure, (triples(positions), triples(body.positions)))
