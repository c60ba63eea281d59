"""Coarse levels of a garment's edges, as HOOD builds them.

A level removes the vertices at an odd number of hops from the centre of their component. It joins the
neighbours that such a vertex had one hop closer to those one hop farther. Further edges join kept vertices
that would lose each other: the closer neighbours of a removed vertex without farther ones, and neighbours
at equal distance.

Source: HOOD's `utils/coarse.py`; the centre is the middle of a longest path found by two breadth-first searches.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import numpy as np
from jaxtyping import Bool, Int

from eslr_jax.geometry.padding import round_up
from eslr_jax.geometry.topology import directed_edges
from eslr_jax.types import CoarseEdges, Garment

CAPACITIES = (
    0.42,
    0.26,
    0.14,
)  # of the mesh edges, for HOOD's three levels; enough for every bundled garment

Graph = list[set[int]]  # neighbours of every vertex


def add_coarse_edges(garment: Garment) -> Garment:
    """Return a garment with the coarse edges that a hierarchical network reads.

    A padded garment gets padded coarse edges, of sizes that follow from its number of mesh edges.

    Args:
        garment: A prepared garment, which is not padded afterwards; NumPy or JAX leaves.
    """
    mask = np.asarray(garment.edge_mask)
    pairs = np.stack([np.asarray(garment.senders)[mask], np.asarray(garment.receivers)[mask]], axis=1)
    vertex_mask = np.asarray(garment.vertex_mask)
    levels = []
    for edges, share in zip(coarsen(pairs, len(vertex_mask)), CAPACITIES, strict=True):
        capacity = max(round_up(int(share * len(mask))), round_up(2 * len(edges)))
        levels.append(_level(edges, vertex_mask, capacity))
    return dataclasses.replace(garment, coarse=tuple(levels))


def coarsen(pairs: Int[np.ndarray, "edges 2"], num_vertices: int) -> list[Int[np.ndarray, "coarse_edges 2"]]:
    """Return the undirected edges of every coarse level, finest first.

    Args:
        pairs: Mesh edges, in one direction or both, shape [edges, 2].
        num_vertices: Number of vertices.
    """
    graph: Graph = [set() for _ in range(num_vertices)]
    for a, b in pairs.tolist():
        graph[a].add(b)
        graph[b].add(a)
    centers = _centers(graph)
    levels = []
    for _ in CAPACITIES:
        graph = _coarsen_once(graph, centers)
        edges = sorted((a, b) for a, around in enumerate(graph) for b in around if a < b)
        levels.append(np.array(edges, np.int64).reshape(-1, 2))
    return levels


def _coarsen_once(graph: Graph, centers: Iterable[int]) -> Graph:
    """Return the next level of a graph."""
    distance = _distances(graph, centers)
    joined: Graph = [set() for _ in graph]
    for i, around in enumerate(graph):
        if distance[i] % 2:
            closer, farther = _split(around, distance, i)
            for a in closer:
                for b in farther:
                    _link(joined, a, b)
    level = [set(around) for around in joined]
    for i, around in enumerate(graph):
        if distance[i] % 2:
            closer, farther = _split(around, distance, i)
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
    """Add an edge."""
    graph[a].add(b)
    graph[b].add(a)


def _is_near(graph: Graph, a: int, b: int) -> bool:
    """Return whether two vertices are at most two hops apart."""
    return b in graph[a] or not graph[a].isdisjoint(graph[b])


def _distances(graph: Graph, sources: Iterable[int]) -> list[int]:
    """Return hops from the nearest source; zero where none is reached (HOOD)."""
    distance, front = [-1] * len(graph), list(sources)
    for source in front:
        distance[source] = 0
    while front:
        reached = []
        for i in front:
            for a in graph[i]:
                if distance[a] < 0:
                    distance[a] = distance[i] + 1
                    reached.append(a)
        front = reached
    return [max(hops, 0) for hops in distance]


def _centers(graph: Graph) -> list[int]:
    """Return the middle of a longest path of every component."""
    centers, seen = [], set()
    for start, around in enumerate(graph):
        if around and start not in seen:
            path = _path_to_farthest(graph, _path_to_farthest(graph, start)[-1])
            centers.append(path[len(path) // 2])
            front = {start}
            while front:
                seen.update(front)
                front = {a for i in front for a in graph[i]} - seen
    return centers


def _path_to_farthest(graph: Graph, start: int) -> list[int]:
    """Return a shortest path to a vertex that is farthest from `start`."""
    parent, front, last = {start: start}, [start], start
    while front:
        last = front[0]
        reached = []
        for i in front:
            for a in sorted(graph[i]):
                if a not in parent:
                    parent[a] = i
                    reached.append(a)
        front = reached
    path = [last]
    while path[-1] != start:
        path.append(parent[path[-1]])
    return path[::-1]


def _level(
    edges: Int[np.ndarray, "coarse_edges 2"], vertex_mask: Bool[np.ndarray, " vertices"], capacity: int
) -> CoarseEdges:
    """Return both directions of a level's edges; padded edges join the last vertex to itself."""
    senders, receivers, reverse = directed_edges(edges)
    count, last = len(senders), len(vertex_mask) - 1
    is_kept = np.zeros(len(vertex_mask), bool)
    is_kept[senders] = True
    missing = 0 if vertex_mask[last] else capacity - count
    itself = np.arange(count, count + missing)
    return CoarseEdges(
        senders=np.concatenate([senders, np.full(missing, last)]).astype(np.int32),
        receivers=np.concatenate([receivers, np.full(missing, last)]).astype(np.int32),
        reverse_edges=np.concatenate([reverse, itself]).astype(np.int32),
        edge_mask=np.arange(count + missing) < count,
        is_kept=is_kept,
    )
