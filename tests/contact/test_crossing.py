"""Where cloth passes through itself, pairs take the side that they have at rest."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cloth import make_garment, make_sheet

from eslr_jax.contact.crossing import sides_where_crossed
from eslr_jax.contact.self_contact import find_self_contacts

find = jax.jit(find_self_contacts, static_argnames="capacity")
AMPLE = 4000
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
def test_a_valley_that_closes_too_far_opens_from_where_it_crosses(upwards):
    flat, faces = sheet()
    garment = make_garment(opened(flat, 2.2 * upwards), faces)
    for crosses in (False, True):
        vertices, sides = found(folded(flat, crosses=crosses, upwards=upwards), garment)
        beyond = np.abs(flat[vertices, 0]) - CROSSING
        assert (sides[beyond < 0] == upwards).all()
        is_far = beyond > SPACING
        assert is_far.sum() > 30
        assert (sides[is_far] == (-upwards if crosses else upwards)).all()
        if crosses:
            assert np.sum(sides[(beyond > 0) & ~is_far] == upwards) >= 12


@pytest.mark.parametrize(("angle", "is_near"), [(2.2, True), (0.4, False)])
def test_sides_far_apart_at_rest_are_left_out_where_they_cross(angle, is_near):
    # The sides are 42 mm times 2 cos(angle / 2) apart at rest where they cross: 38 mm, or 82 mm.
    flat, faces = sheet()
    vertices, sides = found(folded(flat, crosses=True), make_garment(opened(flat, angle), faces))
    beyond = np.abs(flat[vertices, 0]) - CROSSING
    is_asked_back = (beyond > 0) & (beyond <= SPACING) & (sides == 1.0)
    assert (is_asked_back.sum() >= 12) == is_near
    assert is_near or not is_asked_back.any()


def test_stacked_layers_that_cross_go_back_to_their_order_from_where_they_cross():
    flat, faces = sheet()
    lift = np.array([0.0, 0.02, 0.0])
    garment = make_garment(np.concatenate([flat, flat + lift]), np.concatenate([faces, faces + len(flat)]))
    tilted = flat + np.stack([0 * flat[:, 0], 0.1 * flat[:, 0], 0 * flat[:, 0] + 0.3 * SPACING], axis=1)
    vertices, sides = found(np.concatenate([flat, tilted]), garment)
    x = flat[vertices % len(flat), 0]
    is_back = sides == np.where(vertices >= len(flat), 1.0, -1.0)
    assert is_back[x >= 0].all()
    assert is_back[(x < 0) & (x > -1.1 * SPACING)].sum() >= 5
    assert not is_back[x < -1.1 * SPACING].any()


def test_pairs_that_the_rest_mesh_says_nothing_about_are_left_out_where_they_cross():
    flat, faces = sheet()
    garment = make_garment(flat, faces)
    counts = []
    for crosses in (False, True):
        vertices, sides = found(folded(flat, crosses=crosses), garment)
        beyond = np.abs(flat[vertices, 0]) - CROSSING
        assert np.sum(beyond > 2 * SPACING) > 20
        assert (sides[beyond < 0] == 1.0).all()
        counts.append(np.sum(np.abs(beyond) < SPACING))
    assert counts[1] < 0.5 * counts[0]


@pytest.mark.parametrize("size", [0.02, 0.06])
def test_a_crossing_pair_far_apart_is_left_out(size):
    """A triangle whose tip dips through another one that is level; its other corners are the lower at rest."""
    level = np.array([[-1.0, 0.0, -1.0], [0.0, 0.0, 1.0], [1.0, 0.0, -1.0]])
    upright = np.array([[0.0, 0.5, 0.0], [0.3, -0.5, 0.0], [-0.3, -0.5, 0.0]])
    at_rest = level[[0, 1, 2]] * 0.3 + [0.0, -0.5, 0.0]
    faces = np.array([[0, 1, 2], [3, 4, 5]])
    garment = make_garment(size * np.concatenate([level, at_rest]), faces)
    pair = jnp.array([3]), jnp.array([[0, 1, 2]]), jnp.array([[0.25, 0.5, 0.25]])
    position = jnp.asarray(size * np.concatenate([level, upright]), jnp.float32)
    side = jax.jit(sides_where_crossed)(position, pair, jnp.array([1.0]), garment)
    assert float(side[0]) == (-1.0 if 0.5 * size < 0.02 else 0.0)
