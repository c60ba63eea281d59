"""Flat sheets of any mesh in the plane y = 0, what they are rolled to, and how stiff a strip of them is."""

import numpy as np
import scipy.optimize
import scipy.sparse
import scipy.sparse.linalg
from hard_cases.build import sheet
from scipy.spatial import Delaunay


def grid(length: float, width: float, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """A grid of squares with alternating diagonals [m], facing up."""
    counts = round(length / spacing) + 1, round(width / spacing) + 1
    positions, faces = sheet(*counts, (length, width))
    return positions + 0.5 * np.array([length, 0.0, width]), faces


def irregular(length: float, width: float, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Triangles that are no two alike: a turned lattice of equilateral ones, moved at random by a fifth."""
    random = np.random.default_rng(0)
    turn = random.uniform(0, np.pi / 3)
    count = int(2 * (length + width) / spacing)
    i, j = np.meshgrid(np.arange(-count, count), np.arange(-count, count))
    inner = np.stack([i + 0.5 * (j % 2), j * np.sqrt(3) / 2], axis=-1).reshape(-1, 2) * spacing
    inner = inner @ [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]] + [length / 2, width / 2]
    inner = inner + 0.2 * spacing * random.standard_normal(inner.shape)
    margin = 0.55 * spacing
    inner = inner[np.all((inner > margin) & (inner < np.array([length, width]) - margin), axis=1)]
    along, across = (
        np.linspace(0, length, round(length / spacing) + 1),
        np.linspace(0, width, round(width / spacing) + 1),
    )
    sides = [np.stack(np.broadcast_arrays(along, end), 1) for end in (0.0, width)]
    sides += [np.stack(np.broadcast_arrays(end, across[1:-1]), 1) for end in (0.0, length)]
    points = np.concatenate([*sides, inner])
    return triangulate(points, 1e-3 * spacing**2)


def triangulate(points: np.ndarray, sliver: float) -> tuple[np.ndarray, np.ndarray]:
    """Return points of the plane [m] as a flat mesh that faces up, without triangles of half a sliver [m^2]."""
    faces = Delaunay(points).simplices
    edges = points[faces[:, 1:]] - points[faces[:, :1]]
    doubled = edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]
    faces = np.where((doubled > 0)[:, None], faces[:, [0, 2, 1]], faces)[np.abs(doubled) > sliver]
    return np.stack([points[:, 0], np.zeros(len(points)), points[:, 1]], axis=1), faces


def tube(positions: np.ndarray, radius: float, angle: float) -> np.ndarray:
    """Return a flat sheet rolled up along the direction at an angle [rad] from x, to a radius [m]."""
    along = np.array([np.cos(angle), 0.0, np.sin(angle)])
    up = np.array([0.0, 1.0, 0.0])
    arc = positions @ along / radius
    flat = positions - np.outer(positions @ along, along)
    return flat + radius * (np.outer(np.sin(arc), along) + np.outer(1.0 - np.cos(arc), up))


def stiffness_across(garment, plate) -> scipy.sparse.csr_array:
    """Return the second derivatives of a flat plate's energy by the heights of its vertices [N/m].

    Curvatures are linear in the hinges' angles, and these in heights h: with w the distances of the two tips from
    the edge, and f the places of their feet on it, an angle is the sum of (h - (1 - f) h_start - f h_end) / w.
    """
    flat, hinges = np.asarray(garment.rest_positions, np.float64)[:, [0, 2]], np.asarray(garment.hinges)
    start, end, *tips = np.swapaxes(flat[hinges], 0, 1)
    edge = end - start
    length = np.linalg.norm(edge, axis=1)
    by_height = np.zeros((len(hinges), 4))
    for corner, tip in enumerate(tips, start=2):
        side = tip - start
        far = np.abs(edge[:, 0] * side[:, 1] - edge[:, 1] * side[:, 0]) / length
        foot = np.sum(side * edge, axis=1) / length**2
        by_height[:, corner] = 1.0 / far
        by_height[:, 0] -= (1.0 - foot) / far
        by_height[:, 1] -= foot / far
    angles = _sparse_rows(by_height, hinges, len(flat))
    rows, table = np.asarray(plate.rows, np.float64), np.asarray(plate.hinges)
    curvatures = scipy.sparse.vstack([_sparse_rows(row.T, table, len(hinges)) for row in rows])
    by_vertex = curvatures @ angles
    return scipy.sparse.csr_array(by_vertex.T @ by_vertex)


def _sparse_rows(values: np.ndarray, columns: np.ndarray, width: int) -> scipy.sparse.csr_array:
    """Return a matrix whose rows hold values at columns, both of shape [rows, entries]."""
    rows = np.repeat(np.arange(len(values)), values.shape[1])
    return scipy.sparse.csr_array((values.ravel(), (rows, columns.ravel())), shape=(len(values), width))


def cantilever_rigidity(garment, plate) -> float:
    """Return the rigidity that a strip along x shows under its weight, held over its first fifth [N m].

    Where the beam begins is fitted with it: a mesh bends over half an edge behind its last held vertex.
    """
    matrix = stiffness_across(garment, plate)
    x = np.asarray(garment.rest_positions, np.float64)[:, 0]
    is_free = x > 0.2 * x.max() + 1e-6
    load = np.asarray(garment.vertex_areas, np.float64)[is_free]  # a weight of 1 N/m^2
    sag = scipy.sparse.linalg.spsolve(matrix[is_free][:, is_free].tocsc(), load)
    along, length = x[is_free], x.max()

    def misfit(parameters):
        start, compliance = parameters
        s, span = np.maximum(along - start, 0.0), length - start
        beam = s**2 * (6 * span**2 - 4 * span * s + s**2) / 24 * compliance
        return (beam * sag.max() - sag) / sag.max()

    guess = 8.0 / (0.8 * length) ** 4
    found = scipy.optimize.least_squares(misfit, [0.2 * length, guess], x_scale=[length, guess])
    return 1.0 / (found.x[1] * sag.max())
