"""Geodesic embeddings: k coordinates per vertex whose distances follow geodesic distances on the rest mesh.

The method is metric multidimensional scaling by stress majorisation against landmarks, so memory is landmarks
x vertices. Classical scaling alone gets worse with k: geodesic distances are not Euclidean, and its later axes
are noise.

Three modes:
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

from eslr_jax.errors import ConfigError
from eslr_jax.mesh.closest import closest_points
from eslr_jax.mesh.geodesic import farthest_point_landmarks, geodesic_distances, geodesic_graph
from eslr_jax.mesh.topology import face_areas, vertex_areas

EmbeddingMode = Literal["raw", "canonical", "landmarks"]

NUM_LANDMARKS = 128  # landmarks of the stress; 64 and 256 differ by less than 0.002 in stress
NUM_ITERATIONS = 60  # majorisation steps; stress falls by less than 0.001 beyond
START_AMPLITUDE = 0.2  # size of the monomials in the canonical start, relative to the garment's size
ANCHOR_FALLOFF = 0.4  # [m] decay length of mode `landmarks`, about the size of a limb


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
    areas = vertex_areas(face_areas(rest_positions, faces), faces, len(rest_positions))
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
