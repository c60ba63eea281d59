"""Coarse levels of small graphs whose levels can be drawn by hand."""

from __future__ import annotations

import numpy as np
import pytest
from reference_models import make_scene

from eslr_jax.mesh.coarse import add_coarse_edges, coarsen


def path(count):
    return np.stack([np.arange(count - 1), np.arange(1, count)], axis=1)


def test_every_level_of_a_path_keeps_every_other_vertex():
    levels = coarsen(path(9), 9)  # the centre is vertex 4
    np.testing.assert_array_equal(levels[0], [[0, 2], [2, 4], [4, 6], [6, 8]])
    np.testing.assert_array_equal(levels[1], [[0, 4], [4, 8]])
    assert len(levels[2]) == 0  # the ends are at one hop and have no farther neighbours


def test_components_are_coarsened_alone():
    both = np.concatenate([path(5), path(5) + 5])
    level = coarsen(both, 10)[0]
    np.testing.assert_array_equal(level, [[0, 2], [2, 4], [5, 7], [7, 9]])


@pytest.mark.parametrize("count", [9, 10])
def test_a_ring_is_closed_again(count):
    """Opposite the centre of nine, two kept neighbours meet; of ten, one is removed between two kept ones."""
    ring = np.concatenate([path(count), [[count - 1, 0]]])
    level = coarsen(ring, count)[0]
    np.testing.assert_array_equal(np.unique(level, return_counts=True)[1], [2, 2, 2, 2, 2])


@pytest.mark.parametrize("pad", [False, True])
def test_coarse_edges_are_directed_sorted_and_paired(pad):
    garment = add_coarse_edges(make_scene(8, 6, pad=pad)[0])
    kept = np.count_nonzero(garment.vertex_mask)
    for level in garment.coarse:
        assert (np.diff(level.receivers) >= 0).all()
        np.testing.assert_array_equal(level.senders[level.reverse_edges], level.receivers)
        np.testing.assert_array_equal(
            np.flatnonzero(level.is_kept), np.unique(level.senders[level.edge_mask])
        )
        assert np.count_nonzero(level.is_kept) <= 0.6 * kept
        kept = np.count_nonzero(level.is_kept)
    assert bool(pad) == (not garment.coarse[0].edge_mask.all())
