"""Where cloth passes through itself, pairs take the side that they have at rest."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cloth import make_garment, make_sheet

from eslr_jax.contact.self_contact import find_self_contacts
from eslr_jax.types import PairCapacity

find = jax.jit(find_self_contacts, static_argnames="capacity")
AMPLE = PairCapacity(pairs=4000)
SPACING = 0.012  # [m]
CROSSING = 3.5 * SPACING  # from the fold to where the sides of a folded sheet cross [m]


def sheet():
    """A sheet that faces up, with its middle at the origin."""
    positions, faces = make_sheet(7, 13, SPACING, jitter=0)
    return positions - positions.mean(axis=0), faces


def opened(flat, angle):
    """Turn the half with x > 0 upwards by an angle [rad], so that the upper sides look at each other."""
    x, _, z = flat.T
    turned = np.stack([np.cos(angle) * x, np.sin(angle) * x, z], axis=1)
    return np.where((x > 0)[:, None], turned, flat)


def folded(flat, *, crosses, upwards=1.0):
    """Lay the half with x > 0 over the other, 6 mm away from it; or let it dip through, from the middle on."""
    x, _, z = flat.T
    height = 0.006 * (1 - x / CROSSING) if crosses else np.full_like(x, 0.006)
    laid = np.stack([-x, upwards * height, z + 0.3 * SPACING], axis=1)
    return np.where((x > 0)[:, None], laid, flat)


def found(points, garment):
    """Vertices and sides of the pairs."""
    x = jnp.asarray(points, jnp.float32)
    pairs = find(x, x, garment, AMPLE)
    is_used = np.asarray(pairs.side) != 0
    return np.asarray(pairs.vertices)[is_used], np.asarray(pairs.side)[is_used]


@pytest.mark.parametrize("upwards", [1.0, -1.0])
def test_a_valley_that_closes_too_far_opens_again(upwards):
    flat, faces = sheet()
    garment = make_garment(opened(flat, 1.2 * upwards), faces)
    for crosses in (False, True):
        vertices, sides = found(folded(flat, crosses=crosses, upwards=upwards), garment)
        assert np.sum(np.abs(flat[vertices, 0]) > CROSSING) > 30
        assert (sides == upwards).all()


def test_stacked_layers_that_cross_go_back_to_their_order():
    flat, faces = sheet()
    lift = np.array([0.0, 0.02, 0.0])
    garment = make_garment(np.concatenate([flat, flat + lift]), np.concatenate([faces, faces + len(flat)]))
    tilted = flat + np.stack([0 * flat[:, 0], 0.1 * flat[:, 0], 0 * flat[:, 0] + 0.3 * SPACING], axis=1)
    vertices, sides = found(np.concatenate([flat, tilted]), garment)
    is_near = np.abs(flat[vertices % len(flat), 0]) < 0.03  # of where they cross; farther on they stay
    assert is_near.sum() > 100
    np.testing.assert_array_equal(sides[is_near], np.where(vertices[is_near] >= len(flat), 1.0, -1.0))


def test_a_pair_that_the_rest_mesh_says_nothing_about_is_left_out_where_cloth_crosses():
    flat, faces = sheet()
    garment = make_garment(flat, faces)
    for crosses in (False, True):
        vertices, sides = found(folded(flat, crosses=crosses), garment)
        count = np.sum(np.abs(flat[vertices, 0]) > CROSSING)
        assert count == 0 if crosses else count > 30
        assert (sides == 1.0).all()


@pytest.mark.parametrize("crosses", [False, True])
def test_pairs_beyond_the_next_layer_are_left_out_where_cloth_crosses(crosses):
    flat, faces = sheet()
    count, up = len(flat), np.array([[0.0, 1.0, 0.0]])
    middle = flat * [1, 0, 1] + up * (0.1 * flat[:, :1] if crosses else 0.013) + [0, 0, 0.3 * SPACING]
    layers = [flat, middle, flat + 0.026 * up]
    rest = np.concatenate([flat + 0.026 * k * up for k in range(3)])
    garment = make_garment(rest, np.concatenate([faces + k * count for k in range(3)]))
    here = np.concatenate(layers)
    ahead = np.concatenate([*layers[:2], flat + 0.018 * up])  # the third comes nearer to the first
    pairs = find(jnp.asarray(here, jnp.float32), jnp.asarray(ahead, jnp.float32), garment, AMPLE)
    is_used = np.asarray(pairs.side) != 0
    layer = np.asarray(pairs.vertices)[is_used] // count, np.asarray(pairs.corners)[is_used][:, 0] // count
    is_far = np.abs(layer[0] - layer[1]) == 2
    is_middle = np.abs(here[np.asarray(pairs.vertices)[is_used], 0]) < 0.03
    found_far = np.sum(is_far & is_middle)
    assert found_far == 0 if crosses else found_far > 30
    assert np.sum(~is_far & is_middle) > 30
