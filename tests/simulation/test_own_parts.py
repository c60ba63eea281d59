"""An energy of one's own goes through the public doors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from draped_ball import drifting_ball, square
from flax import struct
from own_term import Push

from eslr_jax import NonFiniteError, SimConfig, plan_scene, prepare_scene, rollout, simulate
from eslr_jax.pipeline.report.report import trajectory_report
from eslr_jax.terms import CLOTH, Term

DENSITY = 0.20022  # [kg/m2] of cotton


@struct.dataclass
class Root(Term):
    """An energy without a finite gradient."""

    name = "root"
    on = "vertices"

    def corner_energies(self, corners, problem, data):
        return jnp.sqrt(jnp.maximum(0.0 * corners[0][0], 0.0))


def test_an_own_energy_moves_the_cloth_stands_in_the_report_and_is_differentiated():
    garment = square()
    terms, poses = plan_scene(garment, drifting_ball(4, speed=0.0), terms=(*CLOTH, Push(1.0)))

    def last(pressure):
        windy = (*terms[:-1], Push(pressure))
        trajectory = rollout(None, garment, poses, config=SimConfig(iterations=30), terms=windy)
        return trajectory.positions[-1, :, 0].mean(), trajectory

    slope, trajectory = jax.jit(jax.grad(last, has_aux=True))(jnp.float32(5.0))
    way = np.asarray(trajectory.positions[..., 0]).mean(axis=1)
    # Implicit Euler under a constant force: the speed grows by a dt each frame, and the place by v dt.
    known = np.array([0, 1, 3, 6]) / DENSITY / 30**2
    np.testing.assert_allclose(way - way[0], 5.0 * known, rtol=1e-3, atol=1e-6)
    assert float(slope) == pytest.approx(known[-1], rel=1e-2)
    scene = prepare_scene(garment, poses, terms=CLOTH)
    own = trajectory_report(trajectory, scene)["terms"]["push"]
    area = float(garment.vertex_areas.sum())
    assert own == pytest.approx(-5.0 * area * 5.0 * known[1:].mean(), rel=1e-3)


def test_an_own_energy_without_a_finite_gradient_is_refused():
    """The solver would stay at its guess, at positions that are finite."""
    scene = prepare_scene(square(), drifting_ball(3, speed=0.0), terms=(*CLOTH, Root()))
    with pytest.raises(NonFiniteError, match="forces"):
        simulate(None, scene, config=SimConfig(iterations=5))
