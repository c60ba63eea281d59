"""The minimiser: on quadratics, on cloth, and as a citizen of jit, vmap and scan."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from newton_oracle import minimize_newton, potential_float64
from physics_cases import make_case, pad_case

from eslr_jax.fabric.materials import COTTON
from eslr_jax.solver import lbfgs
from eslr_jax.solver.lbfgs import Stop, minimize
from eslr_jax.solver.potential import Point, potential
from eslr_jax.solver.preconditioner import Stiffness, solve_stiffness, stiffness, stretched_stiffness
from eslr_jax.solver.solve import lower_point
from eslr_jax.solver.subspace import combine_directions
from eslr_jax.terms.stretch import stretch_energy
from eslr_jax.terms.term import weight_norm


def diagonal_of(values):
    """Return a stiffness without springs."""
    values = jnp.asarray(values)
    return Stiffness(values, jnp.arange(len(values))[:, None], jnp.zeros((len(values), 1), values.dtype))


def point_of(function, position):
    return Point(position, *jax.value_and_grad(function)(position))


@partial(jax.jit, static_argnames=("function", "memory"))
def descend(
    function, position, diagonal, iterations, *, tolerance=0.0, reference=0.0, memory=8, previous=None
):
    """Minimise a function of a few points, the iterations traced."""
    return minimize(
        function,
        position,
        diagonal_of(diagonal),
        Stop(iterations, tolerance, reference),
        memory=memory,
        previous=None if previous is None else point_of(function, previous),
    )


def make_function(count=4, condition=100.0):
    """A quadratic of `count` points, and its minimum."""
    random = np.random.default_rng(0)
    basis, _ = np.linalg.qr(random.standard_normal((3 * count, 3 * count)))
    matrix = basis * np.geomspace(1, condition, 3 * count) @ basis.T
    center = random.standard_normal((count, 3))

    def function(x):
        offset = (x - jnp.asarray(center, x.dtype)).ravel()
        return 0.5 * offset @ jnp.asarray(matrix, x.dtype) @ offset

    return function, center


def test_a_quadratic_takes_a_few_times_as_many_steps_as_it_has_unknowns():
    """As many pairs kept as unknowns; exact steps would take six, backtracked ones take longer."""
    with jax.enable_x64(True):
        function, _ = make_function(count=2)
        start, ones = jnp.zeros((2, 3)), jnp.ones(2)
        found, half = (descend(function, start, ones, count, memory=6) for count in (60, 3))
        assert float(found.value) < 1e-12 * float(function(start))
        assert float(half.value) > 1e-6 * float(function(start)), "the test must be able to fail"


def test_rosenbrock_valley_is_followed_to_its_end():
    def function(x):
        x = x.ravel()
        return jnp.sum(100.0 * (x[1:] - x[:-1] ** 2) ** 2 + (1 - x[:-1]) ** 2)

    with jax.enable_x64(True):
        found = descend(function, jnp.zeros((2, 3)), jnp.ones(2), 120)
        np.testing.assert_allclose(found.position, 1.0, atol=1e-6)


def test_tolerance_and_bound_stop_the_iteration():
    function, center = make_function()
    start = jnp.zeros((4, 3))
    initial_gap = float(function(start))
    run = partial(descend, function, start, jnp.ones(4), reference=initial_gap)
    loose = run(50, tolerance=0.01)
    assert 0 < int(loose.iterations) < int(run(50, tolerance=1e-4).iterations)
    assert float(loose.value) < 0.01 * initial_gap, "its minimum is zero"
    assert int(run(7).iterations) == 7
    none = run(0)
    assert int(none.iterations) == 0
    np.testing.assert_array_equal(none.position, start)
    left = descend(function, jnp.float32(center), jnp.ones(4), 30)
    np.testing.assert_array_equal(left.position, jnp.float32(center))
    assert int(left.iterations) <= 1, "stops where no step leads down"


def test_where_nothing_is_left_but_rounding_the_bound_is_zero():
    """Cloth that has come to rest: the inertial guess is the minimum, but for rounding with either sign."""

    def function(x):
        return 1.0 + jnp.sum((x - 0.1) ** 2)

    start = jnp.full((2, 3), 0.1 + 1e-6)
    for reference in (1.0 - 1e-7, 1.0, 1.0 + 1e-7):
        rest = descend(function, start, jnp.ones(2), 50, tolerance=0.01, reference=reference)
        assert float(rest.gap_bound) == 0.0
    moving = descend(function, start + 1.0, jnp.ones(2), 1, tolerance=0.01, reference=7.0)
    assert float(moving.gap_bound) > 0.0


def test_the_value_never_rises_and_nonfinite_trials_are_refused():
    def function(x):
        return jnp.sum(jnp.where(x < 3.0, (x - 2.9) ** 2, jnp.nan))

    values = [float(descend(function, jnp.zeros((2, 3)), jnp.full(2, 0.3), n).value) for n in range(6)]
    assert np.all(np.isfinite(values))
    assert np.all(np.diff(values) <= 1e-6)
    assert values[-1] < 1e-6


def test_the_step_from_a_previous_point_is_the_first_pair():
    """Where the Hessian is a multiple of the preconditioner, one pair says which, and one step ends it."""
    center = jnp.arange(6.0).reshape(2, 3)

    def function(x):
        return 1.5 * jnp.sum((x - center) ** 2)

    near, far = center + 1.0, center - 2.0
    found = descend(function, near, jnp.ones(2), 1, previous=far)
    np.testing.assert_allclose(found.position, center, atol=1e-5)
    alone = descend(function, near, jnp.ones(2), 1)
    assert float(alone.value) > 1e-3 * float(function(near)), "the test must be able to fail"
    same = descend(function, near, jnp.ones(2), 1, previous=near)
    np.testing.assert_array_equal(same.position, alone.position)


def test_a_direction_that_leads_up_ends_nothing_before_it_was_tried_without_history(monkeypatch):
    """Rounding can turn it; the decrement of such a direction would be negative, and its bound NaN."""
    function, center = make_function()
    down, told = lbfgs._direction, []

    def turned(state):
        told.append(state)
        return jnp.where((state.iterations == 3) & jnp.any(state.is_kept), -1.0, 1.0) * down(state)

    monkeypatch.setattr(lbfgs, "_direction", turned)
    start = jnp.asarray(center, jnp.float32) + 1.0
    found = descend(lambda x: function(x), start, jnp.ones(4), 60, tolerance=1e-3, reference=function(start))
    assert told
    assert int(found.iterations) > 6
    assert np.isfinite(found.gap_bound)
    assert float(found.value) < 1e-4 * float(function(start))


def test_the_lower_of_two_points_is_the_finite_one():
    low, high, none = (Point(jnp.full(3, x), jnp.float32(x), jnp.full(3, x)) for x in (1.0, 2.0, jnp.nan))
    for other in (high, none):
        np.testing.assert_array_equal(lower_point(other, low).position, 1.0)
        np.testing.assert_array_equal(lower_point(low, other).gradient, 1.0)


def test_a_nonfinite_start_is_returned():
    found = descend(lambda x: jnp.sum(x) * jnp.nan, jnp.ones((2, 3)), jnp.ones(2), 10)
    np.testing.assert_array_equal(found.position, 1)
    assert np.isnan(found.value)
    assert int(found.iterations) <= 1


# --- the preconditioner -------------------------------------------------------------------------------------


matrices = pytest.mark.parametrize("make", [stiffness, stretched_stiffness])


@matrices
def test_stiffness_solve_is_linear_symmetric_and_positive(case64, make):
    with jax.enable_x64(True):
        matrix = jax.jit(make)(case64.problem, case64.position)
        count = len(case64.position)
        units = jnp.eye(count)
        columns = jax.vmap(lambda unit: solve_stiffness(matrix, jnp.stack([unit] * 3, axis=1))[:, 1])(units)
        np.testing.assert_allclose(columns, columns.T, rtol=1e-10, atol=1e-18)
        assert np.linalg.eigvalsh(columns)[0] > 0
        # Its error in inverting diagonal minus 0.9 springs is at most 1 / T_4(1 / 0.9), the bound of Chebyshev
        # iteration; the diagonal alone leaves more.
        neighbors = case64.problem.garment.neighbors
        dense = np.diag(matrix.diagonal)
        np.add.at(dense, (np.arange(count)[:, None], neighbors), -0.9 * np.asarray(matrix.springs))
        guesses = (np.asarray(columns), np.diag(1 / np.diag(dense)))
        errors = [np.abs(np.linalg.eigvals(guess @ dense) - 1).max() for guess in guesses]
        bound = 1 / np.polynomial.chebyshev.chebval(1 / 0.9, [0, 0, 0, 0, 1])
        assert errors[0] < min(1.001 * bound, 0.7 * errors[1])


@matrices
def test_springs_are_symmetric_and_carried_by_the_diagonal(case32, make):
    garment = case32.problem.garment
    matrix = jax.jit(make)(case32.problem, case32.position)
    table = np.zeros((len(case32.position),) * 2)
    np.add.at(table, (np.arange(len(table))[:, None], garment.neighbors), np.asarray(matrix.springs))
    np.testing.assert_array_equal(table, table.T)
    assert np.all(table.sum(axis=1) <= matrix.diagonal)
    assert np.count_nonzero(table) == int(garment.neighbor_mask.sum())


def test_springs_of_collapsed_cloth_keep_a_tenth(case32):
    at_rest, collapsed = (
        jax.jit(make)(case32.problem, jnp.zeros_like(case32.position))
        for make in (stiffness, stretched_stiffness)
    )
    np.testing.assert_allclose(collapsed.springs, 0.1 * at_rest.springs, rtol=1e-5)
    assert np.all(collapsed.springs.sum(axis=1) < collapsed.diagonal)


# --- cloth --------------------------------------------------------------------------------------------------


@jax.jit
def solve(case, iterations, springs):
    """Minimise a frame's potential from the case's position, with so much of the preconditioner's springs."""
    matrix = stiffness(case.problem, case.position)
    matrix = matrix.replace(springs=springs * matrix.springs)
    return minimize(lambda x: potential(x, case.problem), case.position, matrix, Stop(iterations))


