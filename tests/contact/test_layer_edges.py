"""Edges of cloth that cross edges of another layer between vertices: found once, kept on the vertices' side."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cloth import make_garment

from eslr_jax.contact.layer_edges import with_edges
from eslr_jax.contact.self_contact import find_self_contacts
from eslr_jax.terms.repulsion import pair_heights, push_apart, repulsion_diagonal, repulsion_energies
from eslr_jax.types import tree_cast

HALF = 0.03  # [m] of a ridge along x, and of a valley along z over it
RIDGE = np.array([[-HALF, 0, 0], [HALF, 0, 0], [0, -0.012, HALF], [0, -0.012, -HALF]])
VALLEY = np.array([[0, 0, -HALF], [0, 0, HALF], [HALF, 0.012, 0], [-HALF, 0.012, 0]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [4, 5, 6], [4, 7, 5]])
STIFFNESS, THICKNESS = 3.5e7, 3e-3


def energy(position, edges, thickness):
    return repulsion_energies(position, edges, STIFFNESS, thickness).sum()


slope = jax.jit(jax.value_and_grad(energy))

SIXTEEN = 16


def layers(height):
    """Return a garment of a ridge and a valley that is so far over it at the crossing [m], and positions."""
    positions = np.concatenate([RIDGE, VALLEY + np.array([0, height, 0])])
    garment = make_garment(np.concatenate([RIDGE, VALLEY + np.array([0, 0.004, 0])]), FACES)
    return garment, jnp.asarray(positions, jnp.float32)


@jax.jit
def edges_of(position, garment):
    faces = find_self_contacts(position, position, garment, SIXTEEN)
    return with_edges(position, position, faces, garment)


def crossing(edges):
    """Return the rows of the ridge's fold and the valley's."""
    ends = np.sort(np.asarray(edges.corners).reshape(-1, 2, 2), axis=2)
    is_fold = [{tuple(one), tuple(other)} == {(0, 1), (4, 5)} for one, other in ends]
    return np.flatnonzero(is_fold & np.asarray(edges.is_edge) & (np.asarray(edges.side) != 0))


@pytest.mark.parametrize("height", [0.004, 0.0005])
def test_two_folds_cross_between_their_vertices_and_are_found_once(height):
    garment, position = layers(height)
    edges = edges_of(position, garment)
    (row,) = crossing(edges)
    heights, direction = pair_heights(position, edges)
    np.testing.assert_allclose(heights[row], height, atol=1e-6)
    is_valley_first = int(edges.corners[row, 0]) >= 4
    up = np.array([axis[row] for axis in direction]) * (1 if is_valley_first else -1)
    np.testing.assert_allclose(up, [0, 1, 0], atol=1e-5)


def test_a_pair_stands_for_the_area_of_all_its_ends_whoever_found_it():
    """Two ends may find it at heights that differ by rounding alone, and the lower one is kept."""
    garment, position = layers(0.0005)
    areas = np.linspace(1e-4, 8e-4, 8, dtype=np.float32)
    edges = edges_of(position, garment.replace(vertex_areas=jnp.asarray(areas)))
    (row,) = crossing(edges)
    assert float(edges.areas[row]) == pytest.approx(areas[[0, 1, 4, 5]].mean(), rel=1e-6)


def test_folds_that_have_passed_through_each_other_are_asked_back():
    """The vertices around know the side, as they are over faces that they have not passed."""
    garment, position = layers(-0.001)
    edges = edges_of(position, garment)
    (row,) = crossing(edges)
    heights, _ = pair_heights(position, edges)
    np.testing.assert_allclose(heights[row], -0.001, atol=1e-6)
    force = -slope(position, edges, THICKNESS)[1]
    assert np.all(np.asarray(force)[4:6, 1] > 0)
    assert np.all(np.asarray(force)[:2, 1] < 0)
    apart = jax.jit(push_apart)(position, edges, THICKNESS)
    assert np.all(np.asarray(pair_heights(apart, edges)[0])[row] > 0.9 * THICKNESS)


def test_layers_far_apart_have_no_edges_in_contact():
    garment, position = layers(0.03)
    edges = edges_of(position, garment)
    assert not np.any(np.asarray(edges.side)[np.asarray(edges.is_edge)])


@pytest.mark.numerics
def test_gradient_equals_central_differences_and_has_no_resultant_and_no_moment():
    garment, position = layers(0.001)
    edges = edges_of(position, garment)
    with jax.enable_x64(True):
        edges = tree_cast(edges, jnp.float64)
        first, second = (jnp.maximum(sign * edges.weights, 0.0) for sign in (1, -1))
        shares = [one / jnp.maximum(one.sum(axis=1, keepdims=True), 1e-9) for one in (first, second)]
        edges = edges.replace(weights=shares[0] - shares[1])  # sum to zero in float64 too
        x = jnp.asarray(
            np.asarray(position, np.float64) + 1e-3 * np.random.default_rng(0).normal(size=(8, 3))
        )

        gradient = np.asarray(slope(x, edges, 0.01)[1])
        step = 1e-6
        offsets = step * jnp.eye(24).reshape(24, 8, 3)
        energies = jax.jit(jax.vmap(lambda x: energy(x, edges, 0.01)))
        difference = (energies(x[None] + offsets) - energies(x[None] - offsets)) / (2 * step)
        size = np.abs(gradient).sum()
        assert size > 0.01
        np.testing.assert_allclose(gradient.ravel(), difference, rtol=1e-5, atol=1e-8 * size)
        np.testing.assert_allclose(gradient.sum(axis=0), 0.0, atol=1e-12 * size)
        np.testing.assert_allclose(np.cross(np.asarray(x), gradient).sum(axis=0), 0.0, atol=1e-12 * size)
        assert np.all(np.asarray(jax.jit(repulsion_diagonal)(x, edges, STIFFNESS, 0.01)) >= 0)


def test_energy_is_finite_on_cloth_without_extent():
    garment, position = layers(0.001)
    for x in (jnp.zeros_like(position), position * jnp.array([[1.0, 0.0, 0.0]])):
        edges = edges_of(x, garment)
        value, gradient = slope(x, edges, THICKNESS)
        assert np.isfinite(value)
        assert np.isfinite(gradient).all()
