"""Where a mesh passes through itself, and how deep (host)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from eslr_jax.mesh.closest import closest_points
from eslr_jax.mesh.topology import unique_edges, vertex_components
from eslr_jax.numerics import pierces

_AT_ONCE = 200_000  # pairs of faces that are compared at a time; bounds memory


class Crossings(NamedTuple):
    """Where a mesh passes through itself."""

    faces: Int[np.ndarray, "pairs 2"]  # that intersect; the first number is the smaller one
    depths: Float[np.ndarray, " vertices"]  # behind the other layer [m]; zero elsewhere


def find_crossings(
    positions: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> Crossings:
    """Return the pairs of faces that intersect, and how deep vertices are behind the layer that they passed.

    Two faces intersect where an edge of one pierces the other; faces that share a vertex touch and don't count.
    The edges that pierce surround the cloth on the wrong side: without them it is a separate region. The depth
    of its vertices is their distance from all other cloth, which is too small where a third layer lies nearby.
    An intersection that begins at a crease, as at an armpit, separates no region, so no depth is known. Where
    positions are not finite nothing is found.

    Source: the regions of Baraff, Witkin and Kass 2003, doi 10.1145/1201775.882357, section 4.
    """
    positions = np.asarray(positions, np.float64)
    depths = np.zeros(len(positions))
    if not len(faces) or not np.isfinite(positions).all():
        return Crossings(np.zeros((0, 2), np.int64), depths)
    owners, ends, pierced = _piercing_edges(positions, faces)
    pairs = np.unique(np.sort(np.stack([owners, pierced], axis=1), axis=1), axis=0)
    if len(pairs):
        region = _regions(ends, faces, len(positions))
        for number in range(1, int(region.max()) + 1):
            is_inside = region == number
            others = faces[~is_inside[faces].any(axis=1)]
            inside = np.flatnonzero(is_inside)
            nearest, weights = closest_points(positions[inside], positions, others)
            place = np.einsum("pk,pkx->px", weights, positions[others[nearest]])
            depths[inside] = np.linalg.norm(positions[inside] - place, axis=1)
    return Crossings(pairs, depths)


def _piercing_edges(
    positions: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the faces whose edges pierce others, the ends of these edges, and the faces that they pierce."""
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


def _regions(
    piercing: Int[np.ndarray, "edges 2"], faces: Int[np.ndarray, "faces 3"], num_vertices: int
) -> Int[np.ndarray, " vertices"]:
    """Return numbers of the regions that piercing edges cut off; zero for the largest part of every piece."""
    edges = unique_edges(faces)
    keys = edges.min(axis=1) * num_vertices + edges.max(axis=1)
    cut = piercing.min(axis=1).astype(np.int64) * num_vertices + piercing.max(axis=1)
    kept = edges[~np.isin(keys, cut)]
    graph = coo_matrix((np.ones(len(kept)), tuple(kept.T)), shape=(num_vertices, num_vertices))
    count, region = connected_components(graph, directed=False)
    sizes = np.bincount(region, minlength=count)
    _, piece = vertex_components(faces, num_vertices)
    largest = np.zeros(int(piece.max()) + 1, np.int64)
    by_size = np.argsort(sizes[region], kind="stable")
    largest[piece[by_size]] = region[by_size]  # of one piece the last one stays
    is_small = region != largest[piece]
    numbers = np.zeros(num_vertices, np.int64)
    numbers[is_small] = np.unique(region[is_small], return_inverse=True)[1] + 1
    return numbers