@pytest.mark.parametrize(
    "is_pinned",
    [pytest.param(None, id="free", marks=pytest.mark.slow), pytest.param(np.arange(30) < 6, id="pinned")],
)
def test_cloth_reaches_the_minimum_that_newtons_method_finds(is_pinned):
    """In float64; pinned vertices stay in place."""
    case = make_case(is_pinned=is_pinned)
    newton = minimize_newton(case.problem)
    assert newton.nit < 60
    if is_pinned is not None:
        targets = case.problem.pin_targets
        case = case._replace(position=np.where(is_pinned[:, None], targets, case.position))
    with jax.enable_x64(True):
        found = solve(case, 400, 1.0)
        weight = float(jax.jit(weight_norm)(case.problem))
    if is_pinned is not None:
        for position in (newton.x, found.position):
            np.testing.assert_array_equal(np.asarray(position)[is_pinned], targets[is_pinned])
    assert np.linalg.norm(found.gradient) < 1e-6 * weight
    gap = potential_float64(case.position, case.problem) - newton.fun
    # Two starts may end in different folds; their energies differ by less than 0.2 % of the initial gap.
    assert abs(float(found.value) - newton.fun) < 2e-3 * gap


def test_springs_beat_the_diagonal(case32):
    assert float(solve(case32, 10, 1.0).value) < float(solve(case32, 10, 0.0).value)


