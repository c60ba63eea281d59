"""Which faces of a mesh pass through each other (host)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from eslr_jax.numerics import pierces

_AT_ONCE = 8_000  # faces that are compared with others at a time; bounds memory


def piercing_edges(
    positions: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the faces whose edges pierce others, the ends of these edges, and the faces that they pierce.

    Faces that share a vertex touch and don't count.
    """
    nothing = np.zeros(0, np.int64)
    if not len(faces):
        return nothing, nothing.reshape(0, 2), nothing
    corners = positions[faces]
    centroids = corners.mean(axis=1)
    reach = np.linalg.norm(corners - centroids[:, None], axis=2).max(axis=1)
    low, high = corners.min(axis=1), corners.max(axis=1)
    # Of two faces the larger one finds the other. One search for all faces of like size.
    sizes = np.frexp(reach * reach)[1]
    found: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for size in np.unique(sizes):
        alike, others = np.flatnonzero(sizes == size), np.flatnonzero(sizes <= size)
        tree, radius = cKDTree(centroids[others]), 2.0 * reach[alike].max()
        for begin in range(0, len(alike), _AT_ONCE):
            rows = alike[begin : begin + _AT_ONCE]
            near = cKDTree(centroids[rows]).sparse_distance_matrix(tree, radius, output_type="ndarray")
            first, second = rows[near["i"]], others[near["j"]]
            is_near = near["v"] <= reach[first] + reach[second]
            first, second = first[is_near], second[is_near]
            is_larger = (reach[first] > reach[second]) | ((reach[first] == reach[second]) & (first < second))
            is_met = np.all((low[first] <= high[second]) & (low[second] <= high[first]), axis=1)
            is_apart = ~np.any(faces[first][:, :, None] == faces[second][:, None, :], axis=(1, 2))
            is_candidate = is_larger & is_met & is_apart
            one, other = first[is_candidate], second[is_candidate]
            for owner, target in ((one, other), (other, one)):
                for k in range(3):
                    ends = faces[owner][:, [k, (k + 1) % 3]]
                    start, end = (tuple(positions[side].T) for side in ends.T)
                    hits = pierces(start, end, [tuple(corner.T) for corner in corners[target].swapaxes(0, 1)])
                    found.append((owner[hits], ends[hits], target[hits]))
    owners, ends, pierced = zip(*found, strict=True)
    return np.concatenate(owners), np.concatenate(ends), np.concatenate(pierced)
