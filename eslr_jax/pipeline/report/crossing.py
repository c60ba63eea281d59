"""Where a mesh passes through itself, and how deep (host)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from eslr_jax.mesh.closest import closest_points
from eslr_jax.mesh.piercing import piercing_edges
from eslr_jax.mesh.topology import unique_edges, vertex_components


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
    owners, ends, pierced = piercing_edges(positions, faces)
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
