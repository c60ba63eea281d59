"""Edges of the cloth over edges of the body: found where no vertex of either touches the other."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cloth import grid_faces, make_garment

from eslr_jax import prepare_garment
from eslr_jax.contact.edges import clearance_over
from eslr_jax.contact.nearest import find_contacts
from eslr_jax.contact.skin import find_skin_contacts, skin_heights
from eslr_jax.mesh.surface import prepare_surface
from eslr_jax.terms.collision import skin_energies

HALF = 0.03  # [m] of the ridge and of the valley
ROOF = np.array([[-HALF, 0, 0], [HALF, 0, 0], [0, -0.03, HALF], [0, -0.03, -HALF]])  # a ridge along x
ROOF_FACES = np.array([[0, 2, 1], [0, 1, 3]])
VALLEY_FACES = np.array([[0, 1, 2], [0, 3, 1]])


def valley(height):
    """Return cloth whose fold along z points down, so far over the middle of the ridge [m]."""
    return np.array(
        [[0, height, -HALF], [0, height, HALF], [0.04, height + 0.01, 0], [-0.04, height + 0.01, 0]]
    )


def rows_of(height):
    roof = jnp.asarray(ROOF, jnp.float32)
    surface = prepare_surface(ROOF, ROOF_FACES)
    garment = prepare_garment(
        valley(height), VALLEY_FACES, skin_weights=np.ones((4, 1)), skin_indices=np.zeros((4, 1), int)
    )
    here = jnp.asarray(valley(height), jnp.float32)
    return skin_of(here, roof, surface, garment), here


@jax.jit
def skin_of(here, roof, surface, garment):
    nearest = find_contacts(here, roof, roof, surface)
    return find_skin_contacts((here, here), (roof, roof), nearest, surface, garment)


def fold_rows(skin):
    """Return which rows are of the fold, which joins vertices 0 and 1."""
    corners = np.sort(np.asarray(skin.corners), axis=1)
    return (
        np.asarray(skin.is_near) & (corners[:, 0] == 0) & (np.asarray(skin.corners)[:, 1:] <= 1).all(axis=1)
    )


@pytest.mark.parametrize("height", [0.004, 0.001, -0.001])
def test_a_fold_crosses_a_ridge_between_vertices(height):
    skin, here = rows_of(height)
    is_fold = fold_rows(skin)
    assert is_fold.any()
    heights = np.asarray(skin_heights(here, skin))[is_fold]
    np.testing.assert_allclose(heights, height, atol=1e-6)
    np.testing.assert_allclose(np.asarray(skin.next_points)[is_fold], 0.0, atol=1e-6)


def test_fine_cloth_finds_the_middle_of_a_long_edge_of_the_body():
    """No face over an end of the ridge holds the edge that crosses it, thirty millimetres away."""
    height = -0.0005
    x, z = np.meshgrid(6e-3 * np.arange(-5, 6), np.array([-9e-3, -3e-3, 3e-3, 9e-3]))
    strip = np.stack([x, height + 0.5 * np.abs(x), z], axis=-1).reshape(-1, 3)
    garment = make_garment(strip, grid_faces(4, 11))
    roof, surface = jnp.asarray(ROOF, jnp.float32), prepare_surface(ROOF, ROOF_FACES)
    here = jnp.asarray(strip, jnp.float32)
    skin = skin_of(here, roof, surface, garment)
    is_fold = np.asarray(skin.is_near) & (np.sort(skin.corners, axis=1)[:, (0, 2)] == [16, 27]).all(axis=1)
    assert is_fold.any()
    np.testing.assert_allclose(np.asarray(skin_heights(here, skin))[is_fold], height, atol=1e-6)


def test_a_fold_in_the_ridge_is_pushed_out():
    skin, here = rows_of(-0.001)
    force = -jax.jit(jax.grad(lambda x: skin_energies(x, skin, 3.5e7, 2e-3).sum()))(here)
    assert np.all(np.asarray(force)[:2, 1] > 0)


def test_a_fold_high_over_the_ridge_is_not_near():
    skin, _ = rows_of(0.05)
    assert not fold_rows(skin).any()


@pytest.mark.parametrize(("beside", "is_over"), [(0.0, True), (0.008, True), (0.012, False)])
def test_cloth_counts_as_over_a_place_up_to_a_centimetre_beside_it(beside, is_over):
    """Folds lie beside the vertices that they are about to cut."""
    over = jnp.float32(0.004)
    clearance = clearance_over(over**2 + beside**2, over, over - 0.003)
    assert float(clearance) == pytest.approx(0.001 if is_over else np.inf)
