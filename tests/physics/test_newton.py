"""The reference minimiser: its element Hessians against automatic differentiation, and where it ends."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cloth import make_garment, make_sheet
from physics_cases import make_case

from eslr_jax.contact.layer_edges import LayerPairs
from eslr_jax.contact.self_contact import TipPairs, default_capacity
from eslr_jax.physics import hessian
from eslr_jax.physics.lbfgs import Stop, minimize
from eslr_jax.physics.materials import COTTON
from eslr_jax.physics.newton import minimize_newton, potential_float64
from eslr_jax.physics.potential import potential, potential_terms
from eslr_jax.physics.preconditioner import stiffness
from eslr_jax.scene.build import initial_state
from eslr_jax.simulation.frame import FrameInput, frame_problem
from eslr_jax.terms.bending import bending_energy
from eslr_jax.terms.problem import SelfContact
from eslr_jax.terms.repulsion import pair_heights, repulsion_energies
from eslr_jax.terms.stretch import stretch_energy
from eslr_jax.types import PhysicsConstants, Scene


def assemble(blocks, table, count):
    """Sum blocks [items, 3k, 3k] of vertices `table` [items, k] into a dense matrix."""
    matrix = np.zeros((count, 3, count, 3))
    corners = table.shape[1]
    blocks = np.asarray(blocks).reshape(-1, corners, 3, corners, 3)
    for k in range(corners):
        for m in range(corners):
            np.add.at(matrix.transpose(0, 2, 1, 3), (table[:, k], table[:, m]), blocks[:, k, :, m])
    return matrix.reshape(3 * count, 3 * count)


def dense_hessian(function, position, *arguments):
    """Return the Hessian of `function(position, *arguments)` by its first argument."""
    size = position.size
    with jax.enable_x64(True):
        # Reverse over reverse: the gathers have their own reverse rule, and no forward one.
        found = jax.jit(jax.jacrev(jax.grad(function)))(position, *arguments)
        return np.asarray(found).reshape(size, size)


def test_projection_of_2x2_blocks_is_that_of_the_eigenvalues():
    random = np.random.default_rng(0)
    a, b, c = random.standard_normal((3, 200))
    b[:5] = 0
    c[:3] = a[:3]  # a multiple of the identity: any basis will do
    matrices = np.stack([np.stack([a, b], 1), np.stack([b, c], 1)], 1)
    values, vectors = np.linalg.eigh(matrices)
    expected = np.einsum("nij,nj,nkj->nik", vectors, np.maximum(values, 0), vectors)
    a, b, c = hessian.project_symmetric_2x2(a, b, c)
    np.testing.assert_allclose(np.stack([np.stack([a, b], 1), np.stack([b, c], 1)], 1), expected, atol=1e-12)


@pytest.mark.numerics
def test_stretch_blocks_equal_the_hessian_under_tension(case64):
    """All eigenvalues are positive there: the projection takes nothing away."""
    garment, material = case64.problem.garment, case64.problem.material
    random = np.random.default_rng(2)
    position = garment.rest_positions * 1.4 + 1e-3 * random.standard_normal(case64.position.shape)
    found = assemble(hessian.stretch_blocks(position, garment, material), garment.faces, len(position))
    expected = dense_hessian(stretch_energy, position, garment, material)
    np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())


def test_stretch_blocks_are_positive_under_compression(case64):
    garment = case64.problem.garment
    blocks = hessian.stretch_blocks(0.7 * garment.rest_positions, garment, case64.problem.material)
    values = np.linalg.eigvalsh(blocks)
    assert values.min() > -1e-10 * values.max()
    assert np.linalg.matrix_rank(blocks[0], tol=1e-8 * values.max()) < 6, "something was projected away"


@pytest.mark.numerics
def test_bending_blocks_equal_the_hessian_where_flat(case64):
    """The rest of the Hessian carries the angle as a factor."""
    garment, material = case64.problem.garment, case64.problem.material
    flat = garment.rest_positions * np.array([1.1, 0.0, 0.9])
    found = assemble(hessian.bending_blocks(flat, garment, material), garment.hinges, len(flat))
    expected = dense_hessian(bending_energy, flat, garment, material)
    np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())


@pytest.mark.numerics
def test_vertex_blocks_equal_the_hessian(case64):
    """Inertia, friction, and the contact with the bodies on both sides."""
    problem, position = case64.problem, case64.position

    def energy(x, problem):
        terms = potential_terms(x, problem)
        return terms.inertia + terms.collision + terms.friction

    found = hessian.vertex_blocks(position, problem)
    expected = dense_hessian(energy, position, problem)
    table = np.arange(len(position))[:, None]
    np.testing.assert_allclose(
        assemble(found, table, len(position)), expected, atol=1e-8 * np.abs(expected).max()
    )


def one_pair(case):
    """A tip beside the first vertex, the last face, and a row that is not used."""
    vertices, faces = np.array([0, 5], np.int32), np.asarray(case.problem.garment.faces)[[-1, 7]]
    return TipPairs(
        next_points=np.asarray(case.position)[vertices] + 0.01,
        corners=faces,
        weights=-np.array([[0.2, 0.3, 0.5], [1 / 3, 1 / 3, 1 / 3]]),
        side=np.array([-1.0, 0.0]),
        areas=np.asarray(case.problem.garment.vertex_areas)[vertices],
        status=np.int32(0),
    )


@pytest.mark.numerics
def test_blocks_of_layers_are_the_outer_product_of_the_gradient(case64):
    """As for tips: a vertex and a face, two edges that are neither near nor perpendicular, and an unused row."""
    position, thickness = case64.position, 0.5  # [m]; any depth will do
    pairs = LayerPairs(
        corners=np.array([[0, 1, 20, 14], [0, 1, 20, 14], [5, 5, 5, 5]], np.int32),
        weights=np.array([[1.0, -0.2, -0.3, -0.5], [0.3, 0.7, -0.4, -0.6], [0.0, 0.0, 0.0, 0.0]]),
        side=np.array([1.0, -1.0, 0.0]),
        areas=np.array([2e-3, 2e-3, 0.0]),
        is_edge=np.array([False, True, True]),
        count=np.int32(1),
        status=np.int32(0),
    )
    layers = SelfContact(pairs, np.full(3, thickness), limit=np.float64(1.0))
    problem = case64.problem.replace(layers=layers)
    blocks = hessian.layer_blocks(position, problem)
    beyond = problem.replace(layers=layers.replace(limit=np.float64(1e-3)))
    assert not hessian.layer_blocks(position, beyond).any()  # where the energy is linear
    stiffness = float(problem.constants.repulsion_stiffness)
    for row, block in enumerate(blocks):
        one = jax.tree.map(lambda leaf, row=row: leaf[row : row + 1] if leaf.ndim else leaf, pairs)
        with jax.enable_x64(True):
            force = np.asarray(
                jax.jit(jax.grad(lambda *given: repulsion_energies(*given).sum()))(
                    position, one, stiffness, thickness
                )
            )
            height = float(jax.jit(pair_heights)(position, one)[0][0])
        (table,) = hessian.pair_table(one, 4)
        slope = force[table].ravel()
        expected = np.outer(slope, slope) * 6 / (9 * stiffness * 2e-3 * (thickness - height) ** 3)
        np.testing.assert_allclose(block, expected, atol=1e-9 * np.abs(expected).max())
    assert len(blocks) == 2


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
        constants=PhysicsConstants(),
        timestep=jnp.float32(1 / 30),
        initial_state=initial_state(garment.rest_positions, jnp.asarray(velocity)),
        body=None,
        pin_targets=None,
        num_frames=2,
        self_contact=default_capacity(len(garment.rest_positions)),
    )
    return jax.jit(frame_problem)(scene, scene.initial_state, FrameInput(None, None))


@pytest.mark.numerics
def test_blocks_of_tips_are_the_outer_product_of_the_gradient(case64):
    """E = k a d^3: 6 k a d g g^T, and the energy's own gradient is -3 k a d^2 g. Unused rows give no block."""
    pairs, position, thickness = one_pair(case64), case64.position, 0.5  # [m]; any depth will do
    with jax.enable_x64(True):
        force = np.asarray(
            jax.jit(jax.grad(lambda *given: repulsion_energies(*given).sum()))(
                position, pairs, 3.5e7, thickness
            )
        )
        height = float(jax.jit(pair_heights)(position, pairs)[0][0])
    depth = thickness - height
    table = hessian.pair_table(pairs, 3)
    assert table.shape == (1, 3)
    problem = case64.problem
    constants = problem.constants.replace(collision_stiffness=3.5e7, collision_thickness=thickness)
    problem = problem.replace(constants=constants, body=problem.body.replace(tips=pairs))
    (block,) = hessian.tip_blocks(position, problem)
    slope = force[table[0]].ravel()
    expected = np.outer(slope, slope) * 6 / (9 * 3.5e7 * pairs.areas[0] * depth**3)
    np.testing.assert_allclose(block, expected, atol=1e-9 * np.abs(expected).max())


