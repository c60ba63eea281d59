"""Contacts with a body and the searches that they are made of, against brute force."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from hard_cases.build import icosphere
from hard_cases.obstacles import needle

from eslr_jax import SimConfig, load_body, load_garment, load_motion, pose_body, prepare_scene, rollout_scene
from eslr_jax.contact.nearest import (
    CONTACT_RADIUS,
    find_both_sides,
    find_contacts,
    find_near_vertices,
    is_inside,
    nearest_point,
)
from eslr_jax.contact.search import PosedSurface, nearest_faces, opposing_faces
from eslr_jax.mesh.closest import closest_points
from eslr_jax.mesh.surface import compact_groups, pad_body, pad_surface, prepare_surface
from eslr_jax.numerics import vertex_normals
from eslr_jax.pipeline.assets import load_splits
from eslr_jax.terms.worn import Worn
from eslr_jax.types import Obstacle

find = jax.jit(find_contacts)


@pytest.fixture(scope="module")
def sphere():
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.25)
    vertices = jnp.asarray(mesh.vertices, jnp.float32)
    surface = prepare_surface(mesh.vertices, mesh.faces)
    return mesh, vertices[surface.vertex_ids], surface


def test_nearest_point_is_the_exact_one_on_a_sphere(sphere):
    mesh, vertices, surface = sphere
    generator = np.random.default_rng(0)
    direction = generator.standard_normal((300, 3))
    query = (
        direction / np.linalg.norm(direction, axis=1, keepdims=True) * generator.uniform(0.2, 0.32, (300, 1))
    )
    found = jax.jit(nearest_point)(jnp.asarray(query, jnp.float32), vertices, surface)
    triangles = mesh.triangles
    exact = [
        np.linalg.norm(
            trimesh.triangles.closest_point(triangles, np.tile(point, (len(triangles), 1))) - point, axis=1
        ).min()
        for point in query
    ]
    np.testing.assert_allclose(np.sqrt(found.squared_distance), exact, atol=2e-6)


def test_signed_distance_normal_and_gate(sphere):
    _, vertices, surface = sphere
    query = jnp.array([[0.0, 0.26, 0.0], [0.0, 0.24, 0.0], [0.0, 0.25 + 2 * CONTACT_RADIUS, 0.0]])
    contacts = find(query, vertices, vertices, surface)
    np.testing.assert_allclose(contacts.distances[:2], [0.01, -0.01], atol=1e-3)
    np.testing.assert_allclose(contacts.normals[0], [0.0, 1.0, 0.0], atol=0.05)
    np.testing.assert_array_equal(contacts.is_near, [True, True, False])


def test_a_padded_body_is_found_as_the_body_itself():
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=0.25)
    surface = prepare_surface(mesh.vertices, mesh.faces)
    body = Obstacle(surface, np.asarray(mesh.vertices, np.float32)[None, surface.vertex_ids])
    assert pad_body(body).positions.shape[1] > body.positions.shape[1]
    cloth = jnp.asarray(np.random.default_rng(1).uniform(-0.4, 0.4, (200, 3)), jnp.float32)
    alone, beside = (
        jax.jit(find_both_sides)(
            cloth, one.positions[0], 1.1 * one.positions[0], one.surface, None, cloth + 0.3
        )
        for one in (body, pad_body(body))
    )
    for name in alone[0].__dataclass_fields__:
        for one, other in zip(alone, beside, strict=True):
            np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=1e-6, err_msg=name)


@pytest.mark.parametrize("name", ["tshirt", pytest.param("dress", marks=pytest.mark.slow)])
def test_three_motions_of_a_garment_search_bodies_of_two_sizes(body, name):
    garment, shapes = load_garment(name), set()
    for motion in ("cmu_016_25", "cmu_016_29", "cmu_069_23"):
        surface = Worn(garment, pose_body(body, load_motion(motion))).surface
        shapes.add(tuple(leaf.shape for leaf in jax.tree.leaves(pad_surface(surface))))
    assert len(shapes) <= 2, shapes


def test_contact_point_moves_with_the_body(sphere):
    _, vertices, surface = sphere
    offset = jnp.array([[0.1, -0.05, 0.02]])
    query = jnp.array([[0.1, 0.24, 0.0], [0.0, 0.24, 0.1], [0.0, -0.26, 0.0]])
    contacts = find(query, vertices, vertices + offset, surface)
    moved = np.asarray(contacts.next_points - contacts.points)
    np.testing.assert_allclose(moved, np.broadcast_to(offset, moved.shape), atol=1e-6)
    np.testing.assert_allclose(contacts.next_normals, contacts.normals, atol=1e-6)


def test_near_vertices_are_the_nearest_ones(sphere):
    _, vertices, surface = sphere
    generator = np.random.default_rng(0)
    direction = generator.standard_normal((200, 3))
    radius = generator.uniform(0.2, 0.3, (200, 1))
    query = jnp.asarray(direction / np.linalg.norm(direction, axis=1, keepdims=True) * radius, jnp.float32)
    offset = jnp.array([[0.1, -0.05, 0.02]])
    found = jax.jit(find_near_vertices, static_argnums=4)(query, vertices, vertices + offset, surface, 3)
    away = np.linalg.norm(np.asarray(query)[:, None] - np.asarray(vertices)[None], axis=2)
    expected = np.sort(away, axis=1)[:, :3].T.ravel()
    np.testing.assert_allclose(np.abs(found.distances), expected, rtol=1e-3)
    side = np.sum((np.tile(query, (3, 1)) - found.points) * found.normals, axis=1)
    np.testing.assert_array_equal(found.distances > 0, side > 0)
    assert all((np.asarray(vertices) == point).all(axis=1).any() for point in np.asarray(found.points))
    np.testing.assert_allclose(found.next_points - found.points, np.tile(offset, (600, 1)), atol=1e-6)


@pytest.fixture(scope="module")
def spheres():
    """Two balls three centimetres apart: positions, search tables."""
    left = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
    right = left.copy()
    right.apply_translation([0.23, 0.0, 0.0])
    both = trimesh.util.concatenate(left, right)
    surface = prepare_surface(both.vertices, both.faces)
    return np.asarray(both.vertices)[np.asarray(surface.vertex_ids)], surface


def test_cloth_between_two_limbs_sees_both(spheres):
    vertices, surface = jnp.asarray(spheres[0], jnp.float32), spheres[1]
    query = jnp.array([[0.11, 0.0, 0.0], [-0.11, 0.0, 0.0]])  # between the two, and beyond the left one
    contacts, opposing = jax.jit(find_both_sides)(query, vertices, vertices, surface)
    np.testing.assert_allclose(contacts.distances, [0.01, 0.01], atol=1e-3)
    np.testing.assert_array_equal(opposing.is_near, [True, False])
    np.testing.assert_allclose(opposing.distances[0], 0.02, atol=1e-3)
    np.testing.assert_allclose(opposing.normals[0], [-1.0, 0.0, 0.0], atol=0.05)


@pytest.mark.parametrize("size", [1, 8])
def test_nearest_faces_are_those_of_an_exact_search(spheres, size):
    positions, surface = spheres
    query = np.random.default_rng(0).uniform([-0.15, -0.15, -0.15], [0.4, 0.15, 0.15], (500, 3))
    found = jax.jit(nearest_faces)(
        jnp.asarray(query, jnp.float32),
        jnp.asarray(positions, jnp.float32),
        surface,
        jnp.asarray(compact_groups(query, size), jnp.int32),
    )
    faces = np.asarray(surface.faces)

    def distances(face, weights):
        return np.linalg.norm(np.einsum("vc,vcx->vx", weights, positions[faces[face]]) - query, axis=1)

    exact = distances(*closest_points(query, positions, faces))
    own = [
        closest_points(q[None], positions, faces[f][None])[1][0] for q, f in zip(query, found, strict=True)
    ]
    error = distances(np.asarray(found), np.stack(own)) - exact
    assert error.max() < 1e-3
    assert np.mean(error > 1e-5) < 0.01


def test_opposing_faces_are_there_for_the_points_that_brute_force_names(spheres):
    positions, surface = spheres
    generator = np.random.default_rng(1)
    facing = generator.standard_normal((300, 3))
    facing /= np.linalg.norm(facing, axis=1, keepdims=True)
    query = 0.105 * facing
    normals = vertex_normals(jnp.asarray(positions, jnp.float32), surface.faces, surface.face_incidence)
    body = PosedSurface(jnp.asarray(positions, jnp.float32), normals, 0.06)
    blocks = jnp.asarray(compact_groups(query, 8), jnp.int32)
    face, is_found = jax.jit(opposing_faces, static_argnums=5)(
        jnp.asarray(query, jnp.float32), jnp.asarray(facing, jnp.float32), body, surface, blocks, -0.2
    )
    offset = positions[None] - query[:, None]
    opposes = (np.asarray(normals) @ facing.T).T <= -0.2
    opposes &= np.einsum("vsx,vx->vs", offset, facing) >= 0
    distance = np.where(opposes, np.linalg.norm(offset, axis=2), np.inf)
    nearest = distance.min(axis=1)
    is_found, faces = np.asarray(is_found), np.asarray(surface.faces)
    assert (nearest < 0.06).sum() > 20
    assert np.all(is_found[nearest < 0.06])
    assert not np.any(is_found[nearest == np.inf])
    close = nearest < 0.06
    on_face = np.take_along_axis(distance[:, :, None], faces[np.asarray(face)][:, :, None], axis=1)
    np.testing.assert_allclose(on_face[close].min(axis=1)[:, 0], nearest[close], rtol=1e-3)


def test_beyond_the_boundary_of_a_part_nothing_is_touched(sphere):
    """The tangent plane at the boundary would push cloth there by as much as it hangs below it."""
    mesh, _, _ = sphere
    is_upper = mesh.triangles_center[:, 1] > 0
    surface = prepare_surface(mesh.vertices, mesh.faces[is_upper])
    vertices = jnp.asarray(mesh.vertices, jnp.float32)[surface.vertex_ids]
    query = jnp.array([[0.24, -0.05, 0.0], [0.24, 0.1, 0.0]])
    contacts = find(query, vertices, vertices, surface)
    np.testing.assert_array_equal(contacts.is_near, [False, True])
    assert contacts.distances[0] > 0
    deeper = 0.9 * query  # the first is below the last faces' plane, and beyond them
    inside = is_inside(jnp.ones(2, bool), deeper, vertices, surface)
    np.testing.assert_array_equal(inside, [False, True])


def winding(query, corners):
    """How often a closed surface of faces [faces, 3, 3] winds around points (Van Oosterom and Strackee 1983)."""
    a, b, c = np.moveaxis(corners[None] - query[:, None, None], 2, 0)
    x, y, z = (np.linalg.norm(side, axis=-1) for side in (a, b, c))
    dot = [np.sum(one * other, axis=-1) for one, other in ((a, b), (b, c), (c, a))]
    angle = np.arctan2(np.sum(a * np.cross(b, c), axis=-1), x * y * z + dot[0] * z + dot[1] * x + dot[2] * y)
    return angle.sum(axis=1) / (2 * np.pi)


@pytest.mark.parametrize("mesh", [needle()[0], icosphere(2, 0.25)], ids=["needle", "ball"])
def test_what_is_inside_is_known_beside_thin_parts_too(mesh):
    rng = np.random.default_rng(0)
    vertices, faces = mesh
    anywhere = rng.uniform(vertices.min(axis=0) - 0.01, vertices.max(axis=0) + 0.01, (300, 3))
    near = rng.choice(vertices, 300) + 3e-3 * rng.normal(size=(300, 3))
    query = np.concatenate([anywhere, near])
    surface = prepare_surface(vertices, faces)
    body = jnp.asarray(vertices, jnp.float32)[surface.vertex_ids]
    found = jax.jit(is_inside)(jnp.ones(600, bool), jnp.asarray(query, jnp.float32), body, surface)
    np.testing.assert_array_equal(found, winding(query, vertices[faces]) > 0.5)


@pytest.mark.slow  # a rollout of a garment of 4k vertices on each test clip
@pytest.mark.parametrize("clip", load_splits()["motions"]["test"])
def test_contacts_of_cloth_are_the_true_nearest_points_of_the_whole_body(clip):
    poses = pose_body(load_body(), load_motion(clip), num_frames=41)
    scene = prepare_scene(load_garment("tshirt", vertices="4k"), poses)
    positions = rollout_scene(None, scene, SimConfig(iterations=20)).positions
    assert scene.body is not None
    surface, blocks, rows = scene.body.surface, scene.garment.vertex_blocks, np.arange(0, 4000, 4)
    search = jax.jit(nearest_point)
    obstacle = np.asarray(poses.faces)[np.asarray(poses.is_obstacle)]
    errors = []
    for frame in range(0, 41, 10):
        found = search(positions[frame], scene.body.positions[frame], surface, blocks)
        query, body = np.asarray(positions[frame])[rows], np.asarray(poses.positions[frame])
        face, weights = closest_points(query, body, obstacle)
        exact = np.linalg.norm(np.einsum("vc,vcx->vx", weights, body[obstacle[face]]) - query, axis=1)
        is_near = exact < CONTACT_RADIUS
        errors.append((np.sqrt(found.squared_distance)[rows] - exact)[is_near])
    error = np.concatenate(errors)
    print(
        f"{clip}: {len(error)} vertices, {np.mean(error > 1e-4):.3%} off by 0.1 mm, worst {error.max():.6f} m"
    )
    assert error.min() > -1e-5
    assert np.mean(error > 1e-3) <= 1e-3
