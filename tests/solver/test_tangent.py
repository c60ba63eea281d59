"""The assembled Hessian against automatic differentiation, and the linear solver on it."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cloth import make_garment
from draped_ball import drifting_ball, square

from eslr_jax import prepare_scene
from eslr_jax.simulation.frame import first_problem
from eslr_jax.solver.potential import potential
from eslr_jax.solver.preconditioner import sum_diagonals
from eslr_jax.solver.tangent import apply, inverse_diagonal, precondition, solve_symmetric, tangent
from eslr_jax.terms import CLOTH, FAST, Air, Contact, Damping


@pytest.fixture(scope="module")
def crumpled():
    """A pinned sheet of 25 vertices on a ball, with all that can be modelled; all vertices are off by noise."""
    terms = (*FAST, Air((1.0, 2.0, 0.5)), Damping(0.01))
    scene = prepare_scene(square(5, 0.12, is_pinned=np.array([0, 3])), drifting_ball(2), terms=terms)
    # Last, or else a program with pairs would be compiled for frame 0.
    scene = scene.replace(terms=(*scene.terms, Contact()))
    is_free = (scene.garment.vertex_mask & ~scene.garment.is_pinned)[:, None]
    noise, move = np.random.default_rng(0).standard_normal((2, *is_free.shape[:1], 3)).astype(np.float32)

    @jax.jit
    def everything(position, move):
        problem = first_problem(scene)
        free = jnp.where(is_free, move, 0.0)
        _, forces = jax.jvp(lambda x: jax.grad(potential)(x, problem), (position,), (free,))
        matrix = tangent(problem, position)
        inverse = inverse_diagonal(matrix, problem, position)
        # What no block holds is estimated: damping and air.
        beyond = sum_diagonals(problem, position, lambda term: term.name in ("damping", "air"))
        diagonal = matrix.blocks[0] + jnp.eye(3)[:, :, None] * beyond[None, None]
        assembled = apply(matrix, move.T).T
        return {"forces": forces, "assembled": assembled, "diagonal": diagonal, "inverse": inverse}

    move = jnp.asarray(move)
    found = everything(scene.initial_state.position + 3e-3 * jnp.asarray(noise), move)
    return SimpleNamespace(move=move, is_free=is_free, **found)


def test_the_assembled_product_is_that_of_automatic_differentiation(crumpled):
    expected = jnp.where(crumpled.is_free, crumpled.forces, crumpled.move)
    tolerance = 1e-5 * float(jnp.abs(crumpled.forces).max())
    np.testing.assert_allclose(crumpled.assembled, expected, atol=tolerance)


def test_cloth_without_inner_edges_has_forces_and_a_hessian_too():
    """One triangle bends nowhere; the tables of its hinges are empty."""
    triangle = make_garment(np.array([[0, 0.2, 0], [0.1, 0.2, 0], [0, 0.2, 0.1]]), np.array([[0, 1, 2]]))
    assert triangle.hinges.shape[0] == 0
    scene = prepare_scene(triangle, drifting_ball(2), terms=CLOTH)
    problem = jax.jit(first_problem)(scene)
    move = jnp.arange(9.0).reshape(3, 3)

    @jax.jit
    def both(position):
        forces, expected = jax.jvp(lambda x: jax.grad(potential)(x, problem), (position,), (move,))
        return forces, apply(tangent(problem, position), move.T).T, expected

    forces, found, expected = both(1.05 * scene.initial_state.position)
    assert np.isfinite(forces).all()
    assert np.abs(forces).max() > 0
    np.testing.assert_allclose(found, expected, atol=1e-5 * float(jnp.abs(expected).max()))


def test_preconditioner_inverts_the_blocks_on_the_diagonal(crumpled):
    blocks = np.asarray(crumpled.inverse).transpose(2, 0, 1)
    vertex = 12  # in the middle; free, and its block is positive definite
    np.testing.assert_allclose(
        blocks[vertex] @ np.asarray(crumpled.diagonal)[..., vertex], np.eye(3), atol=1e-3
    )
    assert np.linalg.eigvalsh(blocks).min() > 0
    expected = np.einsum("vij,vj->vi", blocks, crumpled.move)
    np.testing.assert_allclose(
        precondition(crumpled.inverse, crumpled.move.T).T, expected, rtol=1e-4, atol=1e-6
    )


def test_an_indefinite_system_is_solved_and_said_to_be_so():
    random = np.random.default_rng(3)
    basis, _ = np.linalg.qr(random.standard_normal((12, 12)))
    values = np.linspace(1.0, 5.0, 12)
    values[0] = -0.5
    force = random.standard_normal((4, 3)).astype(np.float32)
    for sign, is_indefinite in ((-1.0, True), (1.0, False)):
        values[0] = sign * 0.5
        matrix = jnp.asarray((basis * values) @ basis.T, jnp.float32)
        found = solve_symmetric(
            lambda v, matrix=matrix: (matrix @ v.ravel()).reshape(v.shape),
            lambda v: 0.5 * v,
            jnp.asarray(force),
            tolerance=1e-5,
            iterations=50,
        )
        expected = np.linalg.solve(np.asarray(matrix, float), force.ravel()).reshape(force.shape)
        np.testing.assert_allclose(found.displacement, expected, rtol=1e-3, atol=1e-4)
        assert bool(found.is_indefinite) is is_indefinite
        assert float(found.residual) < 1e-4
        assert int(found.iterations) <= 14
