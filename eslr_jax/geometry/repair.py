"""Make one clean surface of what modelling programs export: seams, duplicates, loose parts, turned faces."""

from __future__ import annotations

import dataclasses

import numpy as np
import scipy.sparse
from jaxtyping import Bool, Float, Int
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from eslr_jax.geometry.topology import face_areas, half_edges, vertex_components


@dataclasses.dataclass(frozen=True)
class Cleaned:
    """A mesh without duplicates, and where its vertices and faces come from."""

    positions: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    vertex_map: Int[np.ndarray, " source_vertices"]  # vertex of every source vertex; -1 where it was dropped
    face_source: Int[np.ndarray, " faces"]  # source face of every face


def weld(
    positions: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    *,
    tolerance: float = 1e-5,
) -> Cleaned:
    """Join coincident vertices of open edges, then drop collapsed and repeated faces and loose vertices.

    Only vertices on open edges are joined: those of a seam that was split for its texture coordinates are,
    whereas two layers of cloth that touch are not. A joined vertex keeps the position of its first.

    Args:
        positions: Vertex positions, in any unit.
        faces: Triangles; every index in range.
        tolerance: Distance within which vertices coincide, relative to the bounding box's diagonal.
    """
    diagonal = float(np.linalg.norm(np.ptp(positions, axis=0)))
    is_open = _open_vertices(faces, len(positions))
    candidates = np.flatnonzero(is_open)
    pairs = KDTree(positions[candidates]).query_pairs(tolerance * diagonal, output_type="ndarray")
    return merge_vertices(positions, faces, candidates[pairs])


def merge_vertices(
    positions: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    pairs: Int[np.ndarray, "pairs 2"],
) -> Cleaned:
    """Join the given pairs of vertices, and whatever they are chained to; see `weld`."""
    num_vertices = len(positions)
    graph = scipy.sparse.coo_array((np.ones(len(pairs), bool), tuple(pairs.T)), (num_vertices, num_vertices))
    _, label = connected_components(graph, directed=False)
    _, first = np.unique(label, return_index=True)  # labels ascend with their first vertex
    joined = np.asarray(first)[label[faces]]
    is_face = (joined != joined[:, [1, 2, 0]]).all(axis=1)
    kept = np.flatnonzero(is_face)
    _, earliest = np.unique(np.sort(joined[kept], axis=1), axis=0, return_index=True)
    kept = kept[np.sort(earliest)]
    faces = joined[kept]
    used = np.unique(faces)
    number = np.full(num_vertices, -1)
    number[used] = np.arange(len(used))
    return Cleaned(positions[used], number[faces], number[first[label]], kept)


def join_components(
    positions: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"], gap: float
) -> Cleaned:
    """Sew separate parts together where their open edges come within `gap` of each other.

    Every open vertex is joined to the nearest open vertex of another part; where one edge has more vertices
    than the other, several go to one and the slivers between them vanish, if `gap` is at least half the
    longer edges.
    """
    _, component = vertex_components(faces, len(positions))
    candidates = np.flatnonzero(_open_vertices(faces, len(positions)))
    pairs = []
    for part in np.unique(component[candidates]):
        own = candidates[component[candidates] == part]
        others = candidates[component[candidates] != part]
        if not len(others):
            break
        distance, nearest = KDTree(positions[others]).query(positions[own], distance_upper_bound=gap)
        is_near = np.isfinite(distance)
        pairs.append(np.stack([own[is_near], others[nearest[is_near]]], axis=1))
    found = np.concatenate(pairs) if pairs else np.empty((0, 2), np.int64)
    return merge_vertices(positions, faces, found)


def largest_component(positions: np.ndarray, faces: np.ndarray) -> Cleaned:
    """Keep the connected part with the largest area."""
    _, component = vertex_components(faces, len(positions))
    owner = component[faces[:, 0]]
    kept = np.flatnonzero(owner == np.argmax(np.bincount(owner, weights=face_areas(positions, faces))))
    used = np.unique(faces[kept])
    number = np.full(len(positions), -1)
    number[used] = np.arange(len(used))
    return Cleaned(positions[used], number[faces[kept]], number, kept)


def consistent_orientation(
    positions: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> Bool[np.ndarray, " faces"]:
    """Return which faces to turn so that neighbours agree, most of each part's area staying as it is.

    Faces that meet along an edge with other than two faces, or on a surface with one side, are left to
    `validate_mesh`.
    """
    starts, ends, _ = half_edges(faces)
    base = int(faces.max()) + 1
    keys = np.minimum(starts, ends) * base + np.maximum(starts, ends)
    order = np.argsort(keys, kind="stable")
    _, begin, count = np.unique(keys[order], return_index=True, return_counts=True)
    first, second = order[begin[count == 2]], order[begin[count == 2] + 1]
    agrees = starts[first] != starts[second]  # neighbours run along their edge in opposite directions
    # Every face twice, as it is and turned, joined to the copy of each neighbour that agrees with it: a part
    # falls into two components, and its faces as they are lie in the one or the other.
    num_faces = len(faces)
    left, right = first // 3, second // 3
    opposing = np.where(agrees, 0, num_faces)
    rows = np.concatenate([left, left + num_faces])
    columns = np.concatenate([right + across, right + num_faces - across])
    graph = scipy.sparse.coo_array(
        (np.ones(len(rows), bool), (rows, columns)), (2 * num_faces, 2 * num_faces)
    )
    _, sheet = connected_components(graph, directed=False)
    sheet, turned_sheet = sheet[:num_faces], sheet[num_faces:]
    areas = np.bincount(sheet, weights=face_areas(positions, faces), minlength=2 * num_faces)
    return areas[turned_sheet] > areas[sheet]


def _open_vertices(faces: np.ndarray, num_vertices: int) -> np.ndarray:
    """Return which vertices lie on an edge of a single face."""
    starts, ends, _ = half_edges(faces)
    base = num_vertices + 1
    keys = np.minimum(starts, ends) * base + np.maximum(starts, ends)
    _, inverse, count = np.unique(keys, return_inverse=True, return_counts=True)
    is_single = count[inverse.ravel()] == 1
    is_open = np.zeros(num_vertices, bool)
    is_open[starts[is_single]] = True
    is_open[ends[is_single]] = True
    return is_open