def test_padding_moves_nothing(case32):
    padded = pad_case(case32)
    count = len(case32.position)
    found, plain = solve(padded, 10, 1.0), solve(case32, 10, 1.0)
    np.testing.assert_array_equal(found.position[count:], padded.position[count:])
    # Dot products over longer arrays associate otherwise, and ten iterations amplify that.
    np.testing.assert_allclose(found.position[:count], plain.position, atol=2e-5)


def test_vmap_equals_a_loop(case32):
    starts = np.stack([case32.position, case32.position + np.float32(0.002)])
    batched = jax.jit(jax.vmap(lambda start, case: solve(case._replace(position=start), 10, 1.0), (0, None)))
    together = batched(starts, case32)
    for k, start in enumerate(starts):
        alone = solve(case32._replace(position=start), 10, 1.0)
        np.testing.assert_allclose(together.position[k], alone.position, atol=2e-5)
        assert int(together.iterations[k]) == int(alone.iterations)


# --- the step in a span: exact on quadratics, never uphill, and harmless where there is nothing to gain


@partial(jax.jit, static_argnums=0)
def combine(function, position, directions):
    return combine_directions(function, Point(position, *jax.value_and_grad(function)(position)), directions)


def directions_of_many_lengths():
    return np.random.default_rng(1).standard_normal((3, 5, 3)) * np.array([1e-3, 1.0, 30.0])[:, None, None]


