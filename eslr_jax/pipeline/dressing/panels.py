"""Panels of a sewing pattern as one mesh: cut into even triangles, with as many along both sides of a seam."""

from __future__ import annotations

import dataclasses

import numpy as np
import scipy.sparse
from jaxtyping import Bool, Float, Int
from scipy.sparse.csgraph import connected_components

from eslr_jax.errors import ConfigError, MeshError
from eslr_jax.mesh.topology import undirected_edges
from eslr_jax.pipeline.dressing.repair import consistent_orientation
from eslr_jax.pipeline.extras import require
from eslr_jax.pipeline.formats.mesh import Faces, Positions
from eslr_jax.pipeline.formats.pattern import Pattern, Side, edge_length, signed_area

_SIZES = (100, 100_000)  # vertices that may be asked for
_SHORT = 0.25  # of the edge length: shorter edges of a panel shrink to a vertex
_FREE = 0.6  # of the edge length, that vertices inside keep from the outline
_ROUNDS = 8  # of triangulation, while vertices are added and moved
_SMOOTHED = 4  # of these, in which vertices move to the middle of their neighbours


@dataclasses.dataclass(frozen=True)
class SewnMesh:
    """The panels of a pattern, joined along their seams."""

    faces: Faces  # all turned the same way, outwards or inwards
    panel_corners: Float[np.ndarray, "faces 3 2"]  # corners of each face in the plane of its panel [m]
    placed: Positions  # in the middle of the places that the panels give a vertex [m]
    spans: Positions  # from one side of its seam to the other, as placed [m]
    face_panels: Int[np.ndarray, " faces"]  # in the order of the pattern
    seam_edges: Int[np.ndarray, "edges 2"]  # mesh edges along seams
    edge_seams: Int[np.ndarray, " edges"]  # the seam of each


def join_panels(pattern: Pattern, num_vertices: int, name: str = "pattern") -> SewnMesh:
    """Cut the panels of a pattern into triangles, with about so many vertices, and join them.

    Raises:
        ConfigError: The number is out of range.
        MeshError: A panel is too small for this number, or its outline touches itself.
        MissingExtraError: The extra `patterns` is not installed.
    """
    if not _SIZES[0] <= num_vertices <= _SIZES[1]:
        raise ConfigError(f"{num_vertices} vertices; give {_SIZES[0]} to {_SIZES[1]:,}")
    area = sum(abs(signed_area(panel.outline)) for panel in pattern.panels.values())
    spacing = float(np.sqrt(2.0 * area / (np.sqrt(3.0) * num_vertices)))  # of equilateral triangles
    sewn = {side for seam in pattern.seams for side in seam.sides}
    pieces = {}  # of every edge
    for key, panel in pattern.panels.items():
        for number, edge in enumerate(panel.edges):
            side, length = Side(key, number), edge_length(edge) / spacing
            pieces[side] = 0 if length < _SHORT else max(round(length), 1 if side in sewn else 2)
    for seam in pattern.seams:
        pieces |= dict.fromkeys(seam.sides, max(pieces[side] for side in seam.sides))
    flat, placed, faces, owners, rows, count = [], [], [], [], {}, 0
    for number, (key, panel) in enumerate(pattern.panels.items()):
        lines = [_divided(edge, pieces[Side(key, k)]) for k, edge in enumerate(panel.edges)]
        outline = np.concatenate([line[:-1] for line in lines])
        if len(outline) < 3:
            raise MeshError(
                f"{name}: panel {key} is smaller than a triangle; ask for more vertices, or leave it out"
            )
        starts = np.cumsum([0, *(len(line) - 1 for line in lines)])
        is_sewn = np.zeros(len(outline), bool)
        for k in range(len(lines)):
            along = np.arange(starts[k], starts[k + 1] + 1) % len(outline)
            is_sewn[along] |= Side(key, k) in sewn
            rows[Side(key, k)] = count + along
        try:
            points, triangles = _triangulate(outline, is_sewn, spacing)
        except RuntimeError as error:  # CDT's
            raise MeshError(
                f"{name}: panel {key} can't be cut: its outline touches itself; correct its vertices"
            ) from error
        flat.append(points)
        placed.append(panel.placed(points))
        faces.append(count + triangles)
        owners.append(np.full(len(triangles), number))
        count += len(points)
    flat, placed, faces = np.concatenate(flat), np.concatenate(placed), np.concatenate(faces)
    pairs = []
    for seam in pattern.seams:
        one, other = (rows[side] for side in seam.sides)
        pairs.append((one, other if seam.is_parallel else other[::-1]))
    first, second = (np.concatenate(side) for side in zip(*pairs, strict=True))
    graph = scipy.sparse.coo_array((np.ones(len(first), bool), (first, second)), (count, count))
    num_joined, vertex = connected_components(graph, directed=False)
    totals = np.zeros((num_joined, 3))
    np.add.at(totals, vertex, placed)
    start = totals / np.bincount(vertex)[:, None]
    spans = np.zeros((num_joined, 3))
    spans[vertex[first]] = placed[first] - placed[second]
    joined = vertex[faces]
    turn = consistent_orientation(start, joined)
    corners = _gathered(flat, faces, pairs)
    return SewnMesh(
        faces=np.where(turn[:, None], joined[:, ::-1], joined),
        panel_corners=np.where(turn[:, None, None], corners[:, ::-1], corners),
        placed=start,
        spans=spans,
        face_panels=np.concatenate(owners),
        seam_edges=np.concatenate([np.stack([vertex[a[:-1]], vertex[a[1:]]], axis=1) for a, _ in pairs]),
        edge_seams=np.repeat(np.arange(len(pairs)), [len(a) - 1 for a, _ in pairs]),
    )


