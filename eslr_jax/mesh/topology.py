"""Index tables and rest quantities of a triangle mesh, on the host and vectorised.

A half-edge is a face's directed side; half-edge 3 f + c runs from corner c of face f to corner c + 1.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse
from jaxtyping import Bool, Float, Int
from scipy.sparse.csgraph import connected_components


def half_edges(faces: Int[np.ndarray, "faces 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return start, end and opposite vertex of every half-edge, each of shape [3 * faces]."""
    return faces.ravel(), faces[:, [1, 2, 0]].ravel(), faces[:, [2, 0, 1]].ravel()


def next_half_edges(half_edge: Int[np.ndarray, " items"]) -> Int[np.ndarray, " items"]:
    """Return the next half-edge around the same face."""
    return half_edge - half_edge % 3 + (half_edge + 1) % 3


def twin_half_edges(faces: Int[np.ndarray, "faces 3"]) -> Int[np.ndarray, " half_edges"]:
    """Return for every half-edge the opposite half-edge of the neighbouring face, or -1 on the boundary."""
    starts, ends, _ = half_edges(faces)
    if not len(starts):
        return np.empty(0, np.int64)
    base = int(faces.max()) + 1
    keys = starts.astype(np.int64) * base + ends
    twin_keys = ends.astype(np.int64) * base + starts
    order = np.argsort(keys, kind="stable")
    found = order[np.minimum(np.searchsorted(keys[order], twin_keys), len(order) - 1)]
    return np.where(keys[found] == twin_keys, found, -1)


