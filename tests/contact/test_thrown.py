"""Thrown cloth, which goes farther in a frame than contacts see: it ends in front of what it is thrown at."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hard_cases.build import capsule, icosphere, join_meshes, make_cloth, make_scene, plane, sheet

from eslr_jax import SimConfig, rollout_scene
from eslr_jax.contact.nearest import CONTACT_RADIUS, find_both_sides
from eslr_jax.mesh.surface import prepare_surface
from eslr_jax.terms import Contact

SPEED = 13.0  # [m/s], 43 cm in a frame
BALL, LIMB = 0.15, 0.05  # radii [m]
PLACES = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [4.0, 0.0, 0.0]])  # of plane, ball and limb [m]
ROD = np.array([6.0, 0.0, 0.0])  # [m]
find = jax.jit(find_both_sides)


@pytest.fixture(scope="module")
def obstacles():
    limb, rod = capsule(LIMB, 0.6, around=16, rings=8), capsule(0.01, 0.6, around=8, rings=30)
    bodies = (plane(1.0, 9, 0.0), icosphere(2, BALL), limb, rod)
    places = (*PLACES, ROD)
    return join_meshes(*((mesh[0] + place, mesh[1]) for mesh, place in zip(bodies, places, strict=True)))


def thrown_sheets(obstacles, *, above):
    """Three sheets over plane, ball and limb, on their way down."""
    mesh = sheet(9, 9, (0.24, 0.24))
    sheets = join_meshes(*((mesh[0] + place + [0, above, 0], mesh[1]) for place in PLACES))
    garment = make_cloth(sheets, {}, allow_components=True)
    scene = make_scene(garment, sheets[0], 9, body=obstacles)
    # Without pairs, which would hold the sheets too.
    scene = scene.replace(terms=tuple(term for term in scene.terms if not isinstance(term, Contact)))
    velocity = jnp.broadcast_to(jnp.array([0.0, -SPEED, 0.0]), scene.initial_state.velocity.shape)
    return scene.replace(initial_state=scene.initial_state.replace(velocity=velocity))


def test_sheets_thrown_at_a_plane_a_ball_and_a_limb_end_in_front_of_them(obstacles):
    for above in (0.35, 0.52):  # each within one frame of the plane, and of the ball
        scene = thrown_sheets(obstacles, above=above)
        # The frame of the impact ends 5.1 mm deep after 60 iterations, 3.2 after 90 and 2.9 after 200 and 500.
        positions = np.asarray(rollout_scene(None, scene, SimConfig(iterations=100)).positions)
        on_plane, on_ball, on_limb = np.split(positions - np.repeat(PLACES, 81, axis=0), 3, axis=1)
        assert on_plane[..., 1].min() > -2e-3, above
        assert np.linalg.norm(on_ball, axis=-1).min() > BALL - 5e-3, above
        assert np.linalg.norm(on_limb[..., 1:], axis=-1).min() > LIMB - 5e-3, above
        middle = 40
        assert on_ball[1:4, middle, 1].min() > 0, above
        assert on_limb[1:4, middle, 1].min() > 0, above


def surface_of(mesh):
    surface = prepare_surface(*mesh)
    return jnp.asarray(mesh[0], jnp.float32)[surface.vertex_ids], surface


def test_cloth_that_is_not_thrown_has_the_contacts_it_had(obstacles):
    body, surface = surface_of(obstacles)
    random = np.random.default_rng(0)
    position = jnp.asarray(random.uniform([-0.5, -0.2, -0.4], [4.5, 0.4, 0.4], (300, 3)), jnp.float32)
    way = random.standard_normal((300, 3))
    way *= 0.99 * CONTACT_RADIUS / np.linalg.norm(way, axis=1, keepdims=True)
    drift = jnp.array([[0.3, 0.0, 0.0]])  # what moves with the body is not thrown
    moving = find(
        position, body, body + drift, surface, None, position + drift + jnp.asarray(way, jnp.float32)
    )
    still = find(position, body, body + drift, surface)
    for one, other in zip(still, moving, strict=True):
        near = np.asarray(one.is_near)
        np.testing.assert_array_equal(near, other.is_near)
        assert np.sum((np.asarray(one.faces) != np.asarray(other.faces))[near]) < 5  # rounding decides ties
        for name in ("points", "next_points", "normals", "next_normals", "distances"):
            np.testing.assert_allclose(
                np.asarray(getattr(one, name))[near], np.asarray(getattr(other, name))[near], atol=1e-5
            )


def test_a_rod_on_the_way_is_met_and_one_beside_it_is_not(obstacles):
    """A vertex that is near nothing at t, and behind the rod at t + 1."""
    body, surface = surface_of(obstacles)
    start, way = np.full((300, 3), 9.0, np.float32), np.zeros((300, 3), np.float32)  # most near nothing
    start[:3] = np.add(ROD, [[0.0, 0.25, 0.0], [0.0, 0.25, 0.05], [0.0, 0.02, 0.25]])
    way[:3] = [[0.0, -0.45, 0.0], [0.0, -0.45, 0.0], [0.0, 0.0, -0.45]]
    contacts, _ = find(jnp.asarray(start), body, body, surface, None, jnp.asarray(start + way))
    np.testing.assert_array_equal(contacts.is_near[:3], [True, False, True])
    np.testing.assert_allclose(contacts.normals[0], [0.0, 1.0, 0.0], atol=0.1)
    assert float(contacts.normals[2, 1]) > 0.5  # over the rod, not at its side


def test_gradients_through_thrown_contacts_are_finite(obstacles):
    scene = thrown_sheets(obstacles, above=0.35)
    body, surface = scene.body.positions[0], scene.body.surface

    @jax.jit
    @jax.grad
    def slope(ways):
        position, moved = ways
        contacts, _ = find_both_sides(position, body, body, surface, None, position + moved)
        return jnp.sum(
            jnp.where(contacts.is_near[:, None], contacts.next_points + contacts.next_normals, 0.0)
        )

    start = scene.initial_state
    by_position, by_way = slope((start.position, start.velocity * scene.timestep))
    assert bool(jnp.all(jnp.isfinite(by_position)))
    assert float(jnp.abs(by_position).max()) > 0
    assert bool(jnp.all(by_way == 0))
