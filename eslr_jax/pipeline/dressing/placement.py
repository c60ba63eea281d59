"""Recognise a garment's unit, axes, place and posture by how well it wraps the body, and is worn on it."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
from jaxtyping import Float

from eslr_jax.errors import MeshError
from eslr_jax.mesh.topology import boundary_loops, face_areas, vertex_areas
from eslr_jax.mesh.validate import UNITS
from eslr_jax.numerics import pierces
from eslr_jax.pipeline.dressing.options import Axis, FitOptions, Unit
from eslr_jax.pipeline.dressing.postures import Posture
from eslr_jax.pipeline.formats.mesh import Faces, Positions

# Feet and decimetres have to be given: no garment's file was seen in them.
_TRIED_UNITS = ("m", "cm", "mm", "in")
_MIN_DIAGONAL, _MAX_DIAGONAL = 0.2, 3.0  # [m] of a garment's bounding box, from a scarf to a long coat
_SLIDE_STEP = 0.04  # [m] between tried heights
_SOLES = 0.02  # [m] by which soles may miss height 0 without taking along a garment that keeps its place
_NEAR, _MIN_NEAR = 0.06, 0.03  # [m]; share of points nearer than that to the body below which nothing fits
# What is usual costs less: factors on the cost of a fit.
_PLACES = {"floor": 1.0, "body": 1.05, "found": 1.3}
_TURNED = 1.6  # the front is not the one that usually goes with the up axis
_RAISED = 1.1  # arms at another angle than the body's
_INCHES = 1.1
_SMALL, _SMALL_SHARE = 2.5, 0.35  # bounding box less than this share of the body's height: a shirt on a head
_POOR = 3.0  # cost of a known place above which the garment is moved along the body to look for a better one
_LIMBS_INSIDE = 0.06  # share of points deep inside the body above which it is moved too
_RIVAL = 0.05  # [m] mean distance from which two placements are different
_COST_SPREAD = 0.1  # difference of costs that makes the better one 2.7 times as likely
DOUBTFUL = 0.9  # confidence below which a person should look
_CLOSE = _COST_SPREAD * np.log(DOUBTFUL / (1.0 - DOUBTFUL))  # a rival whose cost is nearer makes it so
_SCALES = np.arange(0.88, 1.121, 0.01)  # of the unit, tried to see whether it is another
_SCALE_TOLERANCE = 0.02  # deviation of the best scale from which it is told
_LARGER, _SMALLER = 0.15, 0.35  # share of the cost that it must save; a roomy garment fits better if smaller
_MOVED = 0.3  # cost that a place which was looked for may save against the origin at another scale
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
_VECTORS = {
    f"{sign}{axis}": np.array([float(axis == other) * (-1 if sign else 1) for other in "xyz"])
    for sign, axis in itertools.product(("", "-"), "xyz")
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
    origin: str  # of the file: "floor" (between the feet), "body" (the body's own) or "found" (elsewhere)
    cost: float  # of the fit, times that of what is unusual
    confidence: float = 1.0  # that no other placement is meant, 0 to 1
    warnings: tuple[str, ...] = ()

    def apply(self, positions: Float[np.ndarray, "*points 3"]) -> Float[np.ndarray, "*points 3"]:
        """Return positions in the body's frame [m]."""
        return self.factor * positions @ self.rotation.T + self.translation

    def bones(self, posture: Posture) -> Float[np.ndarray, "bones 2 3"]:
        """Return the bones of a posture in the file's coordinates."""
        return (posture.bones - self.translation) @ self.rotation / self.factor

    def describe(self) -> str:
        """Return the placement in a few words."""
        unit = next((name for name, factor in UNITS.items() if factor == self.factor), "")
        places = {"floor": "feet at the origin", "body": "the body's origin", "found": "moved along the body"}
        return (
            f"{self.factor:g} m per unit{f' ({unit})' * bool(unit)}, {self.up} up, {self.front} front, "
            f"{places[self.origin]}"
        )


