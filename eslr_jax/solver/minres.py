"""Linear systems with a symmetric matrix that need not be positive definite."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from eslr_jax.numerics import product

Operator = Callable[[Float[Array, "*shape"]], Float[Array, "*shape"]]


class LinearSolution(NamedTuple):
    """What became of a linear system H v = b."""

    displacement: Float[Array, "*shape"]  # v [m]
    residual: Float[Array, ""]  # relative to b, in the preconditioner's norm
    iterations: Int[Array, ""]
    is_indefinite: Bool[Array, ""]  # a direction of negative curvature was met


class _State(NamedTuple):
    """A Lanczos process and its QR factorisation; the names are those of the source."""

    x: Array
    r1: Array  # last Lanczos vector but one, without the preconditioner and not normalised
    r2: Array  # last one
    y: Array  # the last one, preconditioned
    w1: Array  # directions that x was moved along
    w2: Array
    beta: Array
    old_beta: Array
    cosine: Array
    sine: Array
    dbar: Array
    epsilon: Array
    phi: Array  # norm of the residual
    pivot: Array  # of the tridiagonal matrix's factorisation: negative where the matrix is not positive
    iterations: Array
    is_indefinite: Array


def solve_symmetric(
    apply: Operator,
    precondition: Operator,
    force: Float[Array, "*shape"],
    *,
    tolerance: float,
    iterations: int,
) -> LinearSolution:
    """Solve H v = force by preconditioned MINRES.

    Its residual never grows, also where H is indefinite. Conjugate gradients divide by curvatures, and in float32
    they stall where one is near zero.

    `apply` is the product with H, symmetric, and `precondition` that with an estimate of H^-1, symmetric and
    positive definite. The tolerance of the residual is relative to the force.

    Source: Paige and Saunders 1975, doi 10.1137/0712047.
    """
    y = precondition(force)
    whole = jnp.sqrt(_inner(force, y))
    zero, zeros = jnp.zeros((), force.dtype), jnp.zeros_like(force)

    def is_running(state: _State) -> Array:
        return (state.phi > tolerance * whole) & (state.iterations < iterations) & (state.beta > 0)

    def iterate(s: _State) -> _State:
        v = s.y / s.beta
        applied = apply(v) - s.beta / jnp.where(s.old_beta > 0, s.old_beta, 1.0) * s.r1
        alpha = _inner(v, applied)
        applied = applied - alpha / s.beta * s.r2
        y = precondition(applied)
        beta = jnp.sqrt(jnp.maximum(_inner(applied, y), 0.0))

        delta = s.cosine * s.dbar + s.sine * alpha
        gbar = s.sine * s.dbar - s.cosine * alpha
        gamma = jnp.hypot(gbar, beta)
        gamma = jnp.where(gamma > 0, gamma, jnp.finfo(v.dtype).tiny)
        cosine, sine = gbar / gamma, beta / gamma
        w = (v - s.epsilon * s.w1 - delta * s.w2) / gamma
        lost = jnp.where(s.pivot == 0, 0.0, s.beta**2 / jnp.where(s.pivot == 0, 1.0, s.pivot))
        pivot = alpha - jnp.where(s.iterations > 0, lost, 0.0)
        return _State(
            x=s.x + cosine * s.phi * w,
            r1=s.r2,
            r2=applied,
            y=y,
            w1=s.w2,
            w2=w,
            beta=beta,
            old_beta=s.beta,
            cosine=cosine,
            sine=sine,
            dbar=-s.cosine * beta,
            epsilon=s.sine * beta,
            phi=sine * s.phi,
            pivot=pivot,
            iterations=s.iterations + 1,
            is_indefinite=s.is_indefinite | (pivot < 0),
        )

    start = _State(
        x=zeros,
        r1=zeros,
        r2=force,
        y=y,
        w1=zeros,
        w2=zeros,
        beta=whole,
        old_beta=zero,
        cosine=-jnp.ones_like(zero),
        sine=zero,
        dbar=zero,
        epsilon=zero,
        phi=whole,
        pivot=zero,
        iterations=jnp.int32(0),
        is_indefinite=jnp.zeros((), bool),
    )
    end = jax.lax.while_loop(is_running, iterate, start)
    # The recursion's own residual goes on falling where rounding has stopped the true one.
    left = force - apply(end.x)
    residual = jnp.sqrt(_inner(left, precondition(left))) / jnp.where(whole > 0, whole, 1.0)
    return LinearSolution(end.x, residual, end.iterations, end.is_indefinite)


def _inner(left: Float[Array, "*shape"], right: Float[Array, "*shape"]) -> Float[Array, ""]:
    """Return the sum of left times right, entry by entry."""
    return product(left.ravel(), right.ravel())
