"""Repair the meshes that modelling programs export: seams, duplicates, loose parts, turned faces."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import scipy.sparse
from jaxtyping import Bool, Int
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from eslr_jax.mesh.topology import face_areas, half_edges, undirected_edges, vertex_components, vertex_normals
from eslr_jax.pipeline.formats.mesh import Faces, Positions

_AROUND = 12  # nearest vertices, one of which is on a shell's other side
_OPPOSED = 0.5  # cosine between the normals of its two sides


@dataclasses.dataclass(frozen=True)
class Cleaned:
    """A repaired mesh, and the source of its vertices and faces."""

    positions: Positions
    faces: Faces
    vertex_map: Int[np.ndarray, " source_vertices"]  # new vertex of every source vertex; -1: dropped
    face_source: Int[np.ndarray, " faces"]  # source face of every new face


def weld(positions: Positions, faces: Faces, *, tolerance: float = 1e-5) -> Cleaned:
    """Join coincident boundary vertices, then drop collapsed faces, repeated faces and loose vertices.

    Boundary vertices are joined, and those of faces that coincide whole, as the two sides of a double-sided mesh.
    This closes seams that were split for texture coordinates, and keeps two layers of cloth apart that touch. The
    tolerance is relative to the bounding box's diagonal.
    """
    diagonal = float(np.linalg.norm(np.ptp(positions, axis=0)))
    pairs = KDTree(positions).query_pairs(tolerance * diagonal, output_type="ndarray")
    corners = np.sort(_first_of_groups(len(positions), pairs)[faces], axis=1)
    _, group, counts = np.unique(corners, axis=0, return_inverse=True, return_counts=True)
    is_joined = np.zeros(len(positions), bool)
    is_joined[_boundary_vertices(faces)] = True
    is_joined[faces[counts[group.ravel()] > 1]] = True
    return merge_vertices(positions, faces, pairs[is_joined[pairs].all(axis=1)])


def merge_vertices(positions: Positions, faces: Faces, pairs: Int[np.ndarray, "pairs 2"]) -> Cleaned:
    """Join the given pairs of vertices; a chain of pairs becomes its first vertex. See `weld`."""
    merged = _first_of_groups(len(positions), pairs)
    joined = merged[faces]
    kept = np.flatnonzero((joined != joined[:, [1, 2, 0]]).all(axis=1))
    _, earliest = np.unique(np.sort(joined[kept], axis=1), axis=0, return_index=True)
    return _select_faces(positions, joined, kept[np.sort(earliest)], merged)


def _first_of_groups(count: int, pairs: np.ndarray) -> np.ndarray:
    """Return the first vertex of the chain of pairs that each of `count` vertices is in, shape [count]."""
    graph = scipy.sparse.coo_array((np.ones(len(pairs), bool), tuple(pairs.T)), (count, count))
    _, label = connected_components(graph, directed=False)
    _, first = np.unique(label, return_index=True)  # labels ascend with their first vertex
    return np.asarray(first)[label]


def shell_thickness(positions: Positions, faces: Faces) -> float | None:
    """Return how far the two sides of a closed thin shell are apart in the median; None of any other mesh.

    The unit is that of the positions. A vertex of a shell has one of opposed normal among its nearest, nearer
    than the mean edge.
    """
    if len(_boundary_vertices(faces)):
        return None
    normals = vertex_normals(positions, faces)
    distance, nearest = KDTree(positions).query(positions, k=min(_AROUND, len(positions)))
    is_opposed = np.einsum("vkx,vx->vk", normals[nearest], normals) < -_OPPOSED
    across = np.where(is_opposed, distance, np.inf).min(axis=1)
    edges = undirected_edges(faces)[0]
    usual = np.linalg.norm(positions[edges[:, 0]] - positions[edges[:, 1]], axis=1).mean()
    thickness = float(np.median(across))
    return thickness if thickness < usual else None


def join_components(positions: Positions, faces: Faces, gap: float) -> Cleaned:
    """Sew separate parts together where their boundaries come within `gap` of each other.

    Every boundary vertex is joined to the nearest boundary vertex of another part. Where one boundary has more
    vertices than the other, several are joined to one. The slivers between them vanish if `gap` is at least
    half the longer edges.
    """
    pairs, distances = _seam_pairs(positions, faces)
    return merge_vertices(positions, faces, pairs[distances <= gap])


def shares_along_seams(positions: Positions, faces: Faces, gaps: Sequence[float]) -> list[float]:
    """Return the share of all boundary vertices that have a boundary of another part within each of some gaps."""
    _, distances = _seam_pairs(positions, faces)
    return [float(np.sum(distances <= gap)) / max(len(distances), 1) for gap in gaps]


def _seam_pairs(positions: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return every boundary vertex with the nearest one of another part [n, 2], and their distance [n]."""
    _, component = vertex_components(faces, len(positions))
    candidates = _boundary_vertices(faces)
    pairs = np.stack([candidates, candidates], axis=1)
    distances = np.full(len(candidates), np.inf)
    for part in np.unique(component[candidates]):
        is_own = component[candidates] == part
        if is_own.all():
            break
        distances[is_own], nearest = KDTree(positions[candidates[~is_own]]).query(
            positions[candidates[is_own]]
        )
        pairs[is_own, 1] = candidates[~is_own][nearest]
    return pairs, distances


