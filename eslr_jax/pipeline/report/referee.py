"""Count intersecting triangles with the IPC Toolkit (extra `score`), not with the simulator's own search."""

from __future__ import annotations

import dataclasses
from types import ModuleType

import numpy as np
from jaxtyping import Float, Int

from eslr_jax.pipeline.extras import require


@dataclasses.dataclass(frozen=True)
class Verdict:
    """How much intersects in one frame."""

    cloth_cloth: int  # pairs of cloth triangles
    cloth_body: int  # pairs of a cloth and a body triangle


def judge(
    cloth: Float[np.ndarray, "vertices 3"],
    cloth_faces: Int[np.ndarray, "faces 3"],
    body: Float[np.ndarray, "body_vertices 3"] | None = None,
    body_faces: Int[np.ndarray, "body_faces 3"] | None = None,
) -> Verdict:
    """Count intersecting pairs of triangles; the arguments are those of `intersecting_pairs`."""
    pairs = intersecting_pairs(cloth, cloth_faces, body, body_faces)
    is_body = (pairs >= len(cloth_faces)).any(axis=1)
    return Verdict(cloth_cloth=int(np.sum(~is_body)), cloth_body=int(np.sum(is_body)))


def intersecting_pairs(
    cloth: Float[np.ndarray, "vertices 3"],
    cloth_faces: Int[np.ndarray, "faces 3"],
    body: Float[np.ndarray, "body_vertices 3"] | None = None,
    body_faces: Int[np.ndarray, "body_faces 3"] | None = None,
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
    sides = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    edges, edge_of_side, counts = np.unique(sides, axis=0, return_inverse=True, return_counts=True)
    edges = np.asfortranarray(edges)
    sides_by_edge = np.argsort(edge_of_side.ravel(), kind="stable")
    beside = np.split(sides_by_edge % len(faces), np.cumsum(counts)[:-1])  # faces of every edge
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
