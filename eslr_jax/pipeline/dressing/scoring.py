"""How badly a placed garment fits the body: distances, and whether it is worn."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

from eslr_jax.mesh.topology import boundary_loops, face_areas, vertex_areas
from eslr_jax.numerics import pierces
from eslr_jax.pipeline.dressing.postures import Posture
from eslr_jax.pipeline.formats.mesh import Faces, Positions

_POINTS = 160  # garment points whose distances are measured
_TOP_POINTS = 16  # the highest of them, by which a garment hangs
_INSIDE, _MAX_INSIDE = 0.01, 0.06  # [m] of depth that costs one, and beyond which the cost stays
_OUTSIDE, _MAX_OUTSIDE = 0.05, 0.10  # [m] likewise outside, where cloth may hang loose
_SUPPORT = 0.4  # weight of the distance at the top
_BELOW_FLOOR = 4.0  # cost of a garment under the floor
_PIERCED = 0.4  # cost of a limb that pierces the cloth
_ARMHOLE = 0.35  # of a limb, that may pierce it
_EMPTY = 0.6  # cost of a garment through none of whose openings a bone passes
# Cost of a garment that slips; [m] it is let down; inside cost that holds.
_SLIPS, _DROP, _HELD = 0.4, 0.04, 0.07
_COARSE_FACES = 4000  # beyond which bones are tested against a coarser mesh
DEEP = 0.01  # [m] of depth from which a point is called deep inside


@dataclasses.dataclass(frozen=True)
class Sample:
    """Points of a garment in the file's coordinates, spread evenly over its area, and coarse triangles."""

    points: Float[np.ndarray, "points 3"]
    cloth: Float[np.ndarray, "triangles 3 3"]
    openings: Float[np.ndarray, "fans 3 3"]  # that close the boundary loops; none for a sheet's one outline


def sample_garment(positions: Positions, faces: Faces) -> Sample:
    """Return a sample of a garment; equal garments give equal samples."""
    areas = vertex_areas(face_areas(positions, faces), faces, len(positions))
    picked = np.searchsorted(np.cumsum(areas) / areas.sum(), (np.arange(_POINTS) + 0.5) / _POINTS)
    extremes = np.concatenate([positions.argmin(axis=0), positions.argmax(axis=0)])
    points = np.unique(np.concatenate([np.minimum(picked, len(positions) - 1), extremes]))
    fans = [np.empty((0, 3, 3))]
    loops = boundary_loops(faces)
    for loop in map(positions.__getitem__, loops if len(loops) > 1 else []):
        center = np.broadcast_to(loop.mean(axis=0), loop.shape)
        fans.append(np.stack([loop, np.roll(loop, -1, axis=0), center], axis=1))
    sampled = positions[points]
    if len(faces) > _COARSE_FACES:  # vertices are merged by cells of a grid
        size = 1.5 * np.sqrt(face_areas(positions, faces).sum() / _COARSE_FACES)
        cells = np.floor((positions - positions.min(axis=0)) / size).astype(np.int64)
        _, cell, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
        cell = cell.ravel()
        sums = [np.bincount(cell, positions[:, axis]) for axis in range(3)]
        positions, faces = np.stack(sums, axis=1) / counts[:, None], cell[faces]
        faces = faces[(faces != faces[:, [1, 2, 0]]).all(axis=1)]
    return Sample(sampled, positions[faces], np.concatenate(fans))


def fit_cost(points: Float[np.ndarray, "points 3"], posture: Posture) -> float:
    """Return the cost of placed points [m]; 0 is skin-tight, 1 is 5 cm outside or 1 cm inside on average.

    A garment hangs by its highest points, so these should be near the body. No garment is under the floor.
    """
    heights = posture.heights(points)
    misfit = np.mean(_inside(heights) + np.clip(heights, 0.0, _MAX_OUTSIDE) / _OUTSIDE)
    top = np.argsort(-points[:, 1], kind="stable")[:_TOP_POINTS]
    support = np.mean(np.minimum(np.abs(heights[top]), _MAX_OUTSIDE)) / _OUTSIDE
    below = np.mean(points[:, 1] < posture.floor - _OUTSIDE)
    return float(misfit + _SUPPORT * support + _BELOW_FLOOR * below)


def count_pierced(
    sample: Sample, bones: Float[np.ndarray, "bones 2 3"], is_limb: Bool[np.ndarray, " bones"]
) -> int:
    """Return how many limbs pierce the cloth, given bones in the file's coordinates.

    The start of a limb does not count: it lies beside the edge of an armhole.
    """
    limbs = bones[is_limb]
    return int(np.sum(_crosses(limbs + _ARMHOLE * (limbs[:, ::-1] - limbs) * [[1], [0]], sample.cloth)))


def wearing_cost(
    sample: Sample,
    points: Float[np.ndarray, "points 3"],
    bones: Float[np.ndarray, "bones 2 3"],
    posture: Posture,
) -> float:
    """Return the cost of a garment that is not worn: pierced by limbs, around no bone, or slipping down.

    Its points are given as placed on the posture [m], and the posture's bones in the file's coordinates.
    """
    pierced = count_pierced(sample, bones, posture.is_limb)
    is_empty = len(sample.openings) > 0 and not _crosses(bones, sample.openings).any()
    now, lower = (_inside(posture.heights(points - [0.0, drop, 0.0])).mean() for drop in (0.0, _DROP))
    slips = 1.0 - np.clip((lower - now) / _HELD, 0.0, 1.0)
    return float(_PIERCED * pierced + _EMPTY * is_empty + _SLIPS * slips)


def _crosses(segments: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return which segments, [segments, 2, 3], pierce a triangle."""
    is_left = triangles.max(axis=1) < segments.min(axis=1)[:, None]
    is_right = triangles.min(axis=1) > segments.max(axis=1)[:, None]
    segment, triangle = np.nonzero(~(is_left | is_right).any(axis=2))
    start, end = segments[segment].transpose(1, 2, 0)
    corners = triangles[triangle].transpose(1, 2, 0)
    hits = pierces(tuple(start), tuple(end), [tuple(corner) for corner in corners])
    return np.isin(np.arange(len(segments)), segment[hits])


def _inside(heights: np.ndarray) -> np.ndarray:
    """Return the cost of every point's depth."""
    return np.clip(-heights, 0.0, _MAX_INSIDE) / _INSIDE
