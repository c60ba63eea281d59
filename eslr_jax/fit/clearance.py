"""Find where a garment lies inside the body, and take it out."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from eslr_jax.fit.postures import Posture
from eslr_jax.geometry.closest import closest_points
from eslr_jax.geometry.skinning import smooth

CLEARANCE = 3e-3  # [m] left between cloth and skin: a millimetre over the thickness of collisions
MAX_DEPTH = 0.06  # [m] that a vertex is taken out from; deeper ones are in another limb
_MARGIN = 0.15  # [m] within which distances are exact
_ROUNDS = 12
_SPREAD = 3  # smoothings that let the neighbours of a moved vertex follow


def body_heights(
    points: Float[np.ndarray, "points 3"], posture: Posture
) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, "points 3"]]:
    """Return the exact signed distance of points to the touchable skin [m], and the skin's outward normals.

    The sign is that of the interpolated vertex normal at the closest point. Beyond `_MARGIN` distances are those
    to the nearest vertex, and normals zero.
    """
    heights = posture.heights(points)
    normals = np.zeros_like(points)
    close = np.abs(heights) < _MARGIN
    if close.any():
        heights[close], normals[close] = _exact_heights(points[close], posture)
    return heights, normals


def _exact_heights(points: np.ndarray, posture: Posture) -> tuple[np.ndarray, np.ndarray]:
    """Return what `body_heights` does, for points within its margin."""
    faces = posture.faces[posture.is_obstacle]
    low, high = points.min(axis=0) - _MARGIN, points.max(axis=0) + _MARGIN
    centers = posture.positions[faces].mean(axis=1)
    near = ((centers > low) & (centers < high)).all(axis=1)
    faces = faces[near] if near.any() else faces
    nearest, barycentric = closest_points(points, posture.positions, faces)
    corners = faces[nearest]
    offset = points - np.einsum("pc,pcx->px", barycentric, posture.positions[corners])
    normals = np.einsum("pc,pcx->px", barycentric, posture.normals[corners])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    distance = np.linalg.norm(offset, axis=1)
    return np.where(np.einsum("px,px->p", offset, normals) < 0, -distance, distance), normals


def penetration(heights: Float[np.ndarray, " points"]) -> dict[str, float]:
    """Return how many points are inside and how deep, for a report."""
    depth = np.maximum(-heights[heights > -MAX_DEPTH], 0.0)
    return {"inside": int(np.sum(depth > 0)), "depth_max_mm": round(float(depth.max(initial=0.0)) * 1e3, 3)}


def push_out(
    positions: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    posture: Posture,
    *,
    clearance: float = CLEARANCE,
) -> tuple[Float[np.ndarray, "vertices 3"], dict[str, dict[str, float]]]:
    """Move vertices that are inside the body, or nearer than `clearance`, out along the skin's normal.

    Their neighbours follow, so that no dents stay.

    Args:
        positions: Garment vertices in the posture's pose [m].
        faces: Garment triangles.
        posture: The body.
        clearance: Distance to keep from the skin [m].

    Returns:
        Positions [m], and the penetration before and after and how far vertices moved.
    """
    result = positions.copy()
    heights, normals = body_heights(result, posture)
    before = penetration(heights)
    active = np.flatnonzero(np.abs(heights) < MAX_DEPTH)
    for _ in range(_ROUNDS):
        lift = np.zeros(len(result))
        lift[active] = np.maximum(clearance - heights[active], 0.0)
        lift[heights < -MAX_DEPTH] = 0.0
        if lift.max(initial=0.0) < 1e-5:
            break
        move = lift[:, None] * normals
        follow = smooth(move, faces, _SPREAD)
        result += np.where(lift[:, None] > 0, move, follow)
        heights = heights.copy()
        heights[active], normals[active] = body_heights(result[active], posture)
    after = penetration(heights)
    moved = np.linalg.norm(result - positions, axis=1)
    report = {
        "moved": int(np.sum(moved > 1e-4)),
        "moved_max_mm": round(float(moved.max(initial=0.0)) * 1e3, 3),
    }
    return result, {"before": before, "after": after, "push_out": report}
