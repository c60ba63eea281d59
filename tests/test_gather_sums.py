"""Sums of products with gathers, as the package writes them, against NumPy, with many rows.

XLA of jaxlib 0.10.2 gets `sum(n[:, None] * x[:, ids], axis=0)` wrong on a CPU, by 18, from 16,384 rows on; with
one gather for each component it does not.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eslr_jax.contact.pairs import corners_of
from eslr_jax.mesh.topology import incidence_table
from eslr_jax.networks.operators import MeshTables, sum_neighbors
from eslr_jax.numerics import dot3, gather_corners
from eslr_jax.terms.contact import NearPairs

VERTICES = 2000


def of_pairs(x, n, weights, ids, table):
    """The way between the points of pairs, along their normals."""
    zero = jnp.zeros(ids.shape[1])
    near = NearPairs(ids, weights, (zero,) * 3, (zero,) * 3, tuple(n), zero, zero, zero)
    return dot3(near.normal, near.offsets(tuple(x)))


def of_corners(x, n, weights, ids, table):
    """Corners of pairs, along their normals."""
    corners = corners_of(tuple(x), ids)
    return sum(w * dot3(tuple(n), corner) for w, corner in zip(weights, corners, strict=True))


def of_items(x, n, weights, ids, table):
    """Corners of hinges, whose incidence is known."""
    corners = gather_corners(tuple(x), ids.T, table)
    return sum(w * dot3(tuple(n), corner) for w, corner in zip(weights, corners, strict=True))


@pytest.mark.parametrize("rows", [16_384, 65_536, 262_144])
@pytest.mark.parametrize("form", [of_pairs, of_corners, of_items])
def test_weighted_sums_of_corners_are_numpys(form, rows):
    random = np.random.default_rng(rows)
    x, n, weights = (
        random.normal(size=(k, size)).astype(np.float32) for k, size in ((3, VERTICES), (3, rows), (4, rows))
    )
    ids = random.integers(0, VERTICES, (4, rows), dtype=np.int32)
    found = jax.jit(form)(*map(jnp.asarray, (x, n, weights, ids, incidence_table(ids.T, VERTICES))))
    known = np.einsum("xr,kr,xkr->r", n.astype(np.float64), weights, x[:, ids])
    np.testing.assert_allclose(found, known, atol=1e-4)


@pytest.mark.parametrize("rows", [16_384, 65_536, 262_144])
def test_smoothing_is_numpys(rows):
    random = np.random.default_rng(rows)
    x, scale = random.normal(size=(rows, 3)).astype(np.float32), random.random((rows, 1)).astype(np.float32)
    ids = random.integers(0, rows, (rows, 7), dtype=np.int32)

    def smoothed(x, scale, ids):
        nothing = jnp.zeros(0, jnp.int32)
        return sum_neighbors(x, MeshTables(nothing, nothing, nothing, ids, scale)) * scale

    found = jax.jit(smoothed)(*map(jnp.asarray, (x, scale, ids)))
    np.testing.assert_allclose(found, x[ids].sum(axis=1, dtype=np.float64) * scale, atol=1e-5)
