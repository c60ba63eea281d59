"""Sewing patterns of GarmentCode: flat panels, how they stand around a body, and which edges are stitched."""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from eslr_jax.errors import MeshError
from eslr_jax.pipeline.formats.registry import reader

_CURVE_POINTS = 33  # of a curved edge; an arc of a right angle is then .03 % of its radius off
_SAME = 1e-4  # [m]: shorter edges have no length, and panels no width
_GARMENT = (0.2, 4.0)  # [m] largest extent of what a person wears
_UNEVEN = 4.0  # ratio of the lengths of stitched edges, from which on they are no gather but an error
_CHORD = 1e-6  # by which rounding may make a radius too small for its chord


class Side(NamedTuple):
    """One side of a seam: an edge of a panel, counted from zero."""

    panel: str
    edge: int


class Seam(NamedTuple):
    """Two edges that are sewn to each other."""

    sides: tuple[Side, Side]
    # They run the same way along the seam, right side to wrong side, and not against each other.
    is_parallel: bool

    def __str__(self) -> str:
        return " to ".join(f"{panel} edge {edge}" for panel, edge in self.sides)


@dataclasses.dataclass(frozen=True)
class Panel:
    """A flat piece of cloth. Its warp runs along the second axis of its plane."""

    edges: tuple[Float[np.ndarray, "_ 2"], ...]  # lines in its plane that follow each other around it [m]
    rotation: Float[np.ndarray, "3 3"]  # from its plane, whose third axis is zero, to its place at the body
    translation: Float[np.ndarray, " 3"]  # [m]

    def placed(self, points: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "points 3"]:
        """Return points of its plane [m] where it stands at the body."""
        return points @ self.rotation[:, :2].T + self.translation

    @property
    def outline(self) -> Float[np.ndarray, "points 2"]:
        """The edges as one closed line [m]; its last point is before the first."""
        return np.concatenate([edge[:-1] for edge in self.edges])


@dataclasses.dataclass(frozen=True)
class Pattern:
    """A garment as it is cut and sewn, placed around a body that stands at the origin, Y up, facing Z."""

    panels: Mapping[str, Panel]
    seams: tuple[Seam, ...]


@reader("pattern", [".json"])
def read_pattern(path: Path) -> Pattern:
    """Read a specification of GarmentCode or of the older data set of its authors; lengths become metres.

    Raises:
        AssetError: The file is missing or no JSON.
        MeshError: It is no pattern, a panel can't be cut, or a stitch names no edge, or one that is sewn already.

    Source: Korosteleva and Sorkine-Hornung 2023, doi 10.1145/3618351, and the files of their repository.
    """
    name, whole = path.name, json.loads(path.read_text(encoding="utf-8-sig"))
    found = _part(whole, "pattern", dict, name)
    unit = _part(_part(whole, "properties", dict, name), "units_in_meter", (int, float), name)
    if isinstance(unit, bool) or not 0 < unit < np.inf:
        raise MeshError(
            f"{name}: units_in_meter = {unit}; give the units of the file in a metre, 100 for centimetres"
        )
    if whole["properties"].get("curvature_coords", "relative") != "relative":
        raise MeshError(f"{name}: control points are not relative to their edges; export with relative ones")
    given = _part(found, "panels", dict, name)
    if not given:
        raise MeshError(f"{name}: it has no panels; export the pattern again")
    panels = {key: _read_panel(panel, 1.0 / unit, f"{name}: panel {key}") for key, panel in given.items()}
    corners = np.concatenate([panel.placed(panel.outline) for panel in panels.values()])
    extent = float(np.ptp(corners, axis=0).max())
    if not _GARMENT[0] < extent < _GARMENT[1]:
        raise MeshError(
            f"{name}: with {unit:g} units in a metre it is {extent:.3g} m large; give the right units_in_meter "
            "(100 for centimetres), or move panels nearer that stand far from the others"
        )
    return Pattern(panels, _read_seams(_part(found, "stitches", list, name), panels, name))


def _part(whole: Any, key: str, kind: type | tuple[type, ...], where: str) -> Any:
    """Return an entry of a JSON object that has to be there."""
    if not isinstance(whole, dict) or not isinstance(whole.get(key), kind):
        raise MeshError(f"{where} has no {key}; give a specification of GarmentCode (..._specification.json)")
    return whole[key]