def test_a_quadratic_is_minimised_in_the_span_whatever_the_lengths_of_the_directions():
    with jax.enable_x64(True):
        (function, _), directions = make_function(5), jnp.asarray(directions_of_many_lengths())
        position = jnp.zeros((5, 3))
        move = combine(function, position, directions)
        slopes = jnp.einsum("kij,ij->k", directions, jax.grad(function)(position + move))
        before = jnp.einsum("kij,ij->k", directions, jax.grad(function)(position))
        np.testing.assert_allclose(slopes / jnp.abs(before), 0.0, atol=1e-9)
        weights = jnp.linalg.lstsq(directions.reshape(3, -1).T, move.ravel())[0]
        np.testing.assert_allclose(jnp.einsum("k,kij->ij", weights, directions), move, atol=1e-9)


def test_cloth_never_climbs(small_garment):
    def energy(x):
        return stretch_energy(x, small_garment, COTTON)

    evaluate = jax.jit(jax.value_and_grad(energy))
    keys = jax.random.split(jax.random.key(0), 5)
    for key in keys:
        noise = 5e-3 * jax.random.normal(key, (3, *small_garment.rest_positions.shape), jnp.float32)
        position = small_garment.rest_positions + noise[0]
        before, gradient = evaluate(position)
        downhill = -1e-4 * gradient / jnp.max(jnp.abs(gradient))
        move = combine(energy, position, jnp.concatenate([noise[1:], downhill[None]]))
        after, first = (evaluate(position + step)[0] for step in (move, noise[1]))
        assert after < before < first, "the first direction alone must not do"


def test_a_step_that_would_blow_up_is_not_taken():
    def wall(x):
        return jnp.sum(jnp.where(x > 1.0, jnp.nan, -x))

    move = combine(wall, jnp.zeros((2, 3)), jnp.full((1, 2, 3), 2.0))
    np.testing.assert_array_equal(move, 0.0)


def test_directions_of_zero_give_no_step_and_finite_gradients():
    (function, _), position = make_function(5), jnp.zeros((5, 3))
    directions = jnp.asarray(directions_of_many_lengths(), jnp.float32)
    np.testing.assert_array_equal(combine(function, position, jnp.zeros_like(directions)), 0.0)

    def after(scale):
        first = scale * directions[:1]
        rest = jnp.zeros_like(directions[1:])
        return function(position + combine(function, position, jnp.concatenate([first, rest])))

    assert np.isfinite(jax.grad(after)(jnp.float32(1.0)))
    assert np.isfinite(jax.grad(after)(jnp.float32(0.0)))
