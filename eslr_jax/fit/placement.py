"""Recognise a garment's unit, axes, place and pose by how well it wraps the body."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
from jaxtyping import Float, Int

from eslr_jax.errors import MeshError
from eslr_jax.fit.options import Axis, Unit
from eslr_jax.fit.postures import Posture
from eslr_jax.geometry.topology import face_areas, vertex_areas

UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254}  # metres per unit
_MIN_DIAGONAL, _MAX_DIAGONAL = 0.2, 3.0  # [m] of a garment's bounding box, from a scarf to a long coat
_SAMPLES = 160  # garment points whose distances are looked at
_INSIDE, _MAX_INSIDE = 0.01, 0.06  # [m] of depth that costs one, and beyond which nothing more is learnt
_OUTSIDE, _MAX_OUTSIDE = 0.05, 0.10  # [m] likewise outside, where cloth may hang loose
_SLIDE_STEP = 0.04  # [m] between tried heights
_MISFIT = 1.7  # mean cost above which nothing was recognised; 2 is a garment in the air, a wide dress has 1.4
# What is usual costs less: factors on the mean cost.
_FEET, _SLID = 1.1, 1.25  # origin on the floor between the feet; origin anywhere
_TURNED = 1.3  # facing elsewhere than its up axis makes usual
_RAISED = 1.05  # arms at another angle than the body's
_INCHES = 1.1
_SMALL, _SMALL_SHARE = 1.5, 0.35  # bounding box less than this share of the body's height: a shirt on a head
_GOOD = (
    1.5  # mean cost of a known place beyond which the garment is moved along the body to look for a better
)
_LIMBS_INSIDE = 0.03  # share of points deep inside the body, likewise: a limb pierces a garment out of place
_VECTORS = {
    "x": (1, 0, 0),
    "y": (0, 1, 0),
    "z": (0, 0, 1),
    "-x": (-1, 0, 0),
    "-y": (0, -1, 0),
    "-z": (0, 0, -1),
}
_USUAL_FRONT = {"y": "z", "z": "-y", "x": "y", "-y": "z", "-z": "-y", "-x": "y"}


@dataclasses.dataclass(frozen=True)
class Placement:
    """How a file's coordinates become metres in the body's frame: x = factor rotation p + translation."""

    factor: float  # [m] per unit of the file
    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, " 3"]  # [m]
    posture: int  # index of the posture that the garment was modelled on
    up: str
    front: str
    cost: float  # mean over points; 0 is skin-tight, 1 is 5 cm away or 1 cm deep

    def apply(self, positions: Float[np.ndarray, "vertices 3"]) -> Float[np.ndarray, "vertices 3"]:
        """Return positions in the body's frame [m]."""
        return self.factor * positions @ self.rotation.T + self.translation


def find_placement(
    positions: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    postures: list[Posture],
    *,
    units: Unit | float = "auto",
    up: Axis = "auto",
    front: Axis = "auto",
    keep_place: bool = False,
    name: str = "garment",
) -> Placement:
    """Return the unit, axes, place and posture in which a garment wraps the body best.

    Every combination of what was not given is tried on a sample of points. A point costs more the farther
    from the body it is, and much more inside it. What is usual (the body's own frame; Y up facing Z, or Z up
    facing -Y) wins unless something else is clearly better.

    Args:
        positions: Vertices as the file has them.
        faces: Triangles of a welded mesh.
        postures: The body in the poses that the garment may have been modelled on; the rest pose first.
        units: Unit of the file, or metres per unit.
        up: The file's axis that points up.
        front: The file's axis that the wearer faces.
        keep_place: Do not move the garment; its origin is the body's.
        name: What messages call the garment.

    Raises:
        MeshError: The size is no garment's in any unit, the axes contradict each other, or nothing fits.
    """
    factors = _factors(positions, postures[0], units, name)
    sample = _sample(positions, faces)
    tried = []
    for factor, (rotation, axes, is_usual) in itertools.product(factors, _rotations(up, front)):
        turned = factor * sample @ rotation.T
        base = factors[factor] * (1.0 if is_usual else _TURNED)
        for k, posture in enumerate(postures):
            weight = base * (1.0 if k == 0 else _RAISED)
            for offset, extra in _known_places(posture, keep_place):
                cost = weight * extra * _cost(posture.heights(turned + offset))
                tried.append((cost, Placement(factor, rotation, offset, k, *axes, cost)))
    best = min(tried, key=lambda item: item[0])[1]
    deep = float(np.mean(postures[best.posture].heights(best.apply(sample)) < -_INSIDE))
    if not keep_place and (best.cost > _GOOD or deep > _LIMBS_INSIDE):
        best = min([best, *_slide(sample, tried, factors, postures)], key=lambda placement: placement.cost)
    misfit = _cost(postures[best.posture].heights(best.apply(sample)))
    if misfit > _MISFIT:
        raise MeshError(
            f"{name}: does not fit the body in any unit, axis or place (the best is off by {misfit:.1f} of "
            f"{_MISFIT}); give --units, --up and --front, or move it onto the body and give --keep-place"
        )
    return best


def _known_places(posture: Posture, keep_place: bool) -> list[tuple[np.ndarray, float]]:
    """Return the body's own origin, and the floor between its feet, with the factors of their costs."""
    places = [(np.zeros(3), 1.0)]
    if not keep_place:
        places.append((np.array([0.0, posture.positions[:, 1].min(), 0.0]), _FEET))
    return places