def _numbers(value: Any, shape: tuple[int, ...], where: str) -> np.ndarray:
    """Return numbers as an array; a size of -1 may be any."""
    try:
        array = np.array(value, np.float64)
    except (TypeError, ValueError):
        array = np.array(np.nan)
    fits = array.ndim == len(shape) and all(w in (-1, n) for w, n in zip(shape, array.shape, strict=True))
    if not fits or not np.isfinite(array).all():
        wanted = " x ".join("n" if size < 0 else str(size) for size in shape)
        raise MeshError(f"{where} is not {wanted} finite numbers; correct it")
    return array


def _read_panel(given: Any, unit: float, where: str) -> Panel:
    corners = unit * _numbers(_part(given, "vertices", list, where), (-1, 2), f"{where}: vertices")
    translation = unit * _numbers(_part(given, "translation", list, where), (3,), f"{where}: translation")
    edges, ends = [], []
    for number, edge in enumerate(_part(given, "edges", list, where)):
        place = f"{where}: edge {number}"
        pair = _part(edge, "endpoints", list, place)
        if len(pair) != 2 or not all(isinstance(k, int) and 0 <= k < len(corners) for k in pair):
            raise MeshError(
                f"{place} joins the vertices {pair}, and the panel has {len(corners)}; name two of them"
            )
        start, end = corners[pair]
        if np.linalg.norm(end - start) < _SAME:
            raise MeshError(f"{place} has no length; leave it out, and count the edges of its stitches anew")
        ends.append(pair)
        edges.append(_curve(start, end, edge.get("curvature"), unit, place))
    for number, (this, following) in enumerate(zip(ends, ends[1:] + ends[:1], strict=True)):
        if this[1] != following[0]:
            raise MeshError(
                f"{where} is open: edge {number} ends at vertex {this[1]}, and the next edge begins at "
                f"{following[0]}; list the edges in their order around the panel"
            )
    panel = Panel(tuple(edges), _rotation(given.get("rotation", [0, 0, 0]), where), translation)
    if len(edges) < 2 or abs(signed_area(panel.outline)) < _SAME * _SAME:
        raise MeshError(f"{where} has no area; correct its vertices")
    crossing = _crossing_segments(panel.outline)
    if crossing is not None:
        owner = np.repeat(np.arange(len(edges)), [len(edge) - 1 for edge in edges])
        first, second = owner[list(crossing)]
        raise MeshError(f"{where}: its edges {first} and {second} cross; correct their ends or curvature")
    return panel


def signed_area(outline: Float[np.ndarray, "points 2"]) -> float:
    """Return the area within a closed line [m2], negative where it runs clockwise."""
    x, y = outline.T
    return 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


def _rotation(given: Any, where: str) -> Float[np.ndarray, "3 3"]:
    """Return a rotation, from a matrix or from degrees about x, y and z, one after the other."""
    if isinstance(given, list) and len(given) == 3 and isinstance(given[0], list):
        matrix = _numbers(given, (3, 3), f"{where}: rotation")
        if not np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-3) or np.linalg.det(matrix) < 0:
            raise MeshError(f"{where}: its rotation matrix is no rotation; correct it")
        return matrix
    return Rotation.from_euler("xyz", _numbers(given, (3,), f"{where}: rotation"), degrees=True).as_matrix()


