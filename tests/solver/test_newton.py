"""The solver's minimum against that of Newton's method in float64."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cloth import make_garment, make_sheet
from newton_oracle import minimize_newton, potential_float64
from physics_cases import make_case

from eslr_jax.fabric.materials import COTTON
from eslr_jax.simulation.frame import FrameInput, frame_problem
from eslr_jax.simulation.scene import initial_state
from eslr_jax.solver.lbfgs import Stop, minimize
from eslr_jax.solver.potential import potential
from eslr_jax.solver.preconditioner import stiffness
from eslr_jax.terms import CLOTH, Repulsion
from eslr_jax.types import Scene


@pytest.fixture(scope="module")
def two_layers():
    """A frame of two sheets that fall, one 2 mm over the other: nearer than they may be."""
    positions, faces = make_sheet(5, 6)
    lifted = positions + np.array([0.004, 0.002, 0.003])
    garment = make_garment(
        np.concatenate([positions, lifted]), np.concatenate([faces, faces + len(positions)])
    )
    velocity = np.zeros(garment.rest_positions.shape, np.float32)
    velocity[len(positions) :, 1] = -0.05
    scene = Scene(
        garment=garment,
        material=COTTON,
        timestep=jnp.float32(1 / 30),
        initial_state=initial_state(garment.rest_positions, jnp.asarray(velocity)),
        body=None,
        pin_targets=None,
        terms=(*CLOTH, Repulsion()),
        num_frames=2,
    )
    return jax.jit(frame_problem)(scene, scene.initial_state, FrameInput(None, None))


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


def test_newton_parts_layers(two_layers):
    problem = two_layers
    layers = problem.data_of(Repulsion)
    assert int(layers.pairs.count) > 20
    found = minimize_newton(problem)
    middle = len(found.position) // 2
    gap = np.mean(found.position[middle:, 1]) - np.mean(found.position[:middle, 1])
    assert 0.7 < gap / float(layers.thickness.max()) < 1.05, "pushed apart, against the speed of approach"
