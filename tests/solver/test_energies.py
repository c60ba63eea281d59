"""Every energy of set `consistent`: oracles, gradients three ways, invariances, degenerate input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from cloth import make_garment, make_sheet
from physics_cases import make_case, pad_case, to_numpy

from eslr_jax import ConfigError
from eslr_jax.fabric.materials import COTTON
from eslr_jax.solver.potential import contact_load, potential, potential_terms
from eslr_jax.terms import Collision, Friction, Gravity
from eslr_jax.terms.bending import bending_energy, dihedral_angles
from eslr_jax.terms.stretch import principal_stretches, stretch_diagonal, stretch_energy
from eslr_jax.terms.term import weight_norm, with_terms

TERMS = ("stretch", "bending", "inertia", "gravity", "collision", "friction")  # the oracle's order


@jax.jit
def terms_and_gradients(position, problem):
    """All terms, and their gradients stacked in the same order."""

    def stacked(position):
        energies = potential_terms(position, problem)
        return jnp.stack([energies[name] for name in TERMS])

    return stacked(position), jax.jacrev(stacked)(position)


stretch_and_gradient = jax.jit(jax.value_and_grad(stretch_energy))
bending_and_gradient = jax.jit(jax.value_and_grad(bending_energy))


def evaluate(case):
    found = terms_and_gradients(case.position, case.problem)
    return tuple(np.asarray(part) for part in found)


def oracle_terms(case, position=None):
    """The six energies by plain NumPy."""
    case = to_numpy(case)
    problem = case.problem
    garment, material, body = problem.garment, problem.material, problem.data_of(Collision)
    position = case.position if position is None else position
    rest, faces = garment.rest_positions, garment.faces
    mass = reference.masses(rest, faces, material.density)
    area = reference.masses(rest, faces, 1.0)
    below, barrier = body.nearest, (body.stiffness, body.thickness)
    fabric = (material.lame_mu, material.lame_lambda, material.thickness)
    start, motion = problem.position, (below.points, below.next_points, below.next_normals)
    slip = Friction().speed * problem.timestep
    return np.array(
        [
            reference.stretch(position, rest, faces, *fabric),
            reference.bending(position, rest, faces, material.bending_stiffness),
            reference.inertia(position, problem.inertial_guess, mass, problem.timestep),
            reference.gravity(position, start, mass, Gravity().acceleration),
            sum(
                reference.collision(
                    position, *(side.next_points, side.next_normals, side.is_near), area, *barrier
                )
                for side in (below, body.opposing)
            ),
            reference.friction(position, start, *motion, problem.friction_load, Friction().coefficient, slip),
        ]
    )


def test_the_frame_presses_on_both_sides(case64):
    """What the oracle of collision is compared on: vertices that touch one body, the other, and both."""
    body = case64.problem.data_of(Collision)
    touched = [
        side.is_near & (np.sum((case64.position - side.next_points) * side.next_normals, axis=1) < 5e-3)
        for side in (body.nearest, body.opposing)
    ]
    assert touched[0].sum() >= 5
    assert touched[1].sum() >= 5
    assert np.sum(touched[0] & ~touched[1]) >= 3


def test_energies_match_the_oracle_in_float32(case32):
    values, _ = evaluate(case32)
    np.testing.assert_allclose(values, oracle_terms(case32), rtol=1e-5)
    assert np.all(np.abs(oracle_terms(case32)) > 1e-6), "a term that vanishes is not tested"


def test_energies_match_the_oracle_in_float64(case64):
    with jax.enable_x64(True):
        values, _ = evaluate(case64)
        np.testing.assert_allclose(values, oracle_terms(case64), rtol=1e-10)


def test_gradients_match_central_differences(case64):
    with jax.enable_x64(True):
        _, gradients = evaluate(case64)
    count = case64.position.shape[0]
    numeric = np.zeros((6, count, 3))
    step = 2e-7  # [m]; the third derivative of the collision barrier is the largest error
    for index in np.ndindex(count, 3):
        if index[0] % 3:  # a third of the vertices: boundary, interior, in contact and out
            continue
        offset = np.zeros((count, 3))
        offset[index] = step
        numeric[:, index[0], index[1]] = (
            oracle_terms(case64, case64.position + offset) - oracle_terms(case64, case64.position - offset)
        ) / (2 * step)
    for name, gradient, expected in zip(TERMS, gradients, numeric, strict=True):
        rows = np.arange(count) % 3 == 0
        scale = np.abs(expected).max()
        np.testing.assert_allclose(gradient[rows], expected[rows], atol=2e-7 * scale, err_msg=name)


def test_gradients_in_float32_match_float64(case32, case64):
    _, single = evaluate(case32)
    with jax.enable_x64(True):
        _, double = evaluate(case64)
    for name, a, b in zip(TERMS, single, double, strict=True):
        # Rounding a coordinate of 0.3 m moves an edge of 5 cm by 1e-6 of its length.
        np.testing.assert_allclose(a, b, atol=3e-5 * np.abs(b).max(), err_msg=name)


# --- closed forms -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def flat():
    """A garment of identical squares in the plane."""
    return make_garment(*make_sheet(4, 4, jitter=0))


@pytest.mark.parametrize(
    "gradient",
    [
        0.9 * np.eye(2),
        1.05 * np.eye(2),
        1.3 * np.eye(2),
        np.diag([1.2, 1.0]),
        np.array([[1.0, 0.3], [0.0, 1.0]]),
    ],
    ids=["pressed", "stretched", "stretched far", "along one axis", "sheared"],
)
def test_a_uniform_deformation_has_the_closed_form(flat, gradient):
    """mu tr(G^2) + lambda / 2 tr(G)^2 in every volume, and forces whose work is that of its second stress."""
    position = np.asarray(flat.rest_positions, np.float64)
    position[:, [0, 2]] = position[:, [0, 2]] @ gradient.T
    mu, lame_lambda, thickness = (float(v) for v in (COTTON.lame_mu, COTTON.lame_lambda, COTTON.thickness))
    volume = float(np.sum(flat.rest_areas)) * thickness
    metric = gradient.T @ gradient
    green = (metric - np.eye(2)) / 2
    energy, forces = stretch_and_gradient(jnp.float32(position), flat, COTTON)
    density = mu * np.sum(green**2) + lame_lambda / 2 * np.trace(green) ** 2
    np.testing.assert_allclose(energy, volume * density, rtol=1e-5)
    stress = 2 * mu * green + lame_lambda * np.trace(green) * np.eye(2)
    np.testing.assert_allclose(
        np.sum(np.asarray(forces) * position), volume * np.sum(stress * metric), rtol=2e-5
    )


def test_principal_stretches_of_a_known_deformation(flat):
    position = jnp.float32(np.asarray(flat.rest_positions) * [1.5, 1, 0.8])
    larger, smaller = principal_stretches(position, flat)
    np.testing.assert_allclose(larger, 1.5, rtol=1e-5)
    np.testing.assert_allclose(smaller, 0.8, rtol=1e-5)


@pytest.mark.parametrize("scale", [[1, 1, 1], [1.3, 1, 0.8], [1, 1, 0], [0, 0, 0]])
def test_principal_stretches_have_finite_gradients(flat, scale):
    position = jnp.float32(np.asarray(flat.rest_positions) * scale)
    for which in range(2):
        gradient = jax.grad(lambda x, which=which: jnp.sum(principal_stretches(x, flat)[which]))(position)
        assert np.isfinite(gradient).all()


def folded_pair(angle):
    """Two right triangles hinged along z at x = 0, folded by `angle` towards -y."""
    positions = np.array([[0, 0, 0], [0, 0, 0.1], [0.1, 0, 0], [-0.1, 0, 0]], float)
    positions[3] = [-0.1 * np.cos(angle), -0.1 * np.sin(angle), 0]
    return positions


@pytest.mark.parametrize("angle", [0.0, 1e-3, 0.7, 3.0, -3.0])
def test_bending_of_one_hinge_has_the_closed_form(angle):
    garment = make_garment(folded_pair(0.0), np.array([[0, 1, 2], [1, 0, 3]]))
    position = jnp.float32(folded_pair(angle))
    (found,) = jax.jit(dihedral_angles)(position, garment)
    np.testing.assert_allclose(found, angle, atol=2e-6)
    stiffness = float(COTTON.bending_stiffness) * 0.1**2 / (4 * 0.01)  # l = 0.1 m, areas 2 x 0.005 m^2
    energy, gradient = bending_and_gradient(position, garment, COTTON)
    np.testing.assert_allclose(energy, stiffness * angle**2 / 2, rtol=1e-4, atol=1e-14)
    # Each free corner is 0.1 m from the axis: the torque stiffness * angle acts there as a force.
    forces = np.linalg.norm(np.asarray(gradient)[2:], axis=1)
    np.testing.assert_allclose(forces, stiffness * abs(angle) / 0.1, rtol=1e-4, atol=1e-9)


def test_bending_takes_lengths_and_areas_from_the_sewn_shape():
    positions, faces = folded_pair(0.8), np.array([[0, 1, 2], [1, 0, 3]])
    position = jnp.asarray(positions, jnp.float32)
    # Along the hinge: k l^2 / A does not change with the scale of a mesh.
    as_worn, sewn = (
        make_garment(positions, faces, sewn_positions=positions * [1.0, 1.0, scale]) for scale in (1.0, 1.5)
    )
    # Squared lengths are 2.25 times as large and areas 1.5 times; the angle is that of the positions.
    expected = 1.5 * float(bending_energy(position, as_worn, COTTON))
    np.testing.assert_allclose(bending_energy(position, sewn, COTTON), expected, rtol=1e-5)


def test_point_forces_have_the_closed_form(case64):
    problem, position = case64.problem, case64.position
    with jax.enable_x64(True):
        _, gradients = evaluate(case64)
        load = np.asarray(jax.jit(contact_load)(position, problem))
        weight = float(jax.jit(weight_norm)(problem))
    masses = problem.material.density * problem.garment.vertex_areas
    _, _, inertia, gravity, collision, friction = gradients
    offset = position - problem.inertial_guess
    np.testing.assert_allclose(inertia, masses[:, None] * offset / problem.timestep**2, rtol=1e-10)
    np.testing.assert_allclose(gravity, 9.81 * masses[:, None] * [[0.0, 1.0, 0.0]], rtol=1e-10)
    np.testing.assert_allclose(np.linalg.norm(gravity), weight, rtol=1e-10)
    body, forces = problem.data_of(Collision), []
    for side in (body.nearest, body.opposing):
        height = np.sum((position - side.next_points) * side.next_normals, axis=1)
        depth = np.where(side.is_near, np.maximum(body.thickness - height, 0.0), 0.0)
        forces.append(3 * 3.5e7 * problem.garment.vertex_areas * depth**2)
    np.testing.assert_allclose(load, forces[0], rtol=1e-10, atol=1e-15)
    expected = -sum(
        force[:, None] * side.next_normals
        for force, side in zip(forces, (body.nearest, body.opposing), strict=True)
    )
    np.testing.assert_allclose(collision, expected, atol=1e-12)
    np.testing.assert_allclose(np.sum(friction * body.nearest.next_normals, axis=1), 0, atol=1e-12)
    assert np.all(np.linalg.norm(friction, axis=1) <= 0.5 * problem.friction_load), "Coulomb's limit"


def test_friction_reaches_coulombs_limit_when_sliding(case64):
    """A metre of slip: the force is mu N to within the smoothing."""
    problem = case64.problem
    along = np.cross(problem.data_of(Collision).nearest.next_normals, [1.0, 0.2, 0.3])
    position = problem.position + along / np.linalg.norm(along, axis=1, keepdims=True)
    with jax.enable_x64(True):
        _, gradients = evaluate(case64._replace(position=position))
    force = np.linalg.norm(gradients[5], axis=1)
    np.testing.assert_allclose(force, 0.5 * problem.friction_load, rtol=1e-6)


# --- invariances --------------------------------------------------------------------------------------------


def rotation(seed=3):
    q, r = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.linalg.det(q)


def test_internal_energies_have_no_net_force_or_torque(case64):
    with jax.enable_x64(True):
        _, gradients = evaluate(case64)
    for name, gradient in zip(TERMS[:2], gradients[:2], strict=True):
        scale = np.abs(gradient).sum()
        np.testing.assert_allclose(gradient.sum(axis=0), 0, atol=1e-14 * scale, err_msg=name)
        torque = np.cross(case64.position, gradient).sum(axis=0)
        np.testing.assert_allclose(torque, 0, atol=1e-14 * scale, err_msg=name)


def test_internal_energies_are_invariant_to_rigid_motion(case64):
    turn, shift = rotation(), np.array([3.0, -2.0, 5.0])
    with jax.enable_x64(True):
        values, gradients = evaluate(case64)
        moved, turned = evaluate(case64._replace(position=case64.position @ turn.T + shift))
    np.testing.assert_allclose(moved[:2], values[:2], rtol=1e-10)
    for gradient, expected in zip(turned[:2], gradients[:2], strict=True):
        np.testing.assert_allclose(gradient, expected @ turn.T, atol=1e-10 * np.abs(expected).max())


def test_energies_are_zero_at_rest(case32):
    garment, material = jax.tree.map(jnp.asarray, (case32.problem.garment, case32.problem.material))
    rest = garment.rest_positions @ np.float32(rotation()).T
    energy, gradient = stretch_and_gradient(rest, garment, material)
    assert float(energy) < 1e-9  # float32 strains of 1e-7
    assert float(jnp.max(jnp.abs(gradient))) < 1e-4


def test_bending_of_a_developable_shape_tends_to_the_shell(flat):
    """A cylinder of radius r bends every metre squared by k / (2 r^2) times a constant of the mesh."""
    rest = np.asarray(flat.rest_positions, np.float64)
    energies = []
    for radius in (1.0, 2.0):
        angle = rest[:, 0] / radius
        position = np.stack([radius * np.sin(angle), radius * np.cos(angle), rest[:, 2]], axis=1)
        energies.append(float(bending_and_gradient(jnp.float32(position), flat, COTTON)[0]))
    np.testing.assert_allclose(energies[0] / energies[1], 4.0, rtol=1e-3)


# --- degenerate input and padding ---------------------------------------------------------------------------


def degenerate_positions(case):
    """The rest sheet, all in one point, on a line, with coincident vertices, folded flat, not moved at all."""
    rest = np.array(case.problem.garment.rest_positions)
    coincident = rest.copy()
    coincident[1] = coincident[0]
    coincident[8] = coincident[7]
    folded = rest.copy()
    folded[:, 0] = np.abs(folded[:, 0] - 0.1)
    return {
        "rest": rest,
        "point": np.zeros_like(rest),
        "line": rest * np.array([1, 0, 0], rest.dtype),
        "coincident": coincident,
        "folded": folded,
        "still": case.problem.position,
        "far": rest * 1e3,
        "tiny": rest * 1e-12,
    }


def test_energies_and_gradients_are_finite_on_degenerate_input(case32):
    for name, position in degenerate_positions(case32).items():
        values, gradients = evaluate(case32._replace(position=position))
        assert np.all(np.isfinite(values)), name
        assert np.all(np.isfinite(gradients)), name


def test_a_motion_of_zero_length_is_finite(case32):
    problem = case32.problem
    *others, (rubbing,) = problem.data
    still_points = rubbing._replace(contacts=rubbing.contacts.replace(next_points=rubbing.contacts.points))
    still = problem.replace(data=(*others, (still_points,)), inertial_guess=problem.position)
    values, gradients = evaluate(case32._replace(problem=still, position=problem.position))
    assert float(values[5]) == 0
    assert not np.any(gradients[5])
    assert not np.any(gradients[2])
    assert np.all(np.isfinite(gradients))


def test_padding_changes_nothing(case32):
    count = case32.position.shape[0]
    values, gradients = evaluate(case32)
    padded = pad_case(case32)
    assert padded.position.shape[0] > count
    padded_values, padded_gradients = evaluate(padded)
    np.testing.assert_allclose(padded_gradients[:, :count], gradients, rtol=2e-6, atol=1e-7)
    assert not np.any(padded_gradients[:, count:])
    np.testing.assert_allclose(padded_values, values, rtol=3e-7)  # sums associate otherwise


def test_where_padded_faces_point_does_not_matter(case32):
    padded = pad_case(case32)
    position = padded.position.copy()
    position[-1] += 7.0
    _, gradients = evaluate(padded._replace(position=position))
    _, expected = evaluate(padded)
    count = case32.position.shape[0]
    np.testing.assert_array_equal(gradients[:, :count], expected[:, :count])


# --- material, pins, no body --------------------------------------------------------------------------------


def test_arrays_of_one_value_equal_scalars(case32):
    problem = case32.problem
    arrays = jax.tree.map(lambda like, value: np.full_like(like, value), problem.material, COTTON)
    scalar, array = (
        evaluate(case32._replace(problem=problem.replace(material=m)))[0] for m in (COTTON, arrays)
    )
    np.testing.assert_allclose(array, scalar, rtol=1e-6)


def test_pinned_vertices_feel_no_force():
    is_pinned = np.arange(30) < 6
    case = make_case(is_pinned=is_pinned, dtype=np.float32)
    values, gradients = evaluate(case)
    assert not np.any(gradients[:, is_pinned])
    moved = case.position + is_pinned[:, None].astype(np.float32)
    np.testing.assert_array_equal(evaluate(case._replace(position=moved))[0], values)


def test_the_potential_is_the_sum_of_its_terms(case32):
    both = jax.jit(lambda *frame: (potential_terms(*frame), potential(*frame)))
    energies, total = both(case32.position, case32.problem)
    np.testing.assert_allclose(total, sum(map(float, energies.values())), rtol=1e-6)


def test_collision_without_a_body_is_refused(case32):
    with pytest.raises(ConfigError, match="needs a body"):
        with_terms(case32.problem, (Collision(),))


def test_the_preconditioner_measures_cloth_as_it_is_sewn():
    """Where the rest pose distorts a garment, its stiffness is that of the lengths that its energy measures."""
    cloth = make_garment(*make_sheet(5, 5, 0.02, jitter=0))
    posed = cloth.replace(rest_positions=1.3 * cloth.rest_positions)
    np.testing.assert_array_equal(stretch_diagonal(posed, COTTON), stretch_diagonal(cloth, COTTON))
