"""Where a garment lies inside the body, its way out, and from a posed body to the resting one."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from eslr_jax.mesh.closest import nearest_places
from eslr_jax.mesh.skinning import smooth, transfer_skin_weights
from eslr_jax.pipeline.dressing.postures import Posture, blend, rest_posture
from eslr_jax.pipeline.formats.mesh import Faces, Positions
from eslr_jax.types import Body

CLEARANCE = 3e-3  # [m] left between cloth and skin: a millimetre over the thickness of collisions
MAX_DEPTH = 0.06  # [m] from which a vertex is moved out; deeper ones are in another limb
_MARGIN = 0.15  # [m] within which distances are exact
_ROUNDS = 12
_SPREAD = 3  # smoothings that let the neighbours of a moved vertex follow
_SMOOTHING = 3  # Laplacian steps over transferred skin weights, as for the bundled shirts
_LOOSE_SMOOTHING = 20  # for skirts, or the two legs tear them, as for the bundled dresses
_LOOSE = 0.05  # [m] from the body; a garment is loose if a tenth of its vertices are farther away


def body_heights(
    points: Float[np.ndarray, "points 3"], posture: Posture
) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, "points 3"]]:
    """Return the signed distance of points to the touchable skin [m], and the skin's outward normals there.

    The sign comes from the interpolated vertex normal at the closest point. Beyond 15 cm, distances are to the
    nearest vertex and normals are zero.
    """
    heights, normals = posture.heights(points), np.zeros_like(points)
    is_close = np.abs(heights) < _MARGIN
    if is_close.any():
        close, faces = points[is_close], posture.faces[posture.is_obstacle]
        centers = posture.positions[faces].mean(axis=1)
        is_near = (centers > close.min(axis=0) - _MARGIN) & (centers < close.max(axis=0) + _MARGIN)
        near = is_near.all(axis=1)
        faces = faces[near] if near.any() else faces
        place = nearest_places(close, posture.positions, faces, posture.normals)
        distance = np.linalg.norm(place.offsets, axis=1)
        is_inside = np.einsum("px,px->p", place.offsets, place.normals) < 0
        heights[is_close], normals[is_close] = np.where(is_inside, -distance, distance), place.normals
    return heights, normals


def push_out(
    positions: Positions, faces: Faces, posture: Posture
) -> tuple[Positions, dict[str, dict[str, float]]]:
    """Return vertices, those in a posed body or closer than 3 mm moved out along its normals, and a report.

    Their neighbours follow, so that no dents stay. Vertices deeper than 6 cm stay, and are counted apart.
    """
    result = positions.copy()
    heights, normals = body_heights(result, posture)
    before = _penetration(heights)
    active = np.flatnonzero(np.abs(heights) < MAX_DEPTH)
    for _ in range(_ROUNDS):
        lift = np.zeros(len(result))
        lift[active] = np.maximum(CLEARANCE - heights[active], 0.0)
        lift[heights < -MAX_DEPTH] = 0.0
        if lift.max(initial=0.0) < 1e-5:
            break
        move = lift[:, None] * normals
        result += np.where(lift[:, None] > 0, move, smooth(move, faces, _SPREAD))
        heights[active], normals[active] = body_heights(result[active], posture)
    moved = np.linalg.norm(result - positions, axis=1)
    report = {"moved": int(np.sum(moved > 1e-4)), "moved_max_mm": _millimetres(moved)}
    return result, {"before": before, "after": _penetration(heights), "push_out": report}


def _penetration(heights: np.ndarray) -> dict[str, float]:
    """Return how many vertices are inside, how deep, and how many deeper than any that is moved."""
    is_deeper = heights <= -MAX_DEPTH
    depth = np.maximum(-heights[~is_deeper], 0.0)
    return {
        "inside": int(np.sum(depth > 0)),
        "depth_max_mm": _millimetres(depth),
        "deeper": int(np.sum(is_deeper)),
    }


def _millimetres(lengths: np.ndarray) -> float:
    return round(float(lengths.max(initial=0.0)) * 1e3, 3)


def lay_to_rest(
    placed: Positions, faces: Faces, posture: Posture, body: Body, *, is_pushed: bool = True
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Return a garment in the body's rest pose, given it on the body in another pose [m].

    That is the positions and skin weights of a `GarmentFile`, and what was inside the posed body; see `push_out`,
    which is done in both poses unless `is_pushed` is false.
    """
    clear, penetration = push_out(placed, faces, posture) if is_pushed else (placed, {})
    is_loose = np.quantile(posture.heights(clear), 0.9) > _LOOSE
    weights, indices = transfer_skin_weights(
        clear,
        posture.positions,
        posture.faces,
        np.asarray(body.skin_weights, np.float64),
        np.asarray(body.skin_indices),
        smoothing_steps=_LOOSE_SMOOTHING if is_loose else _SMOOTHING,
        faces=faces,
    )
    rest = clear
    if not np.array_equal(posture.transforms, np.broadcast_to(np.eye(3, 4), posture.transforms.shape)):
        # What blended maps take to the posed positions.
        blended = blend(weights, indices, posture.transforms)
        rest = np.linalg.solve(blended[:, :, :3], (clear - blended[:, :, 3])[:, :, None])[:, :, 0]
        rest = push_out(rest, faces, rest_posture(body))[0] if is_pushed else rest
    return {"rest_positions": rest, "skin_weights": weights, "skin_indices": indices}, penetration