def _curve(start: np.ndarray, end: np.ndarray, given: Any, unit: float, where: str) -> np.ndarray:
    """Return an edge as a line of points [m], given its curvature as the file has it."""
    if given is None:
        return np.stack([start, end])
    if isinstance(given, list):  # the older data set's: one control point
        given = {"type": "quadratic", "params": [given]}
    kind, params = _part(given, "type", str, where), _part(given, "params", list, where)
    along = end - start
    across = np.array([-along[1], along[0]])  # leaves the edge to the left
    if kind == "circle":
        radius, is_large, is_right = _numbers(params, (3,), f"{where}: params of its arc")
        radius, half = unit * radius, 0.5 * float(np.linalg.norm(along))
        if radius < half * (1 - _CHORD):
            raise MeshError(
                f"{where}: an arc of radius {radius:.3g} m can't span {2 * half:.3g} m; correct the radius"
            )
        rise = np.sqrt(max(radius**2 - half**2, 0.0)) / (2 * half)
        center = start + 0.5 * along + (rise if (is_right > 0) != (is_large > 0) else -rise) * across
        turn = 2 * np.arcsin(min(half / radius, 1.0))
        turn = (2 * np.pi - turn if is_large > 0 else turn) * (1 if is_right > 0 else -1)
        angle = np.linspace(0.0, turn, _CURVE_POINTS)[:, None]
        spoke = start - center
        return center + np.cos(angle) * spoke + np.sin(angle) * np.array([-spoke[1], spoke[0]])
    count = {"quadratic": 1, "cubic": 2}.get(kind)
    if count is None:
        raise MeshError(f"{where} has the curvature {kind!r}; give quadratic, cubic or circle")
    controls = _numbers(params, (count, 2), f"{where}: control points")
    points = [start, *(start + u * along + v * across for u, v in controls), end]
    t = np.linspace(0.0, 1.0, _CURVE_POINTS)[:, None]
    while len(points) > 1:  # de Casteljau
        points = [(1 - t) * a + t * b for a, b in itertools.pairwise(points)]
    return points[0]


def _crossing_segments(outline: np.ndarray) -> tuple[int, int] | None:
    """Return two segments of a closed line that cross; None without."""
    start, end = outline, np.roll(outline, -1, axis=0)

    def sides(points: np.ndarray) -> np.ndarray:
        (x, y), (u, v) = (end - start).T[:, :, None], (points[None] - start[:, None]).transpose(2, 0, 1)
        return np.sign(x * v - y * u)

    # The second segment's ends lie on both sides of the first's line.
    is_split = sides(start) * sides(end) < 0
    is_crossing = is_split & is_split.T
    if not is_crossing.any():
        return None
    first, second = np.argwhere(is_crossing)[0]
    return int(first), int(second)


def _read_seams(given: Sequence[Any], panels: Mapping[str, Panel], name: str) -> tuple[Seam, ...]:
    seams, sewn = [], {}
    for number, stitch in enumerate(given):
        where = f"{name}: stitch {number}"
        if not isinstance(stitch, list) or len(stitch) < 2 or stitch[2:] not in ([], ["right_wrong"]):
            raise MeshError(f"{where} is not two edges; give a panel and an edge for each")
        sides = tuple(_read_side(side, panels, where) for side in stitch[:2])
        seam = Seam((sides[0], sides[1]), len(stitch) == 3)
        for side in sides:
            if side in sewn or sides[0] == sides[1]:
                other = sewn.get(side, number)
                raise MeshError(
                    f"{where} sews {side.panel} edge {side.edge} again (stitch {other}); an edge is sewn once"
                )
            sewn[side] = number
        lengths = [edge_length(panels[side.panel].edges[side.edge]) for side in sides]
        if max(lengths) > _UNEVEN * min(lengths):
            raise MeshError(
                f"{where}: {seam} sews {100 * lengths[0]:.1f} cm to {100 * lengths[1]:.1f} cm; correct its edges"
            )
        seams.append(seam)
    loose = [key for key in panels if not any(side.panel == key for side in sewn)]
    if loose:
        raise MeshError(f"{name}: panel {loose[0]} is sewn to nothing; stitch it, or leave it out")
    return tuple(seams)


def _read_side(given: Any, panels: Mapping[str, Panel], where: str) -> Side:
    panel, edge = _part(given, "panel", str, where), _part(given, "edge", int, where)
    if panel not in panels:
        raise MeshError(
            f"{where} names the panel {panel}, which is not there; panels are {', '.join(panels)}"
        )
    if isinstance(edge, bool) or not 0 <= edge < len(panels[panel].edges):
        raise MeshError(
            f"{where} names edge {edge} of {panel}, which has {len(panels[panel].edges)}; count from 0"
        )
    return Side(panel, edge)


def edge_length(edge: Float[np.ndarray, "points 2"]) -> float:
    """Return the length of a line [m]."""
    return float(np.linalg.norm(np.diff(edge, axis=0), axis=1).sum())
