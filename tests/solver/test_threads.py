"""Warp and weft against what a strip of fabric is measured by, and what is modelled only when it is asked for."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cloth import make_garment
from draped_ball import drifting_ball, square
from known_answers.sheets import irregular
from newton_oracle import minimize_newton, potential_float64

from eslr_jax import ConfigError, prepare_scene
from eslr_jax.fabric.materials import COTTON, Weave
from eslr_jax.mesh.plate import warp_directions
from eslr_jax.mesh.prepare import with_rest_positions
from eslr_jax.pipeline.fabrics import Described, describe_fabric, on_threads
from eslr_jax.simulation.frame import first_problem
from eslr_jax.solver.guess import Start, initial_guess
from eslr_jax.solver.potential import potential
from eslr_jax.solver.solve import solve
from eslr_jax.solver.tangent import apply, tangent
from eslr_jax.terms.bending import bending_energy
from eslr_jax.terms.stretch import stretch_energy

WARP, WEFT, COUPLING, SHEAR = 900.0, 200.0, 60.0, 25.0  # [N/m]
STRETCH = jax.jit(jax.value_and_grad(stretch_energy))


def fabric_on(garment, weave, direction=(0.0, 0.0, 1.0)):
    warp = warp_directions(garment, direction=direction)
    return on_threads(COTTON, garment, warp, [(np.ones(len(warp), bool), Described(COTTON, weave))])


@pytest.fixture(scope="module")
def sheet():
    positions, faces = irregular(0.1, 0.08, 0.02)
    return make_garment(positions, faces)


def deformed(garment, gradient):
    return jnp.asarray(np.asarray(garment.rest_positions) @ np.asarray(gradient).T, jnp.float32)


@pytest.mark.parametrize(("strain", "expected"), [
    ((0.0, 0.1, 0.0), 0.5 * WARP * 0.01),
    ((0.1, 0.0, 0.0), 0.5 * WEFT * 0.01),
    ((0.1, 0.1, 0.0), 0.5 * (WARP + WEFT + 2 * COUPLING) * 0.01),
    ((0.0, 0.0, 0.1), 2.0 * SHEAR * 0.01),
])  # fmt: skip
def test_every_stiffness_acts_along_its_own_threads(sheet, strain, expected):
    """By the Green strain along x (weft), along z (warp) and between them; the faces lie any which way."""
    along_x, along_z, mixed = strain
    metric = np.eye(2) + 2 * np.array([[along_x, mixed], [mixed, along_z]])
    (values, vectors) = np.linalg.eigh(metric)
    root = vectors * np.sqrt(values) @ vectors.T
    gradient = np.eye(3)
    gradient[np.ix_([0, 2], [0, 2])] = root
    material = fabric_on(sheet, Weave((WARP, WEFT, COUPLING, SHEAR)))
    energy, _ = STRETCH(deformed(sheet, gradient), sheet, material)
    assert float(energy) / float(np.sum(sheet.rest_areas)) == pytest.approx(expected, rel=1e-3)


def test_equal_threads_are_the_isotropic_sheet(sheet):
    usual = [float(part) * float(COTTON.thickness) for part in (COTTON.lame_mu, COTTON.lame_lambda)]
    both = 2 * usual[0] + usual[1]
    material = fabric_on(sheet, Weave((both, both, usual[1], usual[0])), (1.0, 0.0, 0.4))
    noise = 0.003 * np.random.default_rng(0).standard_normal(sheet.rest_positions.shape)
    position = jnp.asarray(np.asarray(sheet.rest_positions) + noise, jnp.float32)
    (value, gradient), expected = (STRETCH(position, sheet, fabric) for fabric in (material, COTTON))
    np.testing.assert_allclose(value, expected[0], rtol=1e-4)
    np.testing.assert_allclose(gradient, expected[1], atol=1e-4 * np.abs(expected[1]).max())


def test_threads_stiffen_beyond_their_limit_and_only_there(sheet):
    weave = Weave((WARP, WEFT, COUPLING, SHEAR))
    limited = Weave(weave.stiffness, limits=(0.05, 0.2))
    for stretch, is_beyond in ((1.04, False), (1.08, True)):
        position = deformed(sheet, np.diag([1.0, 1.0, stretch]))
        plain, bound = (float(STRETCH(position, sheet, fabric_on(sheet, one))[0]) for one in (weave, limited))
        strain, limit = 0.5 * (stretch**2 - 1), 0.05 + 0.5 * 0.05**2
        expected = WARP * max(strain - limit, 0.0) ** 3 / 0.06 * float(np.sum(sheet.rest_areas))
        assert bound - plain == pytest.approx(expected, rel=0.01, abs=1e-7)
        assert (expected > 0) == is_beyond


@pytest.mark.slow
def test_newton_and_lbfgs_find_one_minimum_of_a_woven_sheet(woven_problem):
    soft = fabric_on(woven_problem.garment, Weave((90.0, 40.0, 10.0, 8.0), (2e-5, 1e-5)))
    problem = woven_problem.replace(material=soft)
    newton = minimize_newton(problem)
    start = jax.jit(initial_guess)(problem)
    found = jax.jit(partial(solve, iterations=300))(problem, Start(*start))
    gap = potential_float64(found.position, problem) - newton.fun
    assert -1e-9 < gap < 1e-3 * (float(start.inertial_energy) - newton.fun)


@pytest.fixture(scope="module")
def woven_problem():
    garment = square(5, 0.12)
    material = fabric_on(garment, describe_fabric("denim-woven").weave)
    return jax.jit(first_problem)(prepare_scene(garment, drifting_ball(2), material=material))


@pytest.mark.slow
def test_the_assembled_product_holds_threads_and_plate(woven_problem):
    problem = woven_problem
    noise, move = np.random.default_rng(0).standard_normal((2, *problem.position.shape)).astype(np.float32)
    position = problem.position + 1e-3 * jnp.asarray(noise)
    move = jnp.asarray(move)

    @jax.jit
    def both(position, problem):
        _, expected = jax.jvp(lambda x: jax.grad(potential)(x, problem), (position,), (move,))
        return apply(tangent(problem, position), move.T).T, expected

    found, expected = both(position, problem)
    np.testing.assert_allclose(found, expected, atol=1e-5 * float(jnp.abs(expected).max()))


def test_bending_in_newton_metres_refuses_another_rest_shape(sheet):
    """Its rows are those of the shape that it was prepared for: a gradient by the shape would be wrong."""
    material = fabric_on(sheet, Weave(rigidity=(2e-6, 2e-6)))

    def energy(rest):
        return bending_energy(deformed(sheet, np.eye(3)), with_rest_positions(sheet, rest), material)

    with pytest.raises(ConfigError, match="does not follow a rest shape"):
        jax.eval_shape(jax.grad(energy), sheet.rest_positions)
    isotropic = material.replace(plate=None)
    recut = with_rest_positions(sheet, jnp.asarray(sheet.rest_positions))
    assert jax.eval_shape(lambda: bending_energy(recut.rest_positions, recut, isotropic)).shape == ()
