"""The solver's minimum against that of Newton's method in float64."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from newton_oracle import minimize_newton, potential_float64
from physics_cases import make_case

from eslr_jax.solver.lbfgs import Stop, minimize
from eslr_jax.solver.potential import potential
from eslr_jax.solver.preconditioner import stiffness


@jax.jit
def descend(problem, position):
    return minimize(lambda x: potential(x, problem), position, stiffness(problem, position), Stop(400))


@pytest.mark.parametrize(
    "is_pinned",
    [pytest.param(None, id="free", marks=pytest.mark.slow), pytest.param(np.arange(30) < 6, id="pinned")],
)
def test_newton_ends_where_lbfgs_ends(is_pinned):
    problem, position = make_case(is_pinned=is_pinned)
    found = minimize_newton(problem)
    assert found.iterations < 60
    if is_pinned is not None:
        position = np.where(is_pinned[:, None], problem.pin_targets, position)
        np.testing.assert_array_equal(found.position[is_pinned], problem.pin_targets[is_pinned])
    with jax.enable_x64(True):
        other = descend(problem, position)
    gap = potential_float64(position, problem) - found.value
    # Two starts may end in different folds; their energies differ by less than 0.2 % of the initial gap.
    assert abs(float(other.value) - found.value) < 2e-3 * gap
