"""Where triangles intersect, by our own search and, as a referee, by the IPC Toolkit (extra `score`)."""

from __future__ import annotations

from types import ModuleType
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from eslr_jax.mesh.closest import closest_points
from eslr_jax.mesh.piercing import piercing_edges
from eslr_jax.mesh.topology import undirected_edges, unique_edges, vertex_components
from eslr_jax.pipeline.extras import require
from eslr_jax.pipeline.formats.mesh import Faces, Positions


class Crossings(NamedTuple):
    """Where a mesh passes through itself."""

    faces: Int[np.ndarray, "pairs 2"]  # that intersect; the first number is the smaller one
    depths: Float[np.ndarray, " vertices"]  # behind the other layer [m]; zero elsewhere


def find_crossings(positions: Positions, faces: Faces) -> Crossings:
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


def _regions(piercing: np.ndarray, faces: Faces, num_vertices: int) -> Int[np.ndarray, " vertices"]:
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


def intersecting_pairs(
    cloth: Positions, cloth_faces: Faces, body: Positions | None = None, body_faces: Faces | None = None
) -> Int[np.ndarray, "pairs 2"]:
    """Return pairs of intersecting faces; the numbers of body faces follow those of cloth faces.

    Two triangles intersect where an edge of one pierces the other. Faces that share a vertex touch by
    construction and are left out. So are pairs of body faces: real bodies intersect themselves. Positions that
    are not finite have no pairs. Padded vertices, which no face uses, do no harm.

    Raises:
        MissingExtraError: The IPC Toolkit is not installed.
    """
    ipctk = require("ipctk", extra="score", purpose="counting intersections")
    positions, faces = np.asarray(cloth, np.float64), np.asarray(cloth_faces, np.int32)
    if body is not None and body_faces is not None:
        faces = np.concatenate([faces, np.asarray(body_faces, np.int32) + len(positions)])
        positions = np.concatenate([positions, np.asarray(body, np.float64)])
    if not np.isfinite(positions).all():
        return np.empty((0, 2), np.int64)
    positions, faces = np.asfortranarray(positions), np.asfortranarray(faces)
    edges, edge_of_side, counts = undirected_edges(faces)
    edges = np.asfortranarray(edges, np.int32)
    sides_by_edge = np.argsort(edge_of_side, kind="stable")
    beside = np.split(sides_by_edge // 3, np.cumsum(counts)[:-1])  # faces of every edge
    broad = ipctk.LBVH()
    broad.can_vertices_collide = ipctk.make_static_obstacle_filter(len(cloth))
    broad.build(positions, edges, faces, 0.0)
    candidates = broad.detect_edge_face_candidates()
    ids = np.array([(found.edge_id, found.face_id) for found in candidates], np.int64).reshape(-1, 2)
    # Which edges pierce which triangles: float64 sorts out the clear cases, the toolkit the rest.
    ends, corners = positions[edges[ids[:, 0]]], positions[faces[ids[:, 1]]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    heights = np.einsum("pex,px->pe", ends - corners[:, :1], normal)
    margin = 1e-12 * np.abs(ends).max(initial=1e-300) * np.linalg.norm(normal, axis=1)
    hits = (heights.min(axis=1) <= margin) & (heights.max(axis=1) >= -margin)
    for row in np.flatnonzero(hits):
        hits[row] = _meets(ipctk, *ends[row], corners[row])
    pairs = [
        (min(face, other), max(face, other))
        for edge, face in ids[hits]
        for other in beside[edge]
        if not set(faces[face]) & set(faces[other])
    ]
    return np.unique(np.array(pairs, np.int64).reshape(-1, 2), axis=0)


def _meets(ipctk: ModuleType, start: np.ndarray, end: np.ndarray, corners: np.ndarray) -> bool:
    """Return whether one edge meets one triangle; the toolkit calls every coplanar pair a hit."""
    is_hit, u, *_ = ipctk.edge_triangle_intersection(start, end, *corners)
    if not is_hit or np.isfinite(u):
        return bool(is_hit)
    tolerance = 1e-20 * float(np.sum((end - start) ** 2))
    distances = [ipctk.point_triangle_distance(point, *corners) for point in (start, end)]
    distances += [
        ipctk.edge_edge_distance(start, end, corners[i], corners[j]) for i, j in ((0, 1), (1, 2), (2, 0))
    ]
    return min(distances) <= tolerance
