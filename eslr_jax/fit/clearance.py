"""Find where a garment lies inside the body, and move it out."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from eslr_jax.fit.postures import Posture
from eslr_jax.geometry.closest import nearest_places
from eslr_jax.geometry.skinning import smooth

CLEARANCE = 3e-3  # [m] left between cloth and skin: a millimetre over the thickness of collisions
MAX_DEPTH = 0.06  # [m] from which a vertex is moved out; deeper ones are in another limb
_MARGIN = 0.15  # [m] within which distances are exact
_ROUNDS = 12
_SPREAD = 3  # smoothings that let the neighbours of a moved vertex follow


def body_heights(
    points: Float[np.ndarray, "points 3"], posture: Posture
) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, "points 3"]]:
    """Return the signed distance of points to the touchable skin [m], and the skin's outward normals there.

    The sign comes from the interpolated vertex normal at the closest point. Beyond 15 cm, distances are to the
    nearest vertex and normals are zero.
    """
    heights = posture.heights(points)
    normals = np.zeros_like(points)
    close = np.abs(heights) < _MARGIN
    if close.any():
        heights[close], normals[close] = _exact_heights(points[close], posture)
    return heights, normals


def _exact_heights(points: np.ndarray, posture: Posture) -> tuple[np.ndarray, np.ndarray]:
    """Return signed distances and normals of points within `_MARGIN` of the skin; see `body_heights`."""
    faces = posture.faces[posture.is_obstacle]
    low, high = points.min(axis=0) - _MARGIN, points.max(axis=0) + _MARGIN
    centers = posture.positions[faces].mean(axis=1)
    near = ((centers > low) & (centers < high)).all(axis=1)
    faces = faces[near] if near.any() else faces
    _, _, offset, normals = nearest_places(points, posture.positions, faces, posture.normals)
    distance = np.linalg.norm(offset, axis=1)
    return np.where(np.einsum("px,px->p", offset, normals) < 0, -distance, distance), normals


def penetration(heights: Float[np.ndarray, " points"]) -> dict[str, float]:
    """Return the number of points inside the body and their largest depth, given signed distances [m].

    Points deeper than 6 cm are counted apart.
    """
    is_deeper = heights <= -MAX_DEPTH
    depth = np.maximum(-heights[~is_deeper], 0.0)
    return {
        "inside": int(np.sum(depth > 0)),
        "depth_max_mm": round(float(depth.max(initial=0.0)) * 1e3, 3),
        "deeper": int(np.sum(is_deeper)),
    }


def push_out(
    positions: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    posture: Posture,
) -> tuple[Float[np.ndarray, "vertices 3"], dict[str, dict[str, float]]]:
    """Move vertices that lie inside the body or closer than 3 mm out along the skin's normal.

    Their neighbours follow, so that no dents stay.

    Args:
        positions: Garment vertex positions in the posture's pose [m], shape [vertices, 3].
        faces: Triangles of the garment, shape [faces, 3].
        posture: The body in that pose.

    Returns:
        New positions [m], and a report of the penetration before and after and of the distances moved.
    """
    result = positions.copy()
    heights, normals = body_heights(result, posture)
    before = penetration(heights)
    active = np.flatnonzero(np.abs(heights) < MAX_DEPTH)
    for _ in range(_ROUNDS):
        lift = np.zeros(len(result))
        lift[active] = np.maximum(CLEARANCE - heights[active], 0.0)
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