def largest_component(positions: Positions, faces: Faces) -> Cleaned:
    """Keep the connected part with the largest area."""
    _, component = vertex_components(faces, len(positions))
    owner = component[faces[:, 0]]
    largest = np.argmax(np.bincount(owner, weights=face_areas(positions, faces)))
    return _select_faces(positions, faces, np.flatnonzero(owner == largest), np.arange(len(positions)))


def consistent_orientation(positions: Positions, faces: Faces) -> Bool[np.ndarray, " faces"]:
    """Return which faces to turn so that neighbours agree; most of each part's area stays unturned.

    Edges with more than two faces and one-sided surfaces are left for `validate_mesh` to refuse.
    """
    starts, _, _ = half_edges(faces)
    _, edge, counts = undirected_edges(faces)
    order = np.argsort(edge, kind="stable")
    begin = (np.cumsum(counts) - counts)[counts == 2]
    first, second = order[begin], order[begin + 1]
    agrees = starts[first] != starts[second]  # neighbours run along their edge in opposite directions
    # Every face stands for two nodes, itself and its turned copy. Each is joined to the copy of the neighbour
    # that agrees with it, so a part falls into two components, one with every face's better side.
    num_faces = len(faces)
    left, right = first // 3, second // 3
    shift = np.where(agrees, 0, num_faces)
    rows = np.concatenate([left, left + num_faces])
    columns = np.concatenate([right + shift, right + num_faces - shift])
    graph = scipy.sparse.coo_array(
        (np.ones(len(rows), bool), (rows, columns)), (2 * num_faces, 2 * num_faces)
    )
    _, sheet = connected_components(graph, directed=False)
    sheet, turned_sheet = sheet[:num_faces], sheet[num_faces:]
    areas = np.bincount(sheet, weights=face_areas(positions, faces), minlength=2 * num_faces)
    # As of a pattern's front and back.
    is_tie = (areas[turned_sheet] == areas[sheet]) & (turned_sheet < sheet)
    return (areas[turned_sheet] > areas[sheet]) | is_tie


def _select_faces(
    positions: np.ndarray, faces: np.ndarray, kept: np.ndarray, vertex_map: np.ndarray
) -> Cleaned:
    """Keep some faces and the vertices they use, and renumber; `vertex_map` is that of `faces`."""
    used = np.unique(faces[kept])
    number = np.full(len(positions), -1)
    number[used] = np.arange(len(used))
    return Cleaned(positions[used], number[faces[kept]], number[vertex_map], kept)


def _boundary_vertices(faces: np.ndarray) -> np.ndarray:
    """Return the vertices on edges of a single face, in ascending order; the mesh may be broken."""
    edges, _, counts = undirected_edges(faces)
    return np.unique(edges[counts == 1])
