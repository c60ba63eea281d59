"""The minimiser: on quadratics, on cloth, and as a citizen of jit, vmap and scan."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from physics_cases import make_case, make_garment, make_sheet, pad_case

from eslr_jax.physics.lbfgs import Point, lower_point, minimize
from eslr_jax.physics.materials import COTTON
from eslr_jax.physics.potential import potential
from eslr_jax.physics.preconditioner import hessian_diagonal, solve_stiffness, stiffness
from eslr_jax.physics.problem import PhysicsParameters, make_problem, start_guess
from eslr_jax.physics.residual import relative_residual
from eslr_jax.scene import initial_state


def make_quadratic(count=4, seed=0, condition=100.0):
    """A positive definite matrix over `count` points, and its minimum."""
    random = np.random.default_rng(seed)
    basis, _ = np.linalg.qr(random.standard_normal((3 * count, 3 * count)))
    matrix = basis * np.geomspace(1, condition, 3 * count) @ basis.T
    return matrix, random.standard_normal((count, 3))


def quadratic(x, matrix, center):
    offset = (x - center).ravel()
    return 0.5 * offset @ matrix @ offset


def test_a_quadratic_takes_a_few_times_as_many_steps_as_it_has_unknowns():
    """As many pairs kept as unknowns; exact steps would take six, backtracked ones take longer."""
    with jax.enable_x64(True):
        matrix, center = make_quadratic(count=2)
        function = partial(quadratic, matrix=matrix, center=center)
        start = jnp.zeros((2, 3))
        found = minimize(function, start, jnp.ones(2), iterations=60, memory=6)
        assert float(found.value) < 1e-12 * float(function(start))
        half = minimize(function, start, jnp.ones(2), iterations=3, memory=6)
        assert float(half.value) > 1e-6 * float(function(start)), "the test must be able to fail"


def test_a_diagonal_quadratic_takes_one_step():
    stiffnesses = jnp.array([1.0, 10.0, 1e4])
    center = jnp.arange(9.0).reshape(3, 3)

    def function(x):
        return 0.5 * jnp.sum(stiffnesses[:, None] * (x - center) ** 2)

    found = minimize(function, jnp.zeros((3, 3)), stiffnesses, iterations=1)
    np.testing.assert_allclose(found.position, center, rtol=1e-6)


def test_rosenbrock_valley_is_followed_to_its_end():
    def function(x):
        x = x.ravel()
        return jnp.sum(100.0 * (x[1:] - x[:-1] ** 2) ** 2 + (1 - x[:-1]) ** 2)

    with jax.enable_x64(True):
        found = minimize(function, jnp.zeros((2, 3)), jnp.ones(2), iterations=120)
        np.testing.assert_allclose(found.position, 1.0, atol=1e-6)


def test_tolerance_and_bound_stop_the_iteration():
    matrix, center = (jnp.float32(part) for part in make_quadratic())
    run = partial(minimize, partial(quadratic, matrix=matrix, center=center), jnp.zeros((4, 3)), jnp.ones(4))
    loose = run(iterations=50, residual_tolerance=1e-1)
    assert 0 < int(loose.iterations) < 50
    assert float(jnp.linalg.norm(loose.gradient)) <= 1e-1
    assert int(run(iterations=7).iterations) == 7
    none = run(iterations=0)
    assert int(none.iterations) == 0
    np.testing.assert_array_equal(none.position, 0)
    assert int(run(iterations=50, residual_tolerance=1e9).iterations) == 0


def test_a_minimum_is_left_alone():
    matrix, center = (jnp.float32(part) for part in make_quadratic())
    found = minimize(partial(quadratic, matrix=matrix, center=center), center, jnp.ones(4), iterations=30)
    np.testing.assert_array_equal(found.position, center)
    assert int(found.iterations) <= 1, "stops where no step leads down"


def test_the_value_never_rises_and_nonfinite_trials_are_refused():
    def function(x):
        return jnp.sum(jnp.where(x < 3.0, (x - 2.9) ** 2, jnp.nan))

    values = [
        float(minimize(function, jnp.zeros((2, 3)), jnp.full(2, 0.3), iterations=n).value) for n in range(6)
    ]
    assert np.all(np.isfinite(values))
    assert np.all(np.diff(values) <= 1e-6)
    assert values[-1] < 1e-6


def test_the_way_from_an_earlier_point_is_the_first_pair():
    """Where the Hessian is a multiple of the preconditioner, one pair says which, and one step ends it."""
    center = jnp.arange(6.0).reshape(2, 3)

    def function(x):
        return 1.5 * jnp.sum((x - center) ** 2)

    def point(x):
        return Point(x, *jax.value_and_grad(function)(x))

    near, far = center + 1.0, center - 2.0
    run = partial(minimize, function, diagonal=jnp.ones(2))
    found = run(near, iterations=1, earlier=point(far))
    np.testing.assert_allclose(found.position, center, atol=1e-6)
    assert float(run(near, iterations=1).value) > 0.1, "the test must be able to fail"
    same = run(point(near), iterations=3, earlier=point(near))
    np.testing.assert_array_equal(same.position, run(near, iterations=3).position)


def test_the_lower_of_two_points_is_the_finite_one():
    low, high, none = (Point(jnp.full(3, x), jnp.float32(x), jnp.full(3, x)) for x in (1.0, 2.0, jnp.nan))
    for other in (high, none):
        np.testing.assert_array_equal(lower_point(other, low).position, 1.0)
        np.testing.assert_array_equal(lower_point(low, other).gradient, 1.0)


def test_a_nonfinite_start_is_returned_as_it_is():
    found = minimize(lambda x: jnp.sum(x) * jnp.nan, jnp.ones((2, 3)), jnp.ones(2), iterations=10)
    np.testing.assert_array_equal(found.position, 1)
    assert np.isnan(found.value)
    assert int(found.iterations) <= 1


# --- the preconditioner -------------------------------------------------------------------------------------


def test_stiffness_solve_is_linear_symmetric_and_positive(case64):
    with jax.enable_x64(True):
        problem, garment, material = case64.problem, case64.garment, case64.material
        matrix = stiffness(problem, garment, material, case64.position)
        count = len(case64.position)
        units = jnp.eye(count)
        columns = jax.vmap(lambda unit: solve_stiffness(matrix, jnp.stack([unit] * 3, axis=1))[:, 1])(units)
        np.testing.assert_allclose(columns, columns.T, rtol=1e-10, atol=1e-18)
        smallest = np.linalg.eigvalsh(columns)[0]
        assert smallest > 0
        # Its error in inverting diagonal minus 0.9 springs is at most 1 / T_4(1 / 0.9), the bound of Chebyshev
        # iteration; the diagonal alone leaves up to 0.9.
        dense = np.diag(matrix.diagonal)
        np.add.at(dense, (np.arange(count)[:, None], garment.neighbors), -0.9 * np.asarray(matrix.springs))
        guesses = (np.asarray(columns), np.diag(1 / np.diag(dense)))
        errors = [np.abs(np.linalg.eigvals(guess @ dense) - 1).max() for guess in guesses]
        bound = 1 / np.polynomial.chebyshev.chebval(1 / 0.9, [0, 0, 0, 0, 1])
        assert errors[0] < 1.001 * bound < 0.5 * errors[1]


def test_springs_are_symmetric_and_carried_by_the_diagonal(case32):
    problem, garment, material = case32.problem, case32.garment, case32.material
    matrix = stiffness(problem, garment, material, case32.position)
    table = np.zeros((len(case32.position),) * 2)
    np.add.at(table, (np.arange(len(table))[:, None], garment.neighbors), np.asarray(matrix.springs))
    np.testing.assert_array_equal(table, table.T)
    assert np.all(table.sum(axis=1) <= matrix.diagonal)
    assert np.count_nonzero(table) == int(garment.neighbor_mask.sum())


# --- cloth --------------------------------------------------------------------------------------------------


@partial(jax.jit, static_argnames=("iterations", "preconditioner"))
def solve(case, iterations, preconditioner=stiffness):
    position, problem, garment, material = case.position, case.problem, case.garment, case.material
    return minimize(
        lambda x: potential(x, problem, garment, material),
        position,
        preconditioner(problem, garment, material, position),
        iterations=iterations,
    )


def test_cloth_reaches_its_minimum(case64):
    with jax.enable_x64(True):
        found = solve(case64, 400)
        left = relative_residual(found.gradient, case64.problem, case64.garment, case64.material)
    assert float(left) < 1e-6


def test_springs_beat_the_diagonal(case32):
    values = {kind: float(solve(case32, 10, kind).value) for kind in (hessian_diagonal, stiffness)}
    assert values[stiffness] < values[hessian_diagonal]


def test_pinned_vertices_stay_in_place():
    is_pinned = np.arange(30) < 6
    case = make_case(is_pinned=is_pinned, dtype=np.float32)
    start = np.where(is_pinned[:, None], case.problem.pin_targets, case.position)
    found = solve(case._replace(position=start), 20)
    np.testing.assert_array_equal(np.asarray(found.position)[is_pinned], case.problem.pin_targets[is_pinned])


def test_padding_moves_nothing(case32):
    padded = pad_case(case32)
    count = len(case32.position)
    found, plain = solve(padded, 10), solve(case32, 10)
    np.testing.assert_array_equal(found.position[count:], padded.position[count:])
    # Dot products over longer arrays associate otherwise, and ten iterations amplify that.
    np.testing.assert_allclose(found.position[:count], plain.position, atol=2e-5)


def test_vmap_equals_a_loop(case32):
    starts = jnp.stack([case32.position, case32.position + 0.002])
    batched = jax.jit(jax.vmap(lambda start: solve(case32._replace(position=start), 10)))(starts)
    for k, start in enumerate(starts):
        alone = solve(case32._replace(position=start), 10)
        np.testing.assert_allclose(batched.position[k], alone.position, atol=2e-5)
        assert int(batched.iterations[k]) == int(alone.iterations)


def falling_sheet():
    garment = make_garment(*make_sheet(4, 4, jitter=0))
    return garment, initial_state(garment.rest_positions, jnp.zeros_like(garment.rest_positions))


@pytest.mark.parametrize("frames", [4])
def test_free_fall_is_implicit_eulers_parabola(frames):
    """v_k = -k g dt and y_k = -g dt^2 k (k + 1) / 2, with the minimiser inside a scan."""
    garment, state = falling_sheet()
    parameters, timestep = PhysicsParameters(), jnp.float32(1 / 30)

    def advance(state, _):
        problem = make_problem(garment, state, None, None, timestep, parameters)
        start = start_guess(problem, garment)
        found = minimize(
            lambda x: potential(x, problem, garment, COTTON),
            start,
            hessian_diagonal(problem, garment, COTTON, start),
            iterations=100,
        )
        velocity = (found.position - state.position) / timestep
        return state.replace(position=found.position, velocity=velocity), found.position

    _, positions = jax.jit(lambda state: jax.lax.scan(advance, state, length=frames))(state)
    step = np.arange(1, frames + 1)
    expected = -9.81 / 30**2 * step * (step + 1) / 2
    fallen = np.asarray(positions - garment.rest_positions[None])
    np.testing.assert_allclose(fallen[:, :, 1], np.repeat(expected[:, None], 16, axis=1), atol=2e-4)
    np.testing.assert_allclose(fallen[:, :, [0, 2]], 0, atol=2e-4)
    # The centre of mass obeys the scheme more closely than single vertices: internal forces cancel.
    weights = np.asarray(garment.vertex_areas / garment.vertex_areas.sum())
    np.testing.assert_allclose(fallen[:, :, 1] @ weights, expected, rtol=2e-3)
