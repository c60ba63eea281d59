"""Exact closest points on a triangle mesh, on the host."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from eslr_jax.mesh.topology import normalize


def closest_points(
    points: Float[np.ndarray, "points 3"],
    positions: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    *,
    num_candidates: int = 16,
) -> tuple[Int[np.ndarray, " points"], Float[np.ndarray, "points 3"]]:
    """Return the exact closest face of every point, and the closest point's barycentric coordinates in it.

    Candidates are the faces with the nearest centroids. A face reaches no farther from its centroid than the
    largest centroid-corner distance. A point is done when no face beyond its candidates can be closer; the
    others are tried again with four times as many.
    """
    corners = np.asarray(positions, np.float64)[faces]
    centroids = corners.mean(axis=1)
    reach = float(np.sqrt(np.max(np.sum((corners - centroids[:, None]) ** 2, axis=2))))
    tree = KDTree(centroids)
    nearest = np.zeros(len(points), np.int64)
    barycentric = np.zeros((len(points), 3))
    open_points = np.arange(len(points))
    while len(open_points):
        num_candidates = min(num_candidates, len(faces))
        still_open = []
        rows_at_once = max(1, 2_000_000 // num_candidates)  # bounds memory
        for begin in range(0, len(open_points), rows_at_once):
            rows = open_points[begin : begin + rows_at_once]
            gaps, candidates = tree.query(points[rows], k=num_candidates)
            gaps, candidates = gaps.reshape(len(rows), -1), candidates.reshape(len(rows), -1)
            coordinates = barycentric_of_closest(points[rows][:, None], corners[candidates])
            closest = np.einsum("pfc,pfcx->pfx", coordinates, corners[candidates])
            distances = np.linalg.norm(closest - points[rows][:, None], axis=2)
            best = np.argmin(distances, axis=1)
            pick = np.arange(len(rows))
            nearest[rows] = candidates[pick, best]
            barycentric[rows] = coordinates[pick, best]
            if num_candidates < len(faces):
                still_open.append(rows[gaps[:, -1] - reach < distances[pick, best]])
        open_points = np.concatenate(still_open) if still_open else open_points[:0]
        num_candidates *= 4
    return nearest, barycentric


class NearestPlaces(NamedTuple):
    """Where a mesh is nearest to points."""

    faces: Int[np.ndarray, " points"]
    weights: Float[np.ndarray, "points 3"]  # barycentric, of the place on the face
    offsets: Float[np.ndarray, "points 3"]  # from the place to the point [m]
    normals: Float[np.ndarray, "points 3"]  # of length one, between those of the face's vertices


def nearest_places(
    points: Float[np.ndarray, "points 3"],
    positions: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    normals: Float[np.ndarray, "vertices 3"],
) -> NearestPlaces:
    """Return the place of a mesh that is nearest to every point [m], and the mesh's normal there."""
    nearest, weights = closest_points(points, positions, faces)
    corners = faces[nearest]
    offsets = points - np.einsum("pk,pkx->px", weights, positions[corners])
    along = np.einsum("pk,pkx->px", weights, normals[corners])
    return NearestPlaces(nearest, weights, offsets, normalize(along))


def barycentric_of_closest(
    points: Float[np.ndarray, "*batch 3"], triangles: Float[np.ndarray, "*batch 3 3"]
) -> Float[np.ndarray, "*batch 3"]:
    """Return the barycentric coordinates of the point of each triangle that is closest to each point.

    Source: regions of Ericson, Real-Time Collision Detection, section 5.1.5.
    """
    a, b, c = (triangles[..., k, :] for k in range(3))
    ab, ac = b - a, c - a
    d1, d2 = _dot(ab, points - a), _dot(ac, points - a)
    d3, d4 = _dot(ab, points - b), _dot(ac, points - b)
    d5, d6 = _dot(ab, points - c), _dot(ac, points - c)
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    total = va + vb + vc
    inside = [area / np.where(total == 0, 1.0, total) for area in (va, vb, vc)]
    along_ab = _ratio(d1, d1 - d3)
    along_ac = _ratio(d2, d2 - d6)
    along_bc = _ratio(d4 - d3, (d4 - d3) + (d5 - d6))
    regions = [
        ((d1 <= 0) & (d2 <= 0), (1.0, 0.0, 0.0)),
        ((d3 >= 0) & (d4 <= d3), (0.0, 1.0, 0.0)),
        ((d6 >= 0) & (d5 <= d6), (0.0, 0.0, 1.0)),
        ((vc <= 0) & (d1 >= 0) & (d3 <= 0), (1 - along_ab, along_ab, 0.0)),
        ((vb <= 0) & (d2 >= 0) & (d6 <= 0), (1 - along_ac, 0.0, along_ac)),
        ((va <= 0) & (d4 >= d3) & (d5 >= d6), (0.0, 1 - along_bc, along_bc)),
    ]
    is_here, places = zip(*regions, strict=True)
    return np.stack(
        [np.select(is_here, [place[k] for place in places], inside[k]) for k in range(3)], axis=-1
    )


def _dot(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.sum(first * second, axis=-1)  # in one order everywhere: equally near faces are told by rounding


def _ratio(numerator: np.ndarray, denominator: np.ndarray) -> np.ndarray:
    """Return the quotient, or the numerator where the denominator is zero."""
    return numerator / np.where(denominator == 0, 1.0, denominator)
