"""Geodesic distances on a triangle mesh by Dijkstra over mesh edges and unfolded shortcuts.

Over every interior edge one straight edge joins the two opposite vertices, when their segment crosses the
edge after both faces are unfolded into a plane. The shortcut is an exact geodesic of the two faces; it cuts
the bias of edge-only Dijkstra three to five times. Distances stay a metric, which the heat method's do not.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse
from jaxtyping import Float, Int
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from eslr_jax.geometry.topology import find_hinges, unique_edges, vertex_components


def geodesic_graph(
    positions: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> scipy.sparse.csr_array:
    """Return the symmetric sparse matrix of edge lengths [m]: mesh edges, unfolded shortcuts and bridges.

    Components of the mesh are joined, so that every distance is finite: nearest component first, each bridge
    runs between the nearest vertices of two components and is as long as their Euclidean distance.
    """
    edges = unique_edges(faces)
    lengths = np.linalg.norm(positions[edges[:, 0]] - positions[edges[:, 1]], axis=1)
    shortcuts, shortcut_lengths = _unfolded_shortcuts(positions, faces)
    bridges, bridge_lengths = _bridges(positions, faces)
    pairs = np.concatenate([edges, shortcuts, bridges])
    values = np.concatenate([lengths, shortcut_lengths, bridge_lengths])
    order = np.lexsort((values, pairs.max(axis=1), pairs.min(axis=1)))
    pairs, values = np.sort(pairs[order], axis=1), values[order]
    keep = np.ones(len(pairs), bool)
    keep[1:] = np.any(pairs[1:] != pairs[:-1], axis=1)  # the shortest of parallel edges
    pairs, values = pairs[keep], values[keep]
    rows, columns = np.concatenate([pairs, pairs[:, ::-1]]).T
    shape = (len(positions), len(positions))
    return scipy.sparse.csr_array((np.tile(values, 2), (rows, columns)), shape)


def geodesic_distances(
    graph: scipy.sparse.csr_array, sources: Int[np.ndarray, " sources"]
) -> Float[np.ndarray, "sources vertices"]:
    """Return the distance from every source to every vertex [m]."""
    return np.atleast_2d(dijkstra(graph, indices=sources))


def farthest_point_landmarks(
    graph: scipy.sparse.csr_array, count: int, *, first: int = 0
) -> tuple[Int[np.ndarray, " landmarks"], Float[np.ndarray, "landmarks vertices"]]:
    """Pick landmarks one by one, each farthest from those before.

    Args:
        graph: Edge lengths [m], connected.
        count: Landmarks wanted; fewer where the mesh has fewer vertices.
        first: The first landmark.

    Returns:
        Landmark vertices and their distances to every vertex [m].
    """
    count = min(count, graph.shape[0])
    landmarks = np.empty(count, np.int64)
    distances = np.empty((count, graph.shape[0]))
    nearest = np.full(graph.shape[0], np.inf)
    vertex = first
    for row in range(count):
        landmarks[row] = vertex
        distances[row] = dijkstra(graph, indices=vertex)
        nearest = np.minimum(nearest, distances[row])
        vertex = int(np.argmax(nearest))
    return landmarks, distances


def _unfolded_shortcuts(positions: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the opposite-vertex pairs whose unfolded segment crosses their hinge, and its length."""
    hinges, _ = find_hinges(faces)
    start, end, left, right = (positions[hinges[:, k]] for k in range(4))
    length = np.linalg.norm(end - start, axis=1)
    axis = (end - start) / length[:, None]
    left_along = np.sum((left - start) * axis, axis=1)
    right_along = np.sum((right - start) * axis, axis=1)
    left_height = np.linalg.norm(left - start - left_along[:, None] * axis, axis=1)
    right_height = np.linalg.norm(right - start - right_along[:, None] * axis, axis=1)
    crossing = left_along + (right_along - left_along) * left_height / (left_height + right_height)
    is_inside = (crossing >= 0) & (crossing <= length) & (hinges[:, 2] != hinges[:, 3])
    distances = np.hypot(left_along - right_along, left_height + right_height)
    return hinges[is_inside, 2:], distances[is_inside]


def _bridges(positions: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return one vertex pair per component but the first (Prim's order), and their distances."""
    num_components, component = vertex_components(faces, len(positions))
    pairs, lengths = [], []
    is_joined = component == component[0] if len(component) else np.zeros(0, bool)
    best = np.full(len(positions), np.inf)  # distance of an outside vertex to the joined part
    partner = np.zeros(len(positions), np.int64)
    fresh = np.flatnonzero(is_joined)
    for _ in range(num_components - 1):
        outside = np.flatnonzero(~is_joined)
        distance, index = cKDTree(positions[fresh]).query(positions[outside])
        is_closer = distance < best[outside]
        best[outside[is_closer]] = distance[is_closer]
        partner[outside[is_closer]] = fresh[index[is_closer]]
        vertex = int(outside[np.argmin(best[outside])])
        pairs.append((int(partner[vertex]), vertex))
        lengths.append(max(float(best[vertex]), 1e-9))  # a sparse graph drops edges of length zero
        fresh = np.flatnonzero(component == component[vertex])
        is_joined[fresh] = True
    return np.array(pairs, np.int64).reshape(-1, 2), np.array(lengths)