def find_placement(
    positions: Positions,
    faces: Faces,
    postures: list[Posture],
    options: FitOptions | None = None,
    *,
    is_metric: bool = False,
    facing: Float[np.ndarray, " 3"] | None = None,
    name: str = "garment",
) -> Placement:
    """Return the unit, axes, place and posture in which a garment fits the body best.

    Every combination of what was not given is tried on a sample of points; see `fit_cost`. What is usual
    costs less: feet at the origin, Y up and facing Z, Z up and facing -Y, or the body's own axes. The confidence
    compares the best placement with the next best one that differs from it, and is less by the share of points
    deep inside the body. Postures are those that the garment may have been modelled on, the rest pose first.
    Options tell what is known of unit, axes and place. A file that `is_metric` has metres and Y up, unless others
    are given. The body faces +Z or the axis nearest to `facing`.

    Raises:
        MeshError: The size is no garment's in any unit, the axes contradict each other, or nothing fits. Where
            everything is given, nothing is refused.
    """
    options = options or FitOptions()
    units, up, front, keep_place = options.units, options.up, options.front, options.keep_place
    given = {"--units": units, "--up": up, "--front": front, "--keep-place": keep_place or "auto"}
    missing = [option for option, value in given.items() if value == "auto"]
    if is_metric:
        units, up = "m" if units == "auto" else units, "y" if up == "auto" else up
    factors = _factors(positions, postures[0], units, name)
    orientations = [
        Placement(factor, rotation, np.zeros(3), 0, *axes, "floor", weight * (1.0 if is_usual else _TURNED))
        for (factor, weight), (rotation, axes, is_usual) in itertools.product(
            factors.items(), _rotations(up, front, facing)
        )
    ]
    sample = sample_garment(positions, faces)
    known = []  # every orientation at the known origins, in every posture
    for start, (k, posture) in itertools.product(orientations, enumerate(postures)):
        # A garment that stays is not moved by the little that the soles of a body miss height 0.
        floors = [at for at in posture.stands if not keep_place or np.linalg.norm(at) > _SOLES]
        for at, origin in [*((at, "floor") for at in floors), (np.zeros(3), "body")]:
            known.append(_scored(start, sample, postures, posture=k, translation=at, origin=origin))
    best, rival = _choose(known, sample, postures)
    if not keep_place and _is_poor(best, sample, postures):
        best, rival = _choose([*known, *_slide(sample, orientations, postures)], sample, postures)
    is_given = keep_place and "auto" not in (units, up, front)
    heights = postures[best.posture].heights(best.apply(sample.points))
    near, deep = np.abs(heights) < _NEAR, float(np.mean(heights < -DEEP))
    if near.mean() < _MIN_NEAR and not is_given:
        prescribed = is_metric and not {"--units", "--up"}.isdisjoint(missing)
        rule = " (its format prescribes metres and y up, unless --units and --up say otherwise)" * prescribed
        raise MeshError(
            f"{name}: does not fit the body in any unit, axis or place that was tried{rule}; give eslr fit "
            f"{' and '.join(missing)}, or model it on the body of eslr assets --export body.obj"
        )
    margin = np.inf if rival is None else rival.cost - best.cost
    # A rival that is worse still does not make a garment right of which a part is inside the body.
    confidence = float((1.0 - deep) / (1.0 + np.exp(-margin / _COST_SPREAD)))
    warnings = []
    if confidence < DOUBTFUL:
        doubts = [f"{deep:.0%} of it is more than 1 cm inside the body"] * (1.0 - deep < DOUBTFUL)
        if rival is not None and margin < _CLOSE:
            doubts.append(f"{rival.describe()} fits almost as well")
        warnings.append(
            f"the place is doubtful (confidence {confidence:.0%}): {' and '.join(doubts)}; look at the picture, "
            "and give eslr fit --units, --up, --front or --keep-place, or the body that it was made for"
        )
    if pierced := count_pierced(sample, best, postures[best.posture]):
        warnings.append(
            f"{pierced} limbs of the body pierce the cloth: it was made for another body or pose; give eslr fit "
            "--made-for that body (for SMPL's garments a SMPL model)"
        )
    if near.mean() < _MIN_NEAR:
        warnings.append("the garment is not on the body, and stays there as asked; look at the picture")
    if units == "auto":
        warnings += _scale_warning(best, sample, postures)
    return dataclasses.replace(best, confidence=confidence, warnings=tuple(warnings))


def _scored(start: Placement, sample: Sample, postures: list[Posture], **changes) -> Placement:
    """Return a changed placement with its cost; `start.cost` is the factor of its orientation."""
    moved = dataclasses.replace(start, **changes)
    weight = start.cost * _PLACES[moved.origin] * (1.0 if moved.posture == 0 else _RAISED)
    return dataclasses.replace(
        moved, cost=weight * fit_cost(moved.apply(sample.points), postures[moved.posture])
    )


