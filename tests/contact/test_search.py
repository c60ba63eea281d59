"""What the searches are made of: true entries by number, compact groups, opposing faces against brute force."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from eslr_jax import numerics
from eslr_jax.contact.search import PosedSurface, nearest_faces, opposing_faces
from eslr_jax.mesh.closest import closest_points
from eslr_jax.mesh.surface import compact_groups, prepare_surface


@pytest.fixture(scope="module")
def spheres():
    """Two balls three centimetres apart: positions, faces, search tables."""
    left = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
    right = left.copy()
    right.apply_translation([0.23, 0.0, 0.0])
    both = trimesh.util.concatenate(left, right)
    surface = prepare_surface(both.vertices, both.faces)
    return np.asarray(both.vertices)[np.asarray(surface.vertex_ids)], surface


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
    normals = numerics.vertex_normals(
        jnp.asarray(positions, jnp.float32), surface.faces, surface.face_incidence
    )
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
