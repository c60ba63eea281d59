"""Which faces of a mesh pass through each other (host)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from eslr_jax.numerics import pierces

_AT_ONCE = 200_000  # pairs of faces that are compared at a time; bounds memory


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
    tree = KDTree(centroids)
    found: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    step = max(1, _AT_ONCE // 32)
    for begin in range(0, len(faces), step):
        rows = np.arange(begin, min(begin + step, len(faces)))
        # Of two faces the larger one finds the other: they meet within twice its reach.
        near = tree.query_ball_point(centroids[rows], 2.0 * reach[rows])
        first = np.repeat(rows, [len(hits) for hits in near])
        second = np.concatenate([np.asarray(hits, np.int64) for hits in near])
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