def _choose(
    candidates: list[Placement], sample: Sample, postures: list[Posture]
) -> tuple[Placement, Placement | None]:
    """Return the best candidate and its best rival, the cost of pierced bones included.

    That cost is expensive, so it is added in the order of the other costs until no candidate can be better.
    """
    done: list[Placement] = []
    rival = None
    for candidate in sorted(candidates, key=lambda placement: placement.cost):
        if rival is not None and candidate.cost > rival.cost:
            break
        extra = wearing_cost(sample, candidate, postures[candidate.posture])
        done.append(dataclasses.replace(candidate, cost=candidate.cost + extra))
        best = min(done, key=lambda placement: placement.cost)
        rivals = [other for other in done if _is_rival(best, other, sample)]
        rival = min(rivals, key=lambda placement: placement.cost, default=None)
    return min(done, key=lambda placement: placement.cost), rival


def _is_rival(best: Placement, other: Placement, sample: Sample) -> bool:
    """Tell whether another placement puts the garment elsewhere.

    If the garment fits with the body's feet at the file's origin, a place found by moving it, with the same
    unit and axes, is no rival.
    """
    key = (best.factor, best.up, best.front)
    if best.origin == "floor" and other.origin == "found" and key == (other.factor, other.up, other.front):
        return False
    apart = np.linalg.norm(best.apply(sample.points) - other.apply(sample.points), axis=1)
    return bool(apart.mean() > _RIVAL)


def _is_poor(best: Placement, sample: Sample, postures: list[Posture]) -> bool:
    """Tell whether a better place is worth looking for; limbs pierce a garment that is out of place."""
    posture = postures[best.posture]
    heights = posture.heights(best.apply(sample.points))
    is_off = np.mean(heights < -DEEP) > _LIMBS_INSIDE or np.mean(np.abs(heights) < _NEAR) < _MIN_NEAR
    return best.cost > _POOR or bool(is_off) or count_pierced(sample, best, posture) > 0


def _slide(sample: Sample, orientations: list[Placement], postures: list[Posture]) -> list[Placement]:
    """Move the garment along the body in the two extreme postures, and refine the best of each orientation."""
    angles = [90.0 if posture.arm_angle is None else posture.arm_angle for posture in postures]
    found = []
    for start in orientations:
        turned = start.apply(sample.points)
        low, high = turned.min(axis=0), turned.max(axis=0)
        tried = []
        for k in {0, int(np.argmin(angles))}:
            posture = postures[k]
            x, y, z = posture.positions[posture.touchable].T
            top = posture.positions[:, 1].max()
            for height in np.arange(posture.floor - low[1], top - high[1] + _SLIDE_STEP, _SLIDE_STEP):
                trunk = (y > low[1] + height) & (y < high[1] + height) & (abs(x - posture.root[0]) < 0.2)
                depth = 0.5 * (z[trunk].min() + z[trunk].max()) if trunk.any() else posture.root[2]
                offset = [posture.root[0], height, depth] - 0.5 * (low + high) * [1, 0, 1]
                tried.append(_scored(start, sample, postures, posture=k, translation=offset, origin="found"))
        found += [(start, best) for best in sorted(tried, key=lambda placement: placement.cost)[:2]]
    refined = []
    for start, best in sorted(found, key=lambda pair: pair[1].cost)[:4]:
        turned = start.apply(sample.points)
        for k, posture in enumerate(postures):
            offset = _settle(turned, best.translation, posture)
            refined.append(_scored(start, sample, postures, posture=k, translation=offset, origin="found"))
    return refined


def _settle(points: np.ndarray, offset: np.ndarray, posture: Posture) -> np.ndarray:
    """Move points as one until they lie neither inside nor far from the body: damped least squares."""
    for _ in range(12):
        distance, height, normals = posture.tangent_planes(points + offset)
        weight = np.where(height < 0, 1.0, 0.1) * (distance < 0.1)
        wanted = np.clip(height, 0.005, 0.03) - height
        matrix = np.einsum("p,px,py->xy", weight, normals, normals) + 0.02 * len(points) * np.eye(3)
        offset = offset + np.linalg.solve(matrix, np.einsum("p,p,px->x", weight, wanted, normals))
    return offset


