"""Geodesic distances on a triangle mesh, and embeddings that follow them.

Distances are Dijkstra's over mesh edges and unfolded shortcuts. A shortcut is a straight segment between two
vertices that crosses up to three hinges after their faces are unfolded into a plane. It is a path on the surface,
so distances are upper bounds and form a metric; those of the heat method do neither. An exact solver (pygeodesic)
takes a hundred times as long a source, and joins no components. The mean error is 0.4 % on garments and 1.1 % on
a tube of right triangles. With shortcuts over one hinge it is 1.3 % and 3.9 %, with edges alone 6 % and 16 %.

An embedding has k coordinates per vertex, whose distances follow geodesic distances on the rest mesh: metric
multidimensional scaling by stress majorisation against landmarks, so memory is landmarks x vertices. Classical
scaling alone gets worse with k: geodesic distances are not Euclidean, and its later axes are noise. Three modes:

- `raw`: landmark classical scaling, then majorisation. This is the paper's embedding. Its axes and signs come
  from an eigendecomposition, so two meshes of one garment get incompatible coordinates.
- `canonical`: majorisation of the same stress from a smooth function of the rest pose: centred coordinates,
  then small monomials. The result is rotated back onto the body's axes. Its first three coordinates are the
  body's axes bent to geodesic lengths, and no eigenvector is involved, so nothing flips between meshes.
- `landmarks`: a decaying function of the geodesic distance to the corners of the bounding box.
"""

from __future__ import annotations

import itertools
from typing import Literal, get_args

import numpy as np
import scipy.sparse
from jaxtyping import Float, Int
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import KDTree

from eslr_jax.errors import ConfigError
from eslr_jax.mesh import topology
from eslr_jax.mesh.closest import closest_points

_MAX_HINGES = 3  # that a shortcut crosses

EmbeddingMode = Literal["raw", "canonical", "landmarks"]

NUM_LANDMARKS = 128  # landmarks of the stress; 64 and 256 differ by less than 0.002 in stress
NUM_ITERATIONS = 60  # majorisation steps; stress falls by less than 0.001 beyond
START_AMPLITUDE = 0.2  # size of the monomials in the canonical start, relative to the garment's size
ANCHOR_FALLOFF = 0.4  # [m] decay length of mode `landmarks`, about the size of a limb


