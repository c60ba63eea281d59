"""Coarse levels of a garment's edges, as HOOD builds them.

A level removes the vertices at an odd number of hops from the centre of their component. It joins the
neighbours that such a vertex had one hop closer to those one hop farther. Further edges join kept vertices
that would lose each other: the closer neighbours of a removed vertex without farther ones, and neighbours
at equal distance.

Source: HOOD's `utils/coarse.py`; the centre is the middle of a longest path found by two breadth-first searches.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import scipy.sparse
from jaxtyping import Int
from scipy.sparse.csgraph import breadth_first_order, connected_components, dijkstra

from eslr_jax.mesh.padding import round_up
from eslr_jax.mesh.topology import adjacency, directed_edges
from eslr_jax.types import CoarseEdges, Garment

# Of the mesh edges, for HOOD's three levels; enough for every bundled garment.
CAPACITIES = (0.42, 0.26, 0.14)

Graph = list[set[int]]  # neighbours of every vertex


def add_coarse_edges(garment: Garment) -> Garment:
    """Return a prepared garment, NumPy or JAX, with the coarse edges that a hierarchical network reads.

    A padded garment gets padded coarse edges, of sizes that follow from its number of mesh edges; pad it first.
    """
    mask = np.asarray(garment.edge_mask)
    pairs = np.stack([np.asarray(garment.senders)[mask], np.asarray(garment.receivers)[mask]], axis=1)
    vertex_mask = np.asarray(garment.vertex_mask)
    last, levels = len(vertex_mask) - 1, []
    for edges, share in zip(coarsen(pairs, len(vertex_mask)), CAPACITIES, strict=True):
        senders, receivers, reverse = directed_edges(edges)
        count = len(senders)
        capacity = max(round_up(int(share * len(mask))), round_up(count))
        padding = np.full(0 if vertex_mask[last] else capacity - count, last)  # the last vertex to itself
        itself = np.arange(count, count + len(padding))
        level = CoarseEdges(
            senders=np.concatenate([senders, padding]).astype(np.int32),
            receivers=np.concatenate([receivers, padding]).astype(np.int32),
            reverse_edges=np.concatenate([reverse, itself]).astype(np.int32),
            edge_mask=np.arange(count + len(padding)) < count,
            is_kept=np.isin(np.arange(len(vertex_mask)), senders),
        )
        levels.append(level)
    return dataclasses.replace(garment, coarse=tuple(levels))


def coarsen(pairs: Int[np.ndarray, "edges 2"], num_vertices: int) -> list[Int[np.ndarray, "coarse_edges 2"]]:
    """Return the undirected edges of every coarse level, finest first, given the mesh edges."""
    centers, levels = _centers(adjacency(pairs, num_vertices)), []
    for _ in CAPACITIES:
        hops = dijkstra(adjacency(pairs, num_vertices), indices=centers, unweighted=True, min_only=True)
        hops = np.where(np.isfinite(hops), hops, 0).astype(int)  # zero where none is reached (HOOD)
        graph: Graph = [set() for _ in range(num_vertices)]
        for a, b in pairs.tolist():
            _link(graph, a, b)
        graph = _coarsen_once(graph, hops.tolist())
        edges = sorted((a, b) for a, around in enumerate(graph) for b in around if a < b)
        pairs = np.array(edges, np.int64).reshape(-1, 2)
        levels.append(pairs)
    return levels


def _coarsen_once(graph: Graph, distance: list[int]) -> Graph:
    """Return the next level of a graph, given the hops of its vertices from the centres."""
    joined: Graph = [set() for _ in graph]
    removed = [_split(around, distance, i) for i, around in enumerate(graph) if distance[i] % 2]
    for closer, farther in removed:
        for a in closer:
            for b in farther:
                _link(joined, a, b)
    level = [set(around) for around in joined]
    for closer, farther in removed:
        for a in closer if not farther else ():
            for b in closer:
                if a != b and not _is_near(joined, a, b):
                    _link(level, a, b)
    for i, around in enumerate(graph):
        if distance[i] % 2 == 0:
            for a in sorted(around):
                if distance[a] % 2 == 0 and not _is_near(level, a, i):
                    _link(level, a, i)
    return level


def _split(around: set[int], distance: list[int], i: int) -> tuple[list[int], list[int]]:
    """Return the neighbours of `i` one hop closer to the centre and one hop farther."""
    closer = [a for a in sorted(around) if distance[a] == distance[i] - 1]
    return closer, [a for a in sorted(around) if distance[a] == distance[i] + 1]


def _link(graph: Graph, a: int, b: int) -> None:
    graph[a].add(b)
    graph[b].add(a)


def _is_near(graph: Graph, a: int, b: int) -> bool:
    """Return whether two vertices are at most two hops apart."""
    return b in graph[a] or not graph[a].isdisjoint(graph[b])


def _centers(matrix: scipy.sparse.csr_array) -> list[int]:
    """Return the middle of a longest path of every component with edges."""
    _, component = connected_components(matrix, directed=False)
    linked = np.flatnonzero(np.diff(matrix.indptr))
    centers = []
    for start in linked[np.unique(component[linked], return_index=True)[1]]:
        path = _path_to_farthest(matrix, _path_to_farthest(matrix, start)[-1])
        centers.append(path[len(path) // 2])
    return centers


def _path_to_farthest(matrix: scipy.sparse.csr_array, start: int) -> list[int]:
    """Return a shortest path to the vertex that is farthest from `start`, the first of them that is found."""
    order, parents = breadth_first_order(matrix, start)
    hops = np.zeros(len(parents), int)
    for vertex in order[1:]:
        hops[vertex] = hops[parents[vertex]] + 1
    path = [int(order[hops[order].argmax()])]
    while path[-1] != start:
        path.append(int(parents[path[-1]]))
    return path[::-1]