def _gathered(
    flat: Float[np.ndarray, "rows 2"], faces: Faces, pairs: list[tuple[np.ndarray, np.ndarray]]
) -> Float[np.ndarray, "faces 3 2"]:
    """Return the corners of faces [m], those along the longer side of a seam as short there as the other side.

    Folds of a gather are smaller than a face, and its seam is not stretched.
    """
    sides = [
        np.stack([np.concatenate([row[:-1] for row in rows]), np.concatenate([row[1:] for row in rows])])
        for rows in zip(*pairs, strict=True)
    ]
    lengths = [np.linalg.norm(flat[start] - flat[end], axis=1) for start, end in sides]
    shares = scipy.sparse.lil_array((len(flat), len(flat)))
    for (start, end), own, other in zip(sides, lengths, lengths[::-1], strict=True):
        lack = np.maximum(1.0 - other / own, 0.0)
        shares[start, end] = shares[end, start] = lack
    corners, table = flat[faces], shares.tocsr()
    for k in range(3):
        following = (k + 1) % 3
        lack = np.asarray(table[faces[:, k], faces[:, following]]).reshape(-1, 1)
        shift = 0.5 * lack * (corners[:, following] - corners[:, k])
        corners[:, k] += shift
        corners[:, following] -= shift
    return corners


def _divided(line: Float[np.ndarray, "points 2"], pieces: int) -> Float[np.ndarray, "_ 2"]:
    """Return a line in pieces of equal length, with both ends; with no piece, its start."""
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    places = np.linspace(0.0, way[-1], pieces + 1)
    return np.stack([np.interp(places, way, line[:, axis]) for axis in range(2)], axis=1)


def _triangulate(
    outline: Float[np.ndarray, "outline 2"], is_sewn: Bool[np.ndarray, " outline"], spacing: float
) -> tuple[Float[np.ndarray, "vertices 2"], Faces]:
    """Return vertices of a panel, the outline's first, and its triangles.

    No edge inside joins two sewn vertices: two panels would have it in common besides the seam.
    """
    low, high = outline.min(axis=0), outline.max(axis=0)
    step = spacing * np.array([1.0, np.sqrt(0.75)])
    columns, lines = np.ceil((high - low) / step).astype(int) + 2
    column, line = (grid.ravel() for grid in np.meshgrid(np.arange(columns), np.arange(lines)))
    lattice = low + step * np.stack([column - 0.5 * (line % 2), line], axis=1)
    inner = lattice[_is_free(lattice, outline, _FREE * spacing)]
    for attempt in range(_ROUNDS):
        points = np.concatenate([outline, inner])
        faces = _delaunay(points, len(outline))
        edges, _, shared = undirected_edges(faces)
        chords = edges[(shared == 2) & (edges < len(outline)).all(axis=1)]
        chords = chords[is_sewn[chords].all(axis=1)]
        if attempt >= _SMOOTHED and not len(chords):
            break
        if attempt < _SMOOTHED:
            ends = np.concatenate([edges, edges[:, ::-1]])
            totals = np.stack(
                [np.bincount(ends[:, 0], points[ends[:, 1], k], len(points)) for k in (0, 1)], axis=1
            )
            moved = (totals / np.bincount(ends[:, 0], minlength=len(points))[:, None])[len(outline) :]
            inner = np.where(_is_free(moved, outline, 0.5 * _FREE * spacing)[:, None], moved, inner)
        inner = np.concatenate([inner, points[chords].mean(axis=1)])
    return points, faces


def _delaunay(points: Float[np.ndarray, "points 2"], num_outline: int) -> Faces:
    """Return triangles between points, which the closed line of the first ones bounds."""
    cdt = require("pythoncdt", extra="patterns", purpose="a sewing pattern")
    mesh = cdt.Triangulation(cdt.VertexInsertionOrder.AUTO, cdt.IntersectingConstraintEdges.NOT_ALLOWED, 0.0)
    mesh.insert_vertices([cdt.V2d(x, y) for x, y in points])
    mesh.insert_edges([cdt.Edge(k, (k + 1) % num_outline) for k in range(num_outline)])
    mesh.erase_outer_triangles_and_holes()
    return np.array([triangle.vertices for triangle in mesh.triangles], np.int64)


def _is_free(
    points: Float[np.ndarray, "points 2"], outline: Float[np.ndarray, "outline 2"], distance: float
) -> Bool[np.ndarray, " points"]:
    """Tell which points lie inside a closed line, at least a distance from it [m]."""
    start, end = outline, np.roll(outline, -1, axis=0)
    along, offset = end - start, points[:, None] - start
    share = np.clip(np.sum(offset * along, axis=2) / np.sum(along * along, axis=1), 0.0, 1.0)
    is_near = np.linalg.norm(offset - share[..., None] * along, axis=2) < distance
    (x, y), (u, v) = points.T[:, :, None], start.T
    is_level = (v > y) != (end[:, 1] > y)  # a ray to the right passes the segment's height
    with np.errstate(divide="ignore", invalid="ignore"):
        is_passed = is_level & (x < u + (y - v) * along[:, 0] / along[:, 1])
    return (is_passed.sum(axis=1) % 2 == 1) & ~is_near.any(axis=1)
