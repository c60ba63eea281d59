"""Skin under the faces of the cloth: found, kept covered, and lifted off where the start is cut."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from draped_ball import RADIUS, ball, drifting_ball, square

from eslr_jax import SimConfig, prepare_scene, rollout_scene, scene_terms
from eslr_jax.contact.nearest import find_contacts
from eslr_jax.contact.skin import find_skin_contacts, lift_off_skin, skin_heights
from eslr_jax.mesh.closest import closest_points
from eslr_jax.mesh.padding import choose_bucket, pad_garment
from eslr_jax.mesh.prepare import to_device
from eslr_jax.mesh.surface import prepare_surface
from eslr_jax.simulation.frame import first_problem
from eslr_jax.terms import Collision
from eslr_jax.terms.collision import skin_diagonal, skin_energies

STIFFNESS, THICKNESS = 3.5e7, 2e-3  # [J/m^5], [m]


def scene_of(*, has_skin, num_frames):
    """A coarse square over a ball of 2 cm radius that fits between four of its vertices, 5 cm apart."""
    positions, faces = ball(15, 24)
    small = positions * 0.2 + np.array([0.0, 0.8 * RADIUS, 0.0]), faces
    options = {"terms": scene_terms(Collision(has_skin=has_skin))}
    return prepare_scene(square(side=6), drifting_ball(num_frames, speed=0.0, mesh=small), **options)


@pytest.mark.parametrize(
    ("room", "is_skin"), [(0.003, False), pytest.param(0.03, True, marks=pytest.mark.slow)]
)
def test_cloth_that_limbs_pinch_has_no_rows_of_skin(room, is_skin):
    """Rows of both limbs would pull it to both sides, and stretch what is beside them."""
    positions, faces = ball(15, 24)
    upper = positions + np.array([0.0, 2 * RADIUS + room, 0.0])
    both = np.concatenate([positions, upper]), np.concatenate([faces, faces + len(positions)])
    scene = prepare_scene(
        square(side=9), drifting_ball(2, speed=0.0, mesh=both), terms=scene_terms(Collision(has_skin=True))
    )
    between = scene.garment.rest_positions.at[:, 1].set(RADIUS + room / 2)
    scene = scene.replace(initial_state=scene.initial_state.replace(position=between))
    skin = jax.jit(first_problem)(scene).data_of(Collision).skin
    middle = 4 * 9 + 4
    rows = jnp.any((skin.corners == middle) & (skin.weights > 0.2), axis=1)
    assert bool(jnp.any(rows & skin.is_near)) == is_skin


def height_over_top(position):
    """Return how far the diagonal in the middle of the square is over the top of the ball [m]."""
    rows = np.asarray(position).reshape(6, 6, 3)
    return float((rows[2, 2, 1] + rows[3, 3, 1]) / 2 - RADIUS)


@pytest.mark.slow
def test_a_ball_that_fits_between_vertices_carries_the_faces():
    scene = scene_of(has_skin=True, num_frames=6)  # in which free cloth falls by 16 cm
    trajectory = rollout_scene(None, scene, SimConfig(iterations=40))
    assert height_over_top(trajectory.positions[-1]) > -1e-3


def test_faces_are_lifted_off_the_skin():
    scene = scene_of(has_skin=True, num_frames=2)
    cut = scene.garment.rest_positions - jnp.array([[0.0, 0.006, 0.0]])
    assert height_over_top(cut) < -1e-3
    lifted = jax.jit(lift_off_skin)(cut, scene.body.positions[0], scene.body.surface, scene.garment)
    assert height_over_top(lifted) >= 0


@pytest.fixture(scope="module")
def contacts():
    scene = scene_of(has_skin=True, num_frames=2)
    body = scene.body.positions[0]
    position = scene.initial_state.position
    return scene, position, body, skin_of(position, body, scene.body.surface, scene.garment)


@jax.jit
def skin_of(position, body, surface, garment):
    nearest = find_contacts(position, body, body, surface)
    return find_skin_contacts((position,) * 2, (body,) * 2, nearest, surface, garment)


skin_energy = jax.jit(lambda *given: skin_energies(*given).sum())


def test_the_rows_are_the_nearest_places_of_the_cloth(contacts):
    scene, position, _, skin = contacts
    near = np.asarray(skin.is_near)
    points = np.asarray(skin.next_points)[near]
    faces = np.asarray(scene.garment.faces)
    nearest, weights = closest_points(points, np.asarray(position), faces)
    true = np.linalg.norm(
        np.einsum("pk,pkx->px", weights, np.asarray(position)[faces[nearest]]) - points, axis=1
    )
    ours = np.einsum(
        "pk,pkx->px", np.asarray(skin.weights)[near], np.asarray(position)[np.asarray(skin.corners)[near]]
    )
    distance = np.linalg.norm(ours - points, axis=1)
    assert near.sum() > 20
    assert np.mean(distance > true + 1e-4) < 0.02


def test_energy_pushes_the_faces_off_and_needs_no_other_force(contacts):
    """The gradient is that of central differences, and the diagonal bounds what the curvature is."""
    *_, position, _, skin = contacts
    pressed = position - jnp.array([[0.0, 0.003, 0.0]])
    assert float(jnp.min(jnp.where(skin.is_near, skin_heights(pressed, skin), 1.0))) < THICKNESS

    def energy(x):
        return skin_energy(x, skin, STIFFNESS, THICKNESS)

    gradient = jax.jit(jax.grad(energy))(pressed)
    direction = gradient / jnp.linalg.norm(gradient)
    step = 1e-4
    difference = (energy(pressed + step * direction) - energy(pressed - step * direction)) / (2 * step)
    assert float(difference) == pytest.approx(float(jnp.vdot(gradient, direction)), rel=0.02)
    assert float(jnp.sum(gradient[:, 1])) < 0  # the force, its opposite, lifts
    diagonal = jax.jit(skin_diagonal)(pressed, skin, STIFFNESS, THICKNESS)
    assert float(jnp.max(diagonal)) > 0
    assert bool(jnp.all(diagonal >= 0))


def test_a_place_stands_for_the_coarser_of_both_meshes(contacts):
    """A body vertex carries what its own area does, or what the cloth's does where that is larger."""
    scene, position, body, skin = contacts
    cloth = float(scene.garment.mean_vertex_area)
    assert float(jnp.max(scene.body.surface.vertex_areas)) < cloth
    np.testing.assert_allclose(skin.areas, cloth, rtol=1e-6)
    surface = scene.body.surface.replace(vertex_areas=scene.body.surface.vertex_areas + 2.0 * cloth)
    coarse = skin_of(position, body, surface, scene.garment)
    assert float(jnp.min(coarse.areas)) >= 2.0 * cloth
    pressed = position - jnp.array([[0.0, 0.003, 0.0]])
    heavier, own = (float(skin_energy(pressed, rows, STIFFNESS, THICKNESS)) for rows in (coarse, skin))
    assert heavier > 2.0 * own > 0


def test_vertex_areas_of_a_body_sum_to_its_surface():
    positions, faces = ball(24, 32)
    corners = positions[faces]
    crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.linalg.norm(crosses, axis=1).sum() / 2
    assert float(jnp.sum(prepare_surface(positions, faces).vertex_areas)) == pytest.approx(total, rel=1e-5)


def test_padding_changes_no_row_of_skin():
    """Padding lies in the middle of the cloth, here on the ball's top: the nearest of all to the skin there."""
    garment, poses = square(side=9), drifting_ball(2, speed=0.0)
    padded = to_device(pad_garment(garment, choose_bucket(garment)))
    assert padded.vertex_mask.shape[0] > 81
    body = poses.positions[0][poses.surface.vertex_ids]
    rows = [skin_of(one.rest_positions, body, poses.surface, one) for one in (garment, padded)]
    assert bool(rows[0].is_near.any())
    np.testing.assert_array_equal(rows[0].is_near, rows[1].is_near)
    is_near = np.asarray(rows[0].is_near)
    np.testing.assert_array_equal(rows[0].corners[is_near], rows[1].corners[is_near])