def undirected_edges(
    faces: Int[np.ndarray, "faces 3"],
) -> tuple[Int[np.ndarray, "pairs 2"], Int[np.ndarray, " half_edges"], Int[np.ndarray, " pairs"]]:
    """Return every edge once as (smaller, larger) vertex, the edge of every half-edge, and its face counts.

    The mesh may be broken: an edge may have any number of faces, in any orientation.
    """
    starts, ends, _ = half_edges(faces)
    base = int(faces.max(initial=0)) + 1
    keys = np.minimum(starts, ends).astype(np.int64) * base + np.maximum(starts, ends)
    unique, edge, counts = np.unique(keys, return_inverse=True, return_counts=True)
    return np.stack([unique // base, unique % base], axis=1), edge.ravel(), counts


def unique_edges(faces: Int[np.ndarray, "faces 3"]) -> Int[np.ndarray, "pairs 2"]:
    """Return every edge once, as (smaller, larger) vertex, in ascending order."""
    return undirected_edges(faces)[0]


def directed_edges(
    edges: Int[np.ndarray, "pairs 2"],
) -> tuple[Int[np.ndarray, " edges"], Int[np.ndarray, " edges"], Int[np.ndarray, " edges"]]:
    """Return senders, receivers and reverses of both directions of all edges, by receiver, then by sender."""
    senders, receivers = np.concatenate([edges, edges[:, ::-1]]).T
    order = np.lexsort((senders, receivers))
    position = np.empty(len(order), np.int64)
    position[order] = np.arange(len(order))
    reverse = position[np.roll(np.arange(len(order)), len(edges))]  # undirected edge e sits at e and at n + e
    return senders[order], receivers[order], reverse[order]


def adjacency(edges: Int[np.ndarray, "pairs 2"], num_vertices: int) -> scipy.sparse.csr_array:
    """Return the matrix with a one for each direction of every edge."""
    both = np.concatenate([edges, edges[:, ::-1]]).T
    return scipy.sparse.coo_array((np.ones(both.shape[1]), both), (num_vertices, num_vertices)).tocsr()


def neighbor_table(
    senders: Int[np.ndarray, " edges"], receivers: Int[np.ndarray, " edges"], num_vertices: int
) -> tuple[Int[np.ndarray, "vertices degree"], Bool[np.ndarray, "vertices degree"]]:
    """Return the neighbours of every vertex in ascending order, and a mask of the real entries.

    Edges are those of `directed_edges`. A row is padded with its own vertex.
    """
    slots, degree = _slots(receivers, num_vertices)
    table = np.repeat(np.arange(num_vertices)[:, None], degree, axis=1)
    mask = np.zeros(table.shape, bool)
    table[receivers, slots] = senders
    mask[receivers, slots] = True
    return table, mask


def incidence_table(
    indices: Int[np.ndarray, "items corners"], num_rows: int
) -> Int[np.ndarray, "rows degree"]:
    """Return for every row the positions in `indices.T.ravel()` that name it, padded with `indices.size`.

    Items are faces or hinges, rows are vertices. `numerics.gather_corners` reads this table.
    """
    flat = indices.T.ravel()
    order = np.argsort(flat, kind="stable")
    slots, degree = _slots(flat[order], num_rows)
    table = np.full((num_rows, degree), indices.size)
    table[flat[order], slots] = order
    return table


def moved_incidence(
    table: Int[np.ndarray, "rows degree"],
    corners: int,
    num_items: int,
    padded_items: int,
    num_rows: int,
    degree: int,
) -> Int[np.ndarray, "padded_rows padded_degree"]:
    """Return a table of incidence for more rows and items.

    Entry corner * n + item, of n items, becomes corner * m + item, and so does what fills rows, corners * n.
    """
    corner, item = np.divmod(table, max(num_items, 1))
    moved = np.full((num_rows, degree), corners * padded_items, table.dtype)
    is_filled = table == corners * num_items
    rows, columns = table.shape
    moved[:rows, :columns] = np.where(is_filled, corners * padded_items, corner * padded_items + item)
    return moved


def _slots(rows: np.ndarray, num_rows: int) -> tuple[np.ndarray, int]:
    """Return the column of every entry of a table, given ascending rows, and the number of columns."""
    degrees = np.bincount(rows, minlength=num_rows)
    slots = np.arange(len(rows)) - np.repeat(np.cumsum(degrees) - degrees, degrees)
    return slots, max(int(degrees.max(initial=0)), 1)


def hinge_half_edges(faces: Int[np.ndarray, "faces 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Return the half-edge in the left and in the right face of every hinge; see `find_hinges`."""
    starts, ends, _ = half_edges(faces)
    twins = twin_half_edges(faces)
    left = np.flatnonzero((twins >= 0) & (starts < ends))
    left = left[np.lexsort((ends[left], starts[left]))]
    return left, twins[left]


def find_hinges(
    faces: Int[np.ndarray, "faces 3"],
) -> tuple[Int[np.ndarray, "hinges 4"], Int[np.ndarray, "hinges 2"]]:
    """Return the hinges sorted by edge, and the left and right face of each.

    A hinge is a row (i, j, a, b): its left face runs i -> j -> a, its right face j -> i -> b, and i < j. The
    mesh must be manifold and consistently oriented (`validate_mesh`).
    """
    starts, ends, opposites = half_edges(faces)
    left, right = hinge_half_edges(faces)
    hinges = np.stack([starts[left], ends[left], opposites[left], opposites[right]], axis=1)
    return hinges, np.stack([left // 3, right // 3], axis=1)


def face_cross_products(
    positions: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> Float[np.ndarray, "faces 3"]:
    """Return (x1 - x0) x (x2 - x0) of every face: twice the area along the counter-clockwise normal [m^2]."""
    corners = positions[faces]
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def face_areas(
    positions: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> Float[np.ndarray, " faces"]:
    """Return the area of every face [m^2]."""
    return 0.5 * np.linalg.norm(face_cross_products(positions, faces), axis=1)


def vertex_normals(
    positions: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> Float[np.ndarray, "vertices 3"]:
    """Return the unit normal of every vertex, weighted by face areas; zero where a vertex has no face."""
    crosses = np.repeat(face_cross_products(positions, faces), 3, axis=0)
    sums = [np.bincount(faces.ravel(), crosses[:, axis], minlength=len(positions)) for axis in range(3)]
    return normalize(np.stack(sums, axis=1))


def vertex_areas(
    areas: Float[np.ndarray, " faces"], faces: Int[np.ndarray, "faces 3"], num_vertices: int
) -> Float[np.ndarray, " vertices"]:
    """Return a third of the area of the faces around every vertex [m^2]."""
    return np.bincount(faces.ravel(), weights=np.repeat(areas / 3.0, 3), minlength=num_vertices)


def inverse_rest_frames(
    positions: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> Float[np.ndarray, "faces 2 2"]:
    """Return the inverse of every face's rest edges D_m = [x0 - x2 | x1 - x2] in the face's plane [1/m].

    The plane's first axis runs along x0 - x2, and its second points to the side of x1. D_m is upper
    triangular with a positive diagonal.

    Source: HOOD, `stretching_energy.py`: frames from the 3-D rest mesh, not from UV coordinates.
    """
    corners = positions[faces]
    first = corners[:, 0] - corners[:, 2]
    second = corners[:, 1] - corners[:, 2]
    length = np.linalg.norm(first, axis=1)
    along = np.sum(first * second, axis=1) / length
    height = np.linalg.norm(np.cross(first, second), axis=1) / length
    inverse = np.zeros((len(faces), 2, 2))
    inverse[:, 0, 0] = 1.0 / length
    inverse[:, 0, 1] = -along / (length * height)
    inverse[:, 1, 1] = 1.0 / height
    return inverse


def vertex_components(faces: Int[np.ndarray, "faces 3"], num_vertices: int) -> tuple[int, np.ndarray]:
    """Return the number of connected components, and the component of every vertex, shape [vertices]."""
    starts, ends, _ = half_edges(faces)
    graph = scipy.sparse.coo_array((np.ones(len(starts), bool), (starts, ends)), (num_vertices, num_vertices))
    return connected_components(graph, directed=False)


def boundary_loops(faces: Int[np.ndarray, "faces 3"]) -> list[Int[np.ndarray, " loop"]]:
    """Return the boundary loops as vertex cycles, those with the most vertices first.

    A loop runs along the half-edges of its faces and starts at its smallest vertex. The mesh must be manifold,
    so that a vertex lies on at most one loop.
    """
    starts, ends, _ = half_edges(faces)
    is_boundary = twin_half_edges(faces) < 0
    following = dict(zip(starts[is_boundary].tolist(), ends[is_boundary].tolist(), strict=True))
    loops = []
    for first in sorted(following):
        loop = [first]
        while (vertex := following.pop(loop[-1], None)) is not None:
            loop.append(vertex)
        if len(loop) > 1:
            loops.append(np.array(loop[:-1]))
    return sorted(loops, key=lambda loop: (-len(loop), loop[0]))


def is_on_boundary(faces: Int[np.ndarray, "faces 3"], num_vertices: int) -> Bool[np.ndarray, " vertices"]:
    """Return which vertices have an edge with a single face."""
    edges, _, counts = undirected_edges(faces)
    result = np.zeros(num_vertices, bool)
    result[edges[counts == 1]] = True
    return result


def normalize(vectors: np.ndarray) -> np.ndarray:
    """Return unit vectors; a zero vector stays zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0, length, 1.0)
