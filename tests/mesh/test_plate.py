"""Flexural rigidity in newton metres: cylinders in every direction, and a cantilever, on any mesh."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cloth import make_garment
from known_answers.sheets import cantilever_rigidity, grid, irregular, stiffness_across, tube

from eslr_jax.fabric.materials import COTTON
from eslr_jax.mesh.padding import pad_garment
from eslr_jax.mesh.plate import prepare_plate, rest_corners, warp_directions
from eslr_jax.numerics import to_device
from eslr_jax.terms.bending import bending_energy, dihedral_angles, plate_curvatures

RIGIDITY = 2e-5  # [N m]


def plate_of(garment, along=RIGIDITY, across=RIGIDITY, direction=(0.0, 0.0, 1.0)):
    faces = int(np.sum(np.asarray(garment.rest_areas) > 0))
    rigidity = np.broadcast_to([along, across], (faces, 2))
    plate = prepare_plate(garment, warp_directions(garment, direction=direction), rigidity)
    return jax.tree.map(jnp.asarray, plate)


@jax.jit
def face_energies(x, garment, plate):
    angles = dihedral_angles(x, garment)
    return 0.5 * jnp.sum(jnp.stack(plate_curvatures(angles, plate)) ** 2, axis=0)


@jax.jit
def energy(x, garment, plate):
    return bending_energy(x, garment, COTTON.replace(plate=plate))


@pytest.mark.parametrize("spacing", [0.02, 0.01, 0.005])
@pytest.mark.parametrize("mesh", [grid, irregular])
def test_a_tube_has_the_energy_of_its_curvature(mesh, spacing):
    """Flat rolled to a tube of radius r, around each axis: D / (2 r^2) per area, of faces off the free edges."""
    positions, faces = mesh(0.24, 0.16, spacing)
    garment = make_garment(positions, faces)
    plate = plate_of(garment)
    is_inner = ~np.isin(plate.hinges, np.flatnonzero(touches_edge(garment))).any(axis=1)
    area = np.asarray(garment.rest_areas)[is_inner].sum()
    for angle in (0.0, 0.4, np.pi / 4, np.pi / 2, 2.2):
        rolled = jnp.asarray(tube(positions, 0.12, angle), jnp.float32)
        energies = np.asarray(face_energies(rolled, garment, plate))[is_inner]
        assert energies.sum() * 2 * 0.12**2 / area == pytest.approx(RIGIDITY, rel=0.03)


def touches_edge(garment):
    """Return which hinges belong to a face with a free edge: there the sheet may unbend."""
    corners = np.asarray(garment.hinges)
    faces = np.asarray(garment.faces)
    edges, counts = np.unique(
        np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0, return_counts=True
    )
    on_edge = np.zeros(len(garment.vertex_mask), bool)
    on_edge[edges[counts == 1]] = True
    return on_edge[corners].any(axis=1)


@pytest.mark.parametrize("spacing", [0.02, 0.01, pytest.param(0.003, marks=pytest.mark.slow)])
@pytest.mark.parametrize("mesh", [grid, irregular])
def test_a_cantilever_has_the_rigidity_that_it_was_given(mesh, spacing):
    """Along x, of a fabric that is stiffer along its other thread: small deflections, linear."""
    positions, faces = mesh(0.25, 0.1, spacing)
    garment = make_garment(positions, faces)
    plate = plate_of(garment, along=5 * RIGIDITY, across=RIGIDITY)
    assert cantilever_rigidity(garment, plate) == pytest.approx(RIGIDITY, rel=0.05)


def test_the_stiffness_across_a_flat_sheet_is_that_of_the_energy():
    garment = make_garment(*irregular(0.1, 0.08, 0.02))
    plate = plate_of(garment, along=5 * RIGIDITY)
    flat = jnp.asarray(garment.rest_positions)
    across = jax.jit(jax.hessian(lambda heights: energy(flat.at[:, 1].set(heights), garment, plate)))(
        jnp.zeros(len(flat))
    )
    found = stiffness_across(garment, plate).toarray()
    np.testing.assert_allclose(found, across, atol=1e-4 * float(jnp.abs(across).max()))


def test_isotropic_bending_does_not_know_the_direction_of_the_warp():
    positions, faces = irregular(0.1, 0.08, 0.01)
    garment = make_garment(positions, faces)
    bent = jnp.asarray(
        positions + 0.004 * np.random.default_rng(0).standard_normal(positions.shape), jnp.float32
    )
    directions = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.3))
    energies = [float(energy(bent, garment, plate_of(garment, direction=each))) for each in directions]
    assert energies[0] == pytest.approx(energies[1], rel=1e-4)


def test_padding_changes_nothing():
    positions, faces = irregular(0.1, 0.08, 0.01)
    garment = make_garment(positions, faces)
    padded = to_device(pad_garment(garment))
    bent = np.random.default_rng(0).standard_normal((len(padded.vertex_mask), 3)) * 0.004
    bent = bent.astype(np.float32)
    bent[: len(positions)] += positions
    bent[len(positions) :] = bent[-1]
    bent = jnp.asarray(bent)
    plain = float(energy(bent[: len(positions)], garment, plate_of(garment)))
    assert float(energy(bent, padded, plate_of(padded))) == pytest.approx(plain, rel=1e-5)


def test_corners_are_the_rest_faces():
    positions, faces = irregular(0.1, 0.08, 0.02)
    garment = make_garment(positions, faces)
    corners, rest = rest_corners(garment), positions[np.asarray(garment.faces)]
    for a, b in ((0, 1), (1, 2), (2, 0)):
        found = np.linalg.norm(corners[:, a] - corners[:, b], axis=1)
        np.testing.assert_allclose(found, np.linalg.norm(rest[:, a] - rest[:, b], axis=1), rtol=1e-5)