def geodesic_graph(
    positions: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> scipy.sparse.csr_array:
    """Return the symmetric sparse matrix of edge lengths [m]: mesh edges, unfolded shortcuts and bridges.

    A bridge joins the nearest vertices of two components by their Euclidean distance, so that every distance is
    finite.
    """
    edges = topology.unique_edges(faces)
    lengths = np.linalg.norm(positions[edges[:, 0]] - positions[edges[:, 1]], axis=1)
    shortcuts, shortcut_lengths = unfolded_shortcuts(positions, faces)
    bridges, bridge_lengths = _bridges(positions, faces)
    pairs = np.concatenate([edges, shortcuts, bridges])
    values = np.concatenate([lengths, shortcut_lengths, bridge_lengths])
    order = np.lexsort((values, pairs.max(axis=1), pairs.min(axis=1)))
    pairs, values = np.sort(pairs[order], axis=1), values[order]
    keep = np.ones(len(pairs), bool)
    keep[1:] = np.any(pairs[1:] != pairs[:-1], axis=1)  # the shortest of parallel edges
    rows, columns = np.concatenate([pairs[keep], pairs[keep][:, ::-1]]).T
    shape = (len(positions), len(positions))
    return scipy.sparse.csr_array((np.tile(values[keep], 2), (rows, columns)), shape)


def geodesic_distances(
    graph: scipy.sparse.csr_array, sources: Int[np.ndarray, " sources"]
) -> Float[np.ndarray, "sources vertices"]:
    """Return the distance from every source vertex to every vertex [m], shape [sources, vertices]."""
    return np.atleast_2d(dijkstra(graph, indices=sources))


def farthest_point_landmarks(
    graph: scipy.sparse.csr_array, count: int, *, first: int = 0
) -> tuple[Int[np.ndarray, " landmarks"], Float[np.ndarray, "landmarks vertices"]]:
    """Return landmarks, each farthest from the ones before, and their distances to every vertex [m].

    `graph` is connected and has edge lengths [m]; there are at most as many landmarks as vertices.
    """
    landmarks, distances = [first], [dijkstra(graph, indices=first)]
    nearest = distances[0]
    for _ in range(min(count, graph.indptr.size - 1) - 1):
        landmarks.append(int(np.argmax(nearest)))
        distances.append(dijkstra(graph, indices=landmarks[-1]))
        nearest = np.minimum(nearest, distances[-1])
    return np.array(landmarks), np.array(distances)


def unfolded_shortcuts(
    positions: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> tuple[Int[np.ndarray, "shortcuts 2"], Float[np.ndarray, " shortcuts"]]:
    """Return vertex pairs joined by straight segments across one to three unfolded hinges, with lengths [m].

    Each vertex looks through the opposite side of each of its faces, and on through the faces behind. All are
    laid out in one plane with the vertex at the origin. A window is the side looked through, with the cone of
    directions that reach it. A pair may occur in both directions.
    """
    starts, ends, opposites = topology.half_edges(faces)
    twins = topology.twin_half_edges(faces)
    edges = positions[ends] - positions[starts]
    arms = positions[opposites] - positions[starts]
    lengths = np.linalg.norm(edges, axis=1)
    along = np.sum(edges * arms, axis=1) / lengths  # of the opposite vertex, from the half-edge's start [m]
    height = np.linalg.norm(np.cross(edges, arms), axis=1) / lengths  # of the opposite vertex above it [m]
    tolerance = 1e-12 * float(np.mean(lengths)) ** 2

    sources = opposites
    sides = np.arange(len(starts))
    right = np.stack([-along, -height], axis=1)  # the side's start, seen from the source
    left = np.stack([lengths - along, -height], axis=1)  # the side's end, counter-clockwise of `right`
    low, high = right, left  # the cone's bounds
    pairs, segments = [], []
    for _ in range(_MAX_HINGES):
        sides = twins[sides]
        windows = (sources, sides, right, left, low, high)
        sources, sides, right, left, low, high = (array[sides >= 0] for array in windows)
        axis = (right - left) / lengths[sides][:, None]  # the twin runs from left to right
        upwards = np.stack([-axis[:, 1], axis[:, 0]], axis=1)
        apex = left + along[sides][:, None] * axis + height[sides][:, None] * upwards
        from_low, to_high = _cross(low, apex), _cross(apex, high)
        is_seen = (from_low >= -tolerance) & (to_high >= -tolerance)
        pairs.append(np.stack([sources[is_seen], opposites[sides[is_seen]]], axis=1))
        segments.append(np.linalg.norm(apex[is_seen], axis=1))
        # behind the hinge: the side right -> apex for directions below the apex, apex -> left above it
        below, above = from_low > tolerance, to_high > tolerance
        to_right = topology.next_half_edges(sides)
        to_left = topology.next_half_edges(to_right)
        lowest = np.where((from_low > 0)[:, None], apex, low)
        highest = np.where((to_high > 0)[:, None], apex, high)
        sources = np.concatenate([sources[below], sources[above]])
        sides = np.concatenate([to_right[below], to_left[above]])
        low = np.concatenate([low[below], lowest[above]])
        high = np.concatenate([highest[below], high[above]])
        right, left = (
            np.concatenate([right[below], apex[above]]),
            np.concatenate([apex[below], left[above]]),
        )
    joined, values = np.concatenate(pairs), np.concatenate(segments)
    is_pair = joined[:, 0] != joined[:, 1]
    return joined[is_pair], values[is_pair]


def _cross(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the plane cross product; positive where `second` is counter-clockwise of `first`."""
    return first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]


def _bridges(positions: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return one vertex pair for every component but the first, in Prim's order, and their distances [m]."""
    num_components, component = topology.vertex_components(faces, len(positions))
    pairs, lengths = [], []
    is_joined = component == component[0] if len(component) else np.zeros(0, bool)
    best = np.full(len(positions), np.inf)  # distance of an outside vertex to the joined part
    partner = np.zeros(len(positions), np.int64)
    fresh = np.flatnonzero(is_joined)
    for _ in range(num_components - 1):
        outside = np.flatnonzero(~is_joined)
        distance, index = map(np.asarray, KDTree(positions[fresh]).query(positions[outside]))
        is_closer = distance < best[outside]
        best[outside[is_closer]] = distance[is_closer]
        partner[outside[is_closer]] = fresh[index[is_closer]]
        vertex = int(outside[np.argmin(best[outside])])
        pairs.append((int(partner[vertex]), vertex))
        lengths.append(max(float(best[vertex]), 1e-9))  # a sparse graph drops edges of length zero
        fresh = np.flatnonzero(component == component[vertex])
        is_joined[fresh] = True
    return np.array(pairs, np.int64).reshape(-1, 2), np.array(lengths)


def geodesic_embedding(
    rest_positions: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    size: int = 8,
    mode: EmbeddingMode = "canonical",
) -> Float[np.ndarray, "vertices embedding"]:
    """Embed a rest mesh so that distances between rows follow geodesic distances.

    Args:
        rest_positions: Vertex positions in the body's rest pose [m], shape [vertices, 3]; the axes are the
            body's left, up and front.
        faces: Triangles, shape [faces, 3].
        size: Number of coordinates per vertex, k.
        mode: Kind of embedding; see the module's docstring.

    Returns:
        Embedding [m], shape [vertices, size], with zero area-weighted mean in modes `raw` and `canonical`.

    Raises:
        ConfigError: The mode is unknown.

    Source: metric scaling by majorisation, de Leeuw 1977; landmark start, de Silva and Tenenbaum 2004.
    """
    if mode not in get_args(EmbeddingMode):
        raise ConfigError(
            f"embedding_mode {mode!r} is unknown; use one of {', '.join(get_args(EmbeddingMode))}"
        )
    rest_positions, faces = np.asarray(rest_positions, np.float64), np.asarray(faces)
    graph = geodesic_graph(rest_positions, faces)
    if mode == "landmarks":
        return anchor_coordinates(graph, rest_positions, faces, size)
    areas = topology.face_areas(rest_positions, faces)
    areas = topology.vertex_areas(areas, faces, len(rest_positions))
    weights = areas / areas.sum()
    first = int(np.argmax(rest_positions @ np.array([1e-3, 1.0, 1e-4])))  # the top; ties broken
    landmarks, distances = farthest_point_landmarks(graph, max(NUM_LANDMARKS, 4 * size), first=first)
    if mode == "raw":
        start = classical_scaling(landmarks, distances, size)
    else:
        start = canonical_start(rest_positions, weights, size)
    embedding = majorize_stress(start, landmarks, distances)
    embedding = embedding - weights @ embedding
    return embedding if mode == "raw" else align(embedding, start, weights)


def classical_scaling(landmarks: np.ndarray, distances: np.ndarray, size: int) -> np.ndarray:
    """Return the landmark classical scaling [m], shape [vertices, size], with zeros beyond the last real axis."""
    squared = distances[:, landmarks] ** 2
    mean = squared.mean(axis=0)
    gram = -0.5 * (squared - mean - mean[:, None] + mean.mean())
    values, vectors = np.linalg.eigh(gram)
    order = np.argsort(-values)[:size]
    values, vectors = values[order], vectors[:, order]
    is_real = values > 1e-9 * max(values[0], 1e-30)
    scaled = np.where(is_real, vectors / np.sqrt(np.where(is_real, values, 1.0)), 0.0)
    embedding = -0.5 * (distances.T**2 - mean) @ scaled
    return np.pad(embedding, ((0, 0), (0, size - embedding.shape[1])))


def canonical_start(
    rest_positions: Float[np.ndarray, "vertices 3"], weights: Float[np.ndarray, " vertices"], size: int
) -> Float[np.ndarray, "vertices embedding"]:
    """Return centred rest positions followed by small monomials of them without their linear part [m].

    Every column is a smooth function of the rest position, so a finer mesh samples the same functions.
    """
    centered = rest_positions - weights @ rest_positions
    scale = np.sqrt(weights @ np.sum(centered**2, axis=1))
    unit = centered / scale
    monomials = [
        unit[:, list(axes)].prod(axis=1)
        for degree in (2, 3, 4)
        for axes in itertools.combinations_with_replacement(range(3), degree)
    ][: max(size - 3, 0)]
    columns = [centered]
    if monomials:
        linear = np.column_stack([np.ones(len(unit)), unit])
        root = np.sqrt(weights)[:, None]
        folds = np.stack(monomials, axis=1)
        fit = np.linalg.lstsq(root * linear, root * folds, rcond=None)[0]
        columns.append(START_AMPLITUDE * scale * (folds - linear @ fit))
    start = np.concatenate(columns, axis=1)[:, :size]
    return np.pad(start, ((0, 0), (0, size - start.shape[1])))


def majorize_stress(embedding: np.ndarray, landmarks: np.ndarray, distances: np.ndarray) -> np.ndarray:
    """Reduce the stress of an embedding by landmark majorisation (SMACOF with all-to-landmark weights).

    A step moves vertex x to the mean over landmarks y_l of y_l + d_l (x - y_l) / |x - y_l|, where d_l is the
    geodesic distance [landmarks, vertices].
    """
    targets = np.ascontiguousarray(distances.T)
    for _ in range(NUM_ITERATIONS):
        anchors = embedding[landmarks]
        lengths = embedding @ (-2.0 * anchors.T)
        lengths += np.sum(embedding**2, axis=1)[:, None]
        lengths += np.sum(anchors**2, axis=1)
        np.sqrt(np.maximum(lengths, 1e-18, out=lengths), out=lengths)
        ratios = np.divide(targets, lengths, out=lengths)
        pulled = embedding * ratios.sum(axis=1)[:, None] - ratios @ anchors
        embedding = (anchors.sum(axis=0) + pulled) / len(landmarks)
    return embedding


def align(embedding: np.ndarray, start: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Rotate a centred embedding so that its first three axes fit those of `start` by weighted least squares.

    Majorisation leaves the axes close to those of `start`, so the result is no reflection.
    """
    count = min(3, embedding.shape[1])
    left, _, right = np.linalg.svd((weights[:, None] * embedding).T @ start[:, :count], full_matrices=False)
    target = left @ right  # [size, count]: the new axes in old coordinates
    complement = np.eye(len(target))[:, count:]
    complement = complement - target @ (target.T @ complement)
    left, _, right = np.linalg.svd(complement, full_matrices=False)
    return embedding @ np.concatenate([target, left @ right], axis=1)


def anchor_coordinates(
    graph: scipy.sparse.csr_array,
    rest_positions: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    size: int,
) -> Float[np.ndarray, "vertices embedding"]:
    """Return L exp(-d / L) [m] for the geodesic distance d to each corner of the bounding box, L = 0.4 m."""
    low, high = rest_positions.min(axis=0), rest_positions.max(axis=0)
    anchors = np.resize(
        low + np.array(list(itertools.product((0.0, 1.0), repeat=3))) * (high - low), (size, 3)
    )
    nearest, barycentric = closest_points(anchors, rest_positions, faces)
    corners = faces[nearest]  # three sources an anchor: the nearest vertex alone would jump between meshes
    gaps = np.linalg.norm(np.einsum("ac,acx->ax", barycentric, rest_positions[corners]) - anchors, axis=1)
    from_corners = geodesic_distances(graph, corners.ravel()).reshape(*corners.shape, -1)
    distances = np.einsum("ac,acv->va", barycentric, from_corners)
    return ANCHOR_FALLOFF * np.exp(-(distances + gaps) / ANCHOR_FALLOFF)
