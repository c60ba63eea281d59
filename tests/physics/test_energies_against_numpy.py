"""Every energy against a plain float64 loop, and its gradient against central differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eslr_jax.geometry.prepare import prepare_garment
from eslr_jax.physics.materials import COTTON
from eslr_jax.physics.potential import PotentialTerms, potential, potential_terms
from eslr_jax.physics.problem import PhysicsParameters, make_problem
from eslr_jax.scene import initial_state
from eslr_jax.types import Contacts, tree_cast

TIMESTEP = 1 / 30


def cloth(size=6, spacing=0.03):
    """A jittered sheet."""
    generator = np.random.default_rng(0)
    column, row = np.meshgrid(np.arange(size), np.arange(size))
    rest = np.stack([column.ravel(), np.zeros(size * size), row.ravel()], axis=1) * spacing
    rest = rest + generator.normal(0, 0.1 * spacing, rest.shape)
    corner = (row[:-1, :-1] * size + column[:-1, :-1]).ravel()
    lower = np.stack([corner, corner + size, corner + 1], axis=1)
    upper = np.stack([corner + 1, corner + size, corner + size + 1], axis=1)
    faces = np.concatenate([lower, upper])
    return rest, faces


@pytest.fixture(scope="module")
def frame():
    """A garment, a deformed position and a problem with contacts and friction, in float32."""
    rest, faces = cloth()
    count = len(rest)
    generator = np.random.default_rng(1)
    weights, indices = np.ones((count, 1)), np.zeros((count, 1), int)
    garment = prepare_garment(rest, faces, skin_weights=weights, skin_indices=indices)
    start = rest + generator.normal(0, 0.003, rest.shape)
    velocity = generator.normal(0, 0.3, rest.shape)
    normals = generator.normal(0, 0.2, rest.shape) + np.array([0.0, 1.0, 0.0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = start - normals * generator.uniform(-0.004, 0.004, (count, 1))
    contacts = Contacts(
        points=points,
        next_points=points + generator.normal(0, 0.002, rest.shape),
        normals=normals,
        next_normals=normals,
        distances=np.zeros(count),
        is_near=generator.uniform(size=count) < 0.8,
    )
    state = initial_state(jnp.asarray(start, jnp.float32), jnp.asarray(velocity, jnp.float32))
    state = state.replace(friction_load=generator.uniform(0, 1e-3, count))
    position = start + generator.normal(0, 0.004, rest.shape)
    to_jax = lambda leaf: jnp.asarray(leaf, jnp.float32 if np.asarray(leaf).dtype.kind == "f" else None)  # noqa: E731
    contacts, state, position = jax.tree.map(to_jax, (contacts, state, position))
    problem = make_problem(garment, state, contacts, None, jnp.float32(TIMESTEP), PhysicsParameters())
    material = jax.tree.map(jnp.asarray, COTTON)
    return position, problem, garment, material


def reference_terms(position, problem, garment, material):
    """Return all energies by loops over faces, hinges and vertices."""
    x, rest = np.asarray(position, np.float64), np.asarray(garment.rest_positions, np.float64)
    h, mu, lam = (float(v) for v in (material.thickness, material.lame_mu, material.lame_lambda))
    stretch, areas, mass_area = 0.0, {}, np.zeros(len(x))
    for number, face in enumerate(np.asarray(garment.faces)):
        a, b, c = rest[face]
        area = np.linalg.norm(np.cross(b - a, c - a)) / 2
        areas[number] = area
        mass_area[face] += area / 3
        first = (a - c) / np.linalg.norm(a - c)
        normal = np.cross(a - c, b - c)
        second = np.cross(normal, first) / np.linalg.norm(normal)
        frame = np.array([[(a - c) @ first, (b - c) @ first], [(a - c) @ second, (b - c) @ second]])
        shape = np.stack([x[face[0]] - x[face[2]], x[face[1]] - x[face[2]]], axis=1)
        deformation = shape @ np.linalg.inv(frame)
        strain = (deformation.T @ deformation - np.eye(2)) / 2
        stretch += area * h * (mu * np.trace(strain @ strain) + lam / 2 * np.trace(strain) ** 2)
    bending = 0.0
    for number, (i, j, p, q) in enumerate(np.asarray(garment.hinges)):
        edge = x[j] - x[i]
        left, right = np.cross(edge, x[p] - x[i]), np.cross(x[q] - x[i], edge)
        left, right = left / np.linalg.norm(left), right / np.linalg.norm(right)
        angle = np.arctan2(edge / np.linalg.norm(edge) @ np.cross(left, right), left @ right)
        squared = np.sum((rest[j] - rest[i]) ** 2)
        area = float(garment.hinge_rest_areas[number])
        bending += float(material.bending_stiffness) * squared / (4 * area) * angle**2 / 2
    mass = float(material.density) * mass_area
    guess, start = np.asarray(problem.inertial_guess, np.float64), np.asarray(problem.position, np.float64)
    inertia = sum(m * np.sum((a - b) ** 2) for m, a, b in zip(mass, x, guess, strict=True)) / (
        2 * TIMESTEP**2
    )
    gravity = 9.81 * np.sum(mass * (x[:, 1] - start[:, 1]))
    contacts, parameters = problem.contacts, problem.parameters
    collision = friction = 0.0
    for v in range(len(x)):
        normal = np.asarray(contacts.next_normals[v], np.float64)
        height = (x[v] - np.asarray(contacts.next_points[v], np.float64)) @ normal
        if bool(contacts.is_near[v]):
            depth = max(float(problem.collision_thickness) - height, 0.0)
            collision += parameters.collision_stiffness * mass_area[v] * depth**3
        carried = np.asarray(contacts.next_points[v], np.float64) - np.asarray(contacts.points[v], np.float64)
        slide = x[v] - start[v] - carried
        slide = slide - slide @ normal * normal
        slip = parameters.friction_speed * TIMESTEP
        load = float(problem.friction_load[v])
        friction += parameters.friction_coefficient * load * (np.sqrt(slide @ slide + slip**2) - slip)
    return PotentialTerms(stretch, bending, inertia, gravity, collision, friction)


@pytest.mark.parametrize("term", PotentialTerms._fields[:6])
def test_energy_agrees_with_numpy(frame, term):
    expected = getattr(reference_terms(*frame), term)
    assert expected != 0
    np.testing.assert_allclose(getattr(potential_terms(*frame), term), expected, rtol=2e-5)


@pytest.mark.parametrize("term", PotentialTerms._fields[:6])
def test_energy_agrees_with_numpy_in_float64(frame, term):
    with jax.enable_x64(True):
        wide = tree_cast(frame, np.float64)
        rest, faces = (np.asarray(array) for array in (wide[2].rest_positions, wide[2].faces))
        from eslr_jax.geometry import topology

        # The garment's float32 rest frames and areas are exact to seven digits: take them anew in float64.
        areas = topology.face_areas(rest, faces)
        hinges, hinge_faces = topology.find_hinges(faces)
        garment = wide[2].replace(
            inverse_rest_frames=jnp.asarray(topology.inverse_rest_frames(rest, faces)),
            rest_areas=jnp.asarray(areas),
            hinges=jnp.asarray(hinges),
            hinge_rest_areas=jnp.asarray(areas[hinge_faces].sum(axis=1)),
            vertex_areas=jnp.asarray(topology.vertex_areas(areas, faces, len(rest))),
        )
        problem = wide[1].replace(timestep=jnp.float64(TIMESTEP))
        exact = (wide[0], problem, garment, wide[3])
        expected = getattr(reference_terms(*exact), term)
        np.testing.assert_allclose(getattr(potential_terms(*exact), term), expected, rtol=1e-10)


def test_gradient_agrees_with_central_differences(frame):
    with jax.enable_x64(True):
        position, *rest = tree_cast(frame, np.float64)
        gradient = np.asarray(jax.grad(potential)(position, *rest))
        energy = jax.jit(lambda x: potential(x, *rest))
        step = 1e-6
        for vertex, axis in ((0, 0), (7, 1), (14, 2), (20, 1), (35, 0)):
            offset = np.zeros(position.shape)
            offset[vertex, axis] = step
            numeric = (energy(position + offset) - energy(position - offset)) / (2 * step)
            np.testing.assert_allclose(gradient[vertex, axis], numeric, rtol=1e-5, atol=1e-8)


def test_internal_forces_and_torques_cancel(frame):
    from eslr_jax.physics.bending import bending_energy
    from eslr_jax.physics.membrane import stretch_energy

    position, _, garment, material = frame
    for energy in (stretch_energy, bending_energy):
        force = np.asarray(jax.grad(energy)(position, garment, material), np.float64)
        scale = np.abs(force).sum()
        assert np.abs(force.sum(axis=0)).max() < 1e-5 * scale
        assert np.abs(np.cross(np.asarray(position, np.float64), force).sum(axis=0)).max() < 1e-5 * scale
