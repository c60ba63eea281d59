"""Which faces of a mesh pass through each other (host)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from eslr_jax.numerics import cross3, dot3, pierces, sub3

_AT_ONCE = 8_000  # faces that are compared with others at a time; bounds memory


def close_faces(
    positions: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"], apart: float = 0.0
) -> Int[np.ndarray, "2 pairs"]:
    """Return the pairs of faces, without a common vertex, whose boxes along the axes are near, `apart` [m]."""
    if not len(faces):
        return np.zeros((2, 0), np.int64)
    corners = positions[faces]
    centroids = corners.mean(axis=1)
    reach = np.linalg.norm(corners - centroids[:, None], axis=2).max(axis=1) + 0.5 * np.sqrt(3.0) * apart
    low, high = corners.min(axis=1) - 0.5 * apart, corners.max(axis=1) + 0.5 * apart
    # Of two faces the larger one finds the other. One search for all faces of like size.
    sizes = np.frexp(reach * reach)[1]
    found: list[np.ndarray] = []
    for size in np.unique(sizes):
        alike, others = np.flatnonzero(sizes == size), np.flatnonzero(sizes <= size)
        tree, radius = cKDTree(centroids[others]), 2.0 * reach[alike].max()
        for begin in range(0, len(alike), _AT_ONCE):
            rows = alike[begin : begin + _AT_ONCE]
            near = cKDTree(centroids[rows]).sparse_distance_matrix(tree, radius, output_type="ndarray")
            first, second = rows[near["i"]], others[near["j"]]
            is_larger = (reach[first] > reach[second]) | ((reach[first] == reach[second]) & (first < second))
            is_near = is_larger & (near["v"] <= reach[first] + reach[second])
            first, second = first[is_near], second[is_near]
            is_met = np.all((low[first] <= high[second]) & (low[second] <= high[first]), axis=1)
            first, second = first[is_met], second[is_met]
            is_apart = ~np.any(faces[first][:, :, None] == faces[second][:, None, :], axis=(1, 2))
            found.append(np.stack([first[is_apart], second[is_apart]]))
    return np.concatenate(found, axis=1)


def piercing_edges(
    positions: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    pairs: Int[np.ndarray, "2 pairs"] | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the faces whose edges pierce others, the ends of these edges, and the faces that they pierce.

    Faces that share a vertex touch and don't count. Of `pairs`, by default those of `close_faces`, either may
    pierce the other.
    """
    one, other = close_faces(positions, faces) if pairs is None else pairs
    owner, target = np.concatenate([one, other]), np.concatenate([other, one])
    a, b, c = (tuple(positions[corner].T) for corner in faces[target].T)
    normal = cross3(sub3(b, a), sub3(c, a))
    # Most pairs are told by their planes: no edge ends on both sides.
    heights = np.stack([dot3(sub3(tuple(positions[k].T), a), normal) for k in faces[owner].T], axis=1)
    row, edge = np.nonzero(heights * np.roll(heights, -1, axis=1) < 0)
    owner, target = owner[row], target[row]
    ends = np.stack([faces[owner, edge], faces[owner, (edge + 1) % 3]], axis=1)
    start, end = (tuple(positions[side].T) for side in ends.T)
    hits = pierces(start, end, [tuple(positions[corner].T) for corner in faces[target].T])
    return owner[hits], ends[hits], target[hits]
