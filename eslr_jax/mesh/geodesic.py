"""Geodesic distances on a triangle mesh by Dijkstra over mesh edges and unfolded shortcuts.

A shortcut is a straight segment between two vertices that crosses up to three hinges after their faces are
unfolded into a plane. It is a path on the surface, so distances are upper bounds and form a metric; those of
the heat method do neither. An exact solver (pygeodesic) takes a hundred times as long a source, and joins no
components. The mean error is 0.4 % on garments and 1.1 % on a tube of right triangles. With
shortcuts over one hinge it is 1.3 % and 3.9 %, with edges alone 6 % and 16 %.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse
from jaxtyping import Float, Int
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import KDTree

from eslr_jax.mesh import topology

_MAX_HINGES = 3  # that a shortcut crosses


def geodesic_graph(
    positions: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> scipy.sparse.csr_array:
    """Return the symmetric sparse matrix of edge lengths [m]: mesh edges, unfolded shortcuts and bridges.

    A bridge joins the nearest vertices of two components by their Euclidean distance, so that every distance is
    finite.
    """
    edges = topology.unique_edges(faces)
    lengths = np.linalg.norm(positions[edges[:, 0]] - positions[edges[:, 1]], axis=1)
    shortcuts, shortcut_lengths = unfolded_shortcuts(positions, faces)
    bridges, bridge_lengths = _bridges(positions, faces)
    pairs = np.concatenate([edges, shortcuts, bridges])
    values = np.concatenate([lengths, shortcut_lengths, bridge_lengths])
    order = np.lexsort((values, pairs.max(axis=1), pairs.min(axis=1)))
    pairs, values = np.sort(pairs[order], axis=1), values[order]
    keep = np.ones(len(pairs), bool)
    keep[1:] = np.any(pairs[1:] != pairs[:-1], axis=1)  # the shortest of parallel edges
    rows, columns = np.concatenate([pairs[keep], pairs[keep][:, ::-1]]).T
    shape = (len(positions), len(positions))
    return scipy.sparse.csr_array((np.tile(values[keep], 2), (rows, columns)), shape)


def geodesic_distances(
    graph: scipy.sparse.csr_array, sources: Int[np.ndarray, " sources"]
) -> Float[np.ndarray, "sources vertices"]:
    """Return the distance from every source vertex to every vertex [m], shape [sources, vertices]."""
    return np.atleast_2d(dijkstra(graph, indices=sources))


def farthest_point_landmarks(
    graph: scipy.sparse.csr_array, count: int, *, first: int = 0
) -> tuple[Int[np.ndarray, " landmarks"], Float[np.ndarray, "landmarks vertices"]]:
    """Return landmarks, each farthest from the ones before, and their distances to every vertex [m].

    `graph` is connected and has edge lengths [m]; there are at most as many landmarks as vertices.
    """
    landmarks, distances = [first], [dijkstra(graph, indices=first)]
    nearest = distances[0]
    for _ in range(min(count, graph.indptr.size - 1) - 1):
        landmarks.append(int(np.argmax(nearest)))
        distances.append(dijkstra(graph, indices=landmarks[-1]))
        nearest = np.minimum(nearest, distances[-1])
    return np.array(landmarks), np.array(distances)


def unfolded_shortcuts(
    positions: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> tuple[Int[np.ndarray, "shortcuts 2"], Float[np.ndarray, " shortcuts"]]:
    """Return vertex pairs joined by straight segments across one to three unfolded hinges, with lengths [m].

    Each vertex looks through the opposite side of each of its faces, and on through the faces behind. All are
    laid out in one plane with the vertex at the origin. A window is the side looked through, with the cone of
    directions that reach it. A pair may occur in both directions.
    """
    starts, ends, opposites = topology.half_edges(faces)
    twins = topology.twin_half_edges(faces)
    edges = positions[ends] - positions[starts]
    arms = positions[opposites] - positions[starts]
    lengths = np.linalg.norm(edges, axis=1)
    along = np.sum(edges * arms, axis=1) / lengths  # of the opposite vertex, from the half-edge's start [m]
    height = np.linalg.norm(np.cross(edges, arms), axis=1) / lengths  # of the opposite vertex above it [m]
    tolerance = 1e-12 * float(np.mean(lengths)) ** 2

    sources = opposites
    sides = np.arange(len(starts))
    right = np.stack([-along, -height], axis=1)  # the side's start, seen from the source
    left = np.stack([lengths - along, -height], axis=1)  # the side's end, counter-clockwise of `right`
    low, high = right, left  # the cone's bounds
    pairs, segments = [], []
    for _ in range(_MAX_HINGES):
        sides = twins[sides]
        windows = (sources, sides, right, left, low, high)
        sources, sides, right, left, low, high = (array[sides >= 0] for array in windows)
        axis = (right - left) / lengths[sides][:, None]  # the twin runs from left to right
        upwards = np.stack([-axis[:, 1], axis[:, 0]], axis=1)
        apex = left + along[sides][:, None] * axis + height[sides][:, None] * upwards
        from_low, to_high = _cross(low, apex), _cross(apex, high)
        is_seen = (from_low >= -tolerance) & (to_high >= -tolerance)
        pairs.append(np.stack([sources[is_seen], opposites[sides[is_seen]]], axis=1))
        segments.append(np.linalg.norm(apex[is_seen], axis=1))
        # behind the hinge: the side right -> apex for directions below the apex, apex -> left above it
        below, above = from_low > tolerance, to_high > tolerance
        to_right = topology.next_half_edges(sides)
        to_left = topology.next_half_edges(to_right)
        lowest = np.where((from_low > 0)[:, None], apex, low)
        highest = np.where((to_high > 0)[:, None], apex, high)
        sources = np.concatenate([sources[below], sources[above]])
        sides = np.concatenate([to_right[below], to_left[above]])
        low = np.concatenate([low[below], lowest[above]])
        high = np.concatenate([highest[below], high[above]])
        right, left = (
            np.concatenate([right[below], apex[above]]),
            np.concatenate([apex[below], left[above]]),
        )
    joined, values = np.concatenate(pairs), np.concatenate(segments)
    is_pair = joined[:, 0] != joined[:, 1]
    return joined[is_pair], values[is_pair]


def _cross(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the plane cross product; positive where `second` is counter-clockwise of `first`."""
    return first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]


def _bridges(positions: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return one vertex pair for every component but the first, in Prim's order, and their distances [m]."""
    num_components, component = topology.vertex_components(faces, len(positions))
    pairs, lengths = [], []
    is_joined = component == component[0] if len(component) else np.zeros(0, bool)
    best = np.full(len(positions), np.inf)  # distance of an outside vertex to the joined part
    partner = np.zeros(len(positions), np.int64)
    fresh = np.flatnonzero(is_joined)
    for _ in range(num_components - 1):
        outside = np.flatnonzero(~is_joined)
        distance, index = map(np.asarray, KDTree(positions[fresh]).query(positions[outside]))
        is_closer = distance < best[outside]
        best[outside[is_closer]] = distance[is_closer]
        partner[outside[is_closer]] = fresh[index[is_closer]]
        vertex = int(outside[np.argmin(best[outside])])
        pairs.append((int(partner[vertex]), vertex))
        lengths.append(max(float(best[vertex]), 1e-9))  # a sparse graph drops edges of length zero
        fresh = np.flatnonzero(component == component[vertex])
        is_joined[fresh] = True
    return np.array(pairs, np.int64).reshape(-1, 2), np.array(lengths)
