"""What holds a garment up: waistbands where it does not hang from the shoulders, and the neckline of a cape."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from eslr_jax.fit.postures import body_middle, shoulder_height
from eslr_jax.geometry.topology import boundary_loops, vertex_components
from eslr_jax.types import Body

_OPEN = np.deg2rad(150.0)  # a gap in the cloth around the neck, from which on it slips off the shoulders
WAISTBAND = 0.03  # [m] width of the band below the loop that is held, as an elastic waistband
_CROTCH = 0.45  # of the body's height: a loop below it goes around legs
_PART_SHARE = 0.02  # of the vertices; a smaller part is a button or a label


@dataclasses.dataclass(frozen=True)
class Waist:
    """What holds a garment up."""

    is_held: Bool[np.ndarray, " vertices"]  # vertices of waistbands and open necklines
    reason: str  # why they are held, or why nothing is
    is_falling: bool  # a part hangs neither from the shoulders nor from a waistband


def find_waist(
    positions: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"], body: Body
) -> Waist:
    """Find what holds up the parts of a garment.

    A part that reaches above the shoulder joints hangs from them, unless it leaves more than 150 degrees around
    the neck open, as a cape does: its upper 3 cm are then held, as by a clasp. The others have a waistband: their
    highest boundary loop around the trunk, and the cloth up to 3 cm from it.

    Args:
        positions: Vertex positions in the body's rest pose [m], shape [vertices, 3].
        faces: Triangles, shape [faces, 3].
        body: The body in its rest pose.
    """
    shoulders = shoulder_height(body)
    count, component = vertex_components(faces, len(positions))
    loops = [loop for loop in boundary_loops(faces) if _is_around_trunk(positions[loop], body)]
    is_held, falling, is_open, heights = np.zeros(len(positions), bool), False, False, []
    for part in range(count):
        own = np.flatnonzero(component == part)
        top = positions[own, 1].max()
        if len(own) < _PART_SHARE * len(positions):
            continue
        if top > shoulders:
            if _gap_around_neck(positions[own[positions[own, 1] > shoulders]], body) > _OPEN:
                is_held[own[positions[own, 1] > top - WAISTBAND]] = is_open = True
            continue
        around = [loop for loop in loops if component[loop[0]] == part]
        if not around:
            falling = True
            continue
        loop = max(around, key=lambda ring: positions[ring, 1].mean())
        gaps, _ = KDTree(positions[loop]).query(positions[own])
        is_held[own[gaps <= WAISTBAND]] = True
        heights.append(float(positions[loop, 1].mean()) - float(np.asarray(body.rest_positions)[:, 1].min()))
    if heights:
        places = " and ".join(f"{height:.2f} m" for height in heights)
        reason = f"waistband at {places} above the floor, since no cloth reaches above the shoulder joints"
    elif is_open:
        reason = "neckline, since the cloth on the shoulders is open around the neck"
    elif falling:
        reason = "no cloth reaches above the shoulder joints, and no open edge goes around the trunk"
    else:
        reason = "it hangs from the shoulders"
    return Waist(is_held, reason, falling)


def _gap_around_neck(points: np.ndarray, body: Body) -> float:
    """Return the largest angle around the neck that no point covers [rad]."""
    center = _trunk_center(body, shoulder_height(body))
    angle = np.sort(np.arctan2(*(points[:, [0, 2]] - center).T))
    return float(np.diff(np.append(angle, angle[0] + 2 * np.pi)).max())


def _trunk_center(body: Body, height: float) -> np.ndarray:
    """Return x and z of the middle of the trunk at a height [m]."""
    rest, middle = np.asarray(body.rest_positions, np.float64), body_middle(body)
    is_inner = np.abs(rest[:, 0] - middle[0]) < 0.1 * np.ptp(rest[:, 1])
    near = rest[(np.abs(rest[:, 1] - height) < 0.03) & is_inner]
    return near[:, [0, 2]].mean(axis=0) if len(near) else middle[[0, 2]]


def _is_around_trunk(ring: np.ndarray, body: Body) -> bool:
    """Tell whether a closed curve winds around the middle of the body above the crotch."""
    rest = np.asarray(body.rest_positions, np.float64)
    height, low = ring[:, 1].mean(), rest[:, 1].min()
    if height < low + _CROTCH * np.ptp(rest[:, 1]):
        return False
    angle = np.arctan2(*(ring[:, [0, 2]] - _trunk_center(body, height)).T)
    turns = np.diff(np.append(angle, angle[0]))
    return abs(np.sum((turns + np.pi) % (2 * np.pi) - np.pi)) > np.pi