def _scale_warning(best: Placement, sample: Sample, postures: list[Posture]) -> list[str]:
    """Warn if, a few percent larger or smaller, the garment fits clearly better, or fits without moving."""
    posture = postures[best.posture]
    here = fit_cost(best.apply(sample.points), posture)
    origins = [*posture.stands, np.zeros(3)] if best.origin == "found" else [best.translation]
    turned = best.factor * sample.points @ best.rotation.T
    for origin in origins:
        costs = np.array([fit_cost(scale * turned + origin, posture) for scale in _SCALES])
        scale = float(_SCALES[np.argmin(costs)])
        gain = -_MOVED if best.origin == "found" else (_LARGER if scale > 1.0 else _SMALLER) * here
        if abs(scale - 1.0) > _SCALE_TOLERANCE and costs.min() < here - gain:
            return [
                f"the unit is doubtful: {best.factor:g} m per unit was taken, {scale * best.factor:.3g} fits "
                f"{'without moving' if best.origin == 'found' else 'better'} "
                f"({1.0 / (scale * best.factor):.3g} units in a metre); give eslr fit --units"
            ]
    return []


def _factors(positions: np.ndarray, body: Posture, units: Unit | float, name: str) -> dict[float, float]:
    """Return the metres per unit to try, each with the factor on its costs."""
    if units != "auto":
        factor = UNITS[units] if isinstance(units, str) else float(units)
        if not factor > 0 or not np.isfinite(factor):
            raise MeshError(f"{name}: {units} metres per unit; give a positive number")
        return {factor: 1.0}
    diagonal = float(np.linalg.norm(np.ptp(positions, axis=0)))
    factors = [
        UNITS[unit] for unit in _TRIED_UNITS if _MIN_DIAGONAL <= diagonal * UNITS[unit] <= _MAX_DIAGONAL
    ]
    if not factors:
        raise MeshError(
            f"{name}: bounding-box diagonal {diagonal:.4g} is no garment's in {', '.join(_TRIED_UNITS)}; scale "
            "it, or give eslr fit --units with the metres per unit"
        )
    small = _SMALL_SHARE * float(np.ptp(body.positions[:, 1]))
    return {
        factor: (_INCHES if factor == UNITS["in"] else 1.0) * (_SMALL if diagonal * factor < small else 1.0)
        for factor in factors
    }


def _rotations(
    up: Axis, front: Axis, facing: np.ndarray | None
) -> list[tuple[np.ndarray, tuple[str, str], bool]]:
    """Return rotations of file axes onto the body's, with the file's axes and whether they are usual."""
    x, _, z = (0.0, 0.0, 1.0) if facing is None else facing
    x, z = (0.0, np.sign(z)) if abs(z) >= abs(x) else (np.sign(x), 0.0)
    heading = np.array([[z, 0.0, x], [0.0, 1.0, 0.0], [-x, 0.0, z]])  # the quarter turn from +Z
    result = []
    for vertical in ("y", "z") if up == "auto" else (up,):
        for ahead in _VECTORS if front == "auto" else (front,):
            if ahead[-1] == vertical[-1]:
                continue
            y, z = _VECTORS[vertical], _VECTORS[ahead]
            rotation = heading @ np.stack([np.cross(y, z), y, z])
            is_usual = _USUAL_FRONT[vertical] == ahead or np.array_equal(rotation, np.eye(3))
            result.append((rotation, (vertical, ahead), is_usual or front != "auto"))
    if not result:
        raise MeshError(f"up {up} and front {front} are the same axis; give two different ones")
    return result


# ---------------------------------------------------------------- how badly a placed garment fits


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


def count_pierced(sample: Sample, placement: Placement, posture: Posture) -> int:
    """Return how many limbs pierce the placed cloth, without their starts, which lie at armholes."""
    limbs = placement.bones(posture)[posture.is_limb]
    return int(np.sum(_crosses(limbs + _ARMHOLE * (limbs[:, ::-1] - limbs) * [[1], [0]], sample.cloth)))


def wearing_cost(sample: Sample, placement: Placement, posture: Posture) -> float:
    """Return the cost of a garment that is not worn: pierced by limbs, around no bone, or slipping down."""
    points, pierced = placement.apply(sample.points), count_pierced(sample, placement, posture)
    is_empty = len(sample.openings) > 0 and not _crosses(placement.bones(posture), sample.openings).any()
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