@jax.jit
def descend(problem, position):
    return minimize(lambda x: potential(x, problem), position, stiffness(problem, position), Stop(400))


@pytest.mark.parametrize("is_pinned", [None, np.arange(30) < 6], ids=["free", "pinned"])
def test_newton_ends_where_lbfgs_ends(is_pinned):
    problem, position = make_case(is_pinned=is_pinned)
    found = minimize_newton(problem)
    assert found.is_converged
    assert found.residual < 1e-6
    assert found.iterations < 60
    if is_pinned is not None:
        position = np.where(is_pinned[:, None], problem.pin_targets, position)
        np.testing.assert_array_equal(found.position[is_pinned], problem.pin_targets[is_pinned])
    with jax.enable_x64(True):
        other = descend(problem, position)
    gap = potential_float64(position, problem) - found.value
    # Two starts may end in different folds; their energies differ by less than 0.2 % of the initial gap.
    assert abs(float(other.value) - found.value) < 2e-3 * gap


def test_newton_stops_at_its_bound_and_says_so(case64):
    found, start = (minimize_newton(case64.problem, max_iterations=count) for count in (1, 0))
    assert found.iterations == 1
    assert not found.is_converged
    assert found.value < start.value


def test_newton_parts_layers(two_layers):
    """The pairs couple vertices that are far apart in the mesh: the matrix's band must hold their entries."""
    problem = two_layers
    assert int(problem.layers.pairs.count) > 20
    found = minimize_newton(problem)
    assert found.is_converged
    middle = len(found.position) // 2
    gap = np.mean(found.position[middle:, 1]) - np.mean(found.position[:middle, 1])
    assert 0.7 < gap / float(problem.layers.thickness.max()) < 1.05, (
        "pushed apart, against the speed of approach"
    )