def _slide(
    sample: np.ndarray,
    tried: list[tuple[float, Placement]],
    factors: dict[float, float],
    postures: list[Posture],
) -> list[Placement]:
    """Move the garment along the body, for each orientation in the two extreme postures; refine the best."""
    orientations = {(p.factor, p.up, p.front): p for _, p in tried}
    angles = [90.0 if posture.arm_angle is None else posture.arm_angle for posture in postures]
    found = []
    for start in orientations.values():
        turned = start.factor * sample @ start.rotation.T
        low, high = turned.min(axis=0), turned.max(axis=0)
        weight = _SLID * factors[start.factor] * _turned(start)
        for k in {0, int(np.argmin(angles))}:
            posture = postures[k]
            floor, top = posture.positions[:, 1].min(), posture.positions[:, 1].max()
            for height in np.arange(floor - low[1], top - high[1] + _SLIDE_STEP, _SLIDE_STEP):
                offset = np.array([-0.5 * (low[0] + high[0]), height, -0.5 * (low[2] + high[2])])
                offset[2] += _depth_at(posture, low[1] + height, high[1] + height)
                cost = weight * _cost(posture.heights(turned + offset))
                found.append(dataclasses.replace(start, translation=offset, posture=k, cost=cost))
    refined = []
    for start in sorted(found, key=lambda placement: placement.cost)[:3]:
        turned = start.factor * sample @ start.rotation.T
        weight = _SLID * factors[start.factor] * _turned(start)
        for k, posture in enumerate(postures):
            offset = _settle(turned, start.translation, posture)
            cost = weight * (1.0 if k == 0 else _RAISED) * _cost(posture.heights(turned + offset))
            refined.append(dataclasses.replace(start, translation=offset, posture=k, cost=cost))
    return refined


def _turned(placement: Placement) -> float:
    """Return what facing an unusual way costs."""
    return 1.0 if _USUAL_FRONT[placement.up] == placement.front else _TURNED


def _depth_at(posture: Posture, low: float, high: float) -> float:
    """Return the middle of the body from back to front between two heights [m]."""
    points = posture.positions[posture.touchable]
    here = points[(points[:, 1] > low) & (points[:, 1] < high) & (np.abs(points[:, 0]) < 0.2)]
    return 0.5 * float(here[:, 2].min() + here[:, 2].max()) if len(here) else 0.0


def _settle(points: np.ndarray, offset: np.ndarray, posture: Posture) -> np.ndarray:
    """Move points as one so that they lie neither inside nor far from the body: damped least squares."""
    for _ in range(12):
        placed = points + offset
        distance, nearest = posture.tree.query(placed)
        vertex = posture.touchable[nearest]
        normals = posture.normals[vertex]
        height = np.einsum("px,px->p", placed - posture.positions[vertex], normals)
        weight = np.where(height < 0, 1.0, 0.1) * (distance < _MAX_OUTSIDE)
        wanted = np.clip(height, 0.005, 0.03) - height
        matrix = np.einsum("p,px,py->xy", weight, normals, normals) + 0.02 * len(points) * np.eye(3)
        offset = offset + np.linalg.solve(matrix, np.einsum("p,p,px->x", weight, wanted, normals))
    return offset


def _cost(heights: np.ndarray) -> float:
    """Return the mean cost of points at these heights over the body."""
    inside = np.minimum(-heights, _MAX_INSIDE) / _INSIDE
    outside = np.minimum(heights, _MAX_OUTSIDE) / _OUTSIDE
    return float(np.mean(np.where(heights < 0, inside, outside)))


def _sample(positions: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Pick points evenly over the area, always the same ones, and the extremes."""
    areas = vertex_areas(face_areas(positions, faces), faces, len(positions))
    steps = np.cumsum(areas) / areas.sum()
    picked = np.searchsorted(steps, (np.arange(_SAMPLES) + 0.5) / _SAMPLES)
    extremes = np.concatenate([positions.argmin(axis=0), positions.argmax(axis=0)])
    return positions[np.unique(np.concatenate([np.minimum(picked, len(positions) - 1), extremes]))]


def _factors(positions: np.ndarray, body: Posture, units: Unit | float, name: str) -> dict[float, float]:
    """Return the metres per unit to try, each with the factor on its costs."""
    diagonal = float(np.linalg.norm(np.ptp(positions, axis=0)))
    if units != "auto":
        factor = UNITS[units] if isinstance(units, str) else float(units)
        if not factor > 0 or not np.isfinite(factor):
            raise MeshError(f"{name}: {units} metres per unit; give a positive number")
        return {factor: 1.0}
    factors = [factor for factor in UNITS.values() if _MIN_DIAGONAL <= diagonal * factor <= _MAX_DIAGONAL]
    if not factors:
        raise MeshError(
            f"{name}: bounding-box diagonal {diagonal:.4g} is no garment's in {', '.join(UNITS)}; scale it, or "
            "give the metres per unit"
        )
    small = _SMALL_SHARE * float(np.ptp(body.positions[:, 1]))
    return {
        factor: (_INCHES if factor == UNITS["in"] else 1.0) * (_SMALL if diagonal * factor < small else 1.0)
        for factor in factors
    }


def _rotations(up: Axis, front: Axis) -> list[tuple[np.ndarray, tuple[str, str], bool]]:
    """Return rotations of file axes onto (left, up, front) = (x, y, z), with the axes and whether usual."""
    result = []
    for vertical in ("y", "z") if up == "auto" else (up,):
        for facing in _VECTORS if front == "auto" else (front,):
            if facing[-1] == vertical[-1]:
                continue
            y, z = np.array(_VECTORS[vertical], float), np.array(_VECTORS[facing], float)
            rotation = np.stack([np.cross(y, z), y, z])
            result.append((rotation, (vertical, facing), _USUAL_FRONT[vertical] == facing or front != "auto"))
    if not result:
        raise MeshError(f"up {up} and front {front} are the same axis; give two different ones")
    return result
