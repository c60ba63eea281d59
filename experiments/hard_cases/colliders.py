"""Solids whose signed distance is known in closed form, in float64; penetration is measured against them.

All are convex, so the signed distance (positive outside) is a convex function of the point.
"""

from __future__ import annotations

import dataclasses
from typing import Protocol

import numpy as np
from jaxtyping import Float

_GRID = 8  # intervals per side of a triangle's barycentric samples
_ROUNDS = 16  # of refinement; every round halves the triangle of samples around the best one


class Collider(Protocol):
    """A solid with a known signed distance."""

    def distance(self, points: Float[np.ndarray, "*points 3"]) -> Float[np.ndarray, " *points"]:
        """Return signed distances [m] of points [m], positive outside."""
        ...


@dataclasses.dataclass(frozen=True)
class Sphere:
    """A ball."""

    center: np.ndarray  # [m], shape [3]
    radius: float  # [m]

    def distance(self, points: Float[np.ndarray, "*points 3"]) -> Float[np.ndarray, " *points"]:
        """Return signed distances [m]: |x - c| - r."""
        return np.linalg.norm(np.asarray(points, np.float64) - self.center, axis=-1) - self.radius


@dataclasses.dataclass(frozen=True)
class Capsule:
    """All points within a radius of a segment."""

    start: np.ndarray  # [m], shape [3]
    end: np.ndarray  # [m], shape [3]
    radius: float  # [m]

    def distance(self, points: Float[np.ndarray, "*points 3"]) -> Float[np.ndarray, " *points"]:
        """Return signed distances [m]: the distance to the segment minus the radius."""
        axis = np.asarray(self.end, np.float64) - self.start
        offset = np.asarray(points, np.float64) - self.start
        share = np.clip(offset @ axis / float(axis @ axis), 0.0, 1.0)
        return np.linalg.norm(offset - share[..., None] * axis, axis=-1) - self.radius


@dataclasses.dataclass(frozen=True)
class Plane:
    """A half-space."""

    point: np.ndarray  # on the surface [m], shape [3]
    normal: np.ndarray  # outward unit normal, shape [3]

    def distance(self, points: Float[np.ndarray, "*points 3"]) -> Float[np.ndarray, " *points"]:
        """Return signed distances [m]: n . (x - p)."""
        return (np.asarray(points, np.float64) - self.point) @ np.asarray(self.normal, np.float64)


@dataclasses.dataclass(frozen=True)
class RoundedCone:
    """All points within a radius of a solid cone, cut off at its base: a needle with a round tip."""

    apex: np.ndarray  # of the inner cone, the centre of the tip's sphere [m], shape [3]
    axis: np.ndarray  # unit vector from the tip into the cone, shape [3]
    half_angle: float  # [rad]
    radius: float  # of the tip [m]
    length: float = np.inf  # from the apex to the base [m]

    def distance(self, points: Float[np.ndarray, "*points 3"]) -> Float[np.ndarray, " *points"]:
        """Return signed distances [m]; beyond the base those from its plane, if they are larger.

        With s along the axis and r across it, the flank is r cos(a) - s sin(a) away. The apex is nearest where
        r sin(a) + s cos(a) < 0.
        """
        offset = np.asarray(points, np.float64) - self.apex
        along = offset @ np.asarray(self.axis, np.float64)
        across = np.linalg.norm(offset - along[..., None] * self.axis, axis=-1)
        sine, cosine = np.sin(self.half_angle), np.cos(self.half_angle)
        is_before_apex = across * sine + along * cosine < 0
        flank = across * cosine - along * sine
        cone = np.where(is_before_apex, np.linalg.norm(offset, axis=-1), flank) - self.radius
        return np.maximum(cone, along - self.length)


def triangle_distances(
    collider: Collider, corners: Float[np.ndarray, "faces 3 3"]
) -> Float[np.ndarray, " faces"]:
    """Return the least signed distance over every triangle to a convex solid [m], to about 1e-4 of its size.

    Every round samples a smaller triangle around the best point so far. That can't end in the wrong place,
    because the distance to a convex solid has one minimum.
    """
    corners = np.asarray(corners, np.float64)
    weights = _barycentric_grid(_GRID)  # [samples, 3]
    center = np.full((len(corners), 3), 1.0 / 3.0)  # barycentric
    scale, best = 1.0, np.min(collider.distance(corners), axis=1)
    for _ in range(_ROUNDS):
        trial = center[:, None] + scale * (weights - 1.0 / 3.0)
        trial = np.maximum(trial, 0.0)
        trial = trial / trial.sum(axis=-1, keepdims=True)
        distance = collider.distance(np.einsum("fsk,fkx->fsx", trial, corners))
        pick = np.argmin(distance, axis=1)
        center = trial[np.arange(len(corners)), pick]
        best = np.minimum(best, distance[np.arange(len(corners)), pick])
        scale *= 0.5
    return best


def _barycentric_grid(count: int) -> np.ndarray:
    """Return regular barycentric coordinates with `count` intervals per side, shape [samples, 3]."""
    i, j = np.meshgrid(np.arange(count + 1), np.arange(count + 1), indexing="ij")
    keep = i + j <= count
    return np.stack([i[keep], j[keep], count - i[keep] - j[keep]], axis=-1) / count
