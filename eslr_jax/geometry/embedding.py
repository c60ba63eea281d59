"""Geodesic embeddings: k coordinates per vertex whose distances follow geodesic distances on the rest mesh.

Metric multidimensional scaling by stress majorisation against landmarks; memory is landmarks x vertices,
never vertices x vertices. Classical scaling alone gets worse with k: geodesic distances are not Euclidean,
and its later axes are noise that nothing cancels.

Three modes:
- `raw`: landmark classical scaling, then majorisation: the paper's embedding. Axes and signs are those of an
  eigendecomposition, so two meshes of one garment get incompatible coordinates.
- `canonical`: the same stress, reached from a start that is a smooth function of the rest pose (its centred
  coordinates, then small quadratic monomials), and rotated back onto the body's axes by least squares. The
  first three coordinates are the body's axes bent to geodesic lengths, with their signs; the others fold as
  the monomials do. No eigenvector is involved, so nothing flips between meshes.
- `landmarks`: no scaling; a falling function of the geodesic distance to points fixed on the body.
"""

from __future__ import annotations

import itertools
from typing import Literal, get_args

import numpy as np
import scipy.sparse
from jaxtyping import Float, Int

from eslr_jax.errors import ConfigError
from eslr_jax.geometry.closest import closest_points
from eslr_jax.geometry.geodesic import farthest_point_landmarks, geodesic_distances, geodesic_graph
from eslr_jax.geometry.topology import face_areas, vertex_areas

EmbeddingMode = Literal["raw", "canonical", "landmarks"]

NUM_LANDMARKS = 128  # landmarks of the stress; 64 and 256 differ by less than 0.002 in stress
NUM_ITERATIONS = 60  # majorisation steps; stress falls by less than 0.001 beyond
START_AMPLITUDE = 0.2  # size of the monomials in the canonical start, relative to the garment's size
ANCHOR_REACH = 0.25  # [m] an anchor with no garment this near is missing
ANCHOR_FALLOFF = 0.4  # [m] decay length of landmark coordinates, about the size of a limb


def geodesic_embedding(
    rest_positions: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    size: int = 8,
    mode: EmbeddingMode = "canonical",
    anchors: Float[np.ndarray, "anchors 3"] | None = None,
    *,
    body_axes: Float[np.ndarray, "3 3"] | None = None,
) -> Float[np.ndarray, "vertices embedding"]:
    """Embed a rest mesh so that distances between rows follow geodesic distances.

    Args:
        rest_positions: Vertex positions in the body's rest pose [m], shape [vertices, 3].
        faces: Triangles, shape [faces, 3].
        size: Coordinates per vertex, k.
        mode: See the module's docstring.
        anchors: Points of mode `landmarks` [m], one per coordinate, in the rest pose; best on the body's skin,
            since a point deep inside has no one closest point on a garment. By default the corners of the
            garment's bounding box.
        body_axes: Rows are the rest body's left, up and front; by default x, y and z.

    Returns:
        Embedding [m], shape [vertices, size]; zero mean over the area in modes `raw` and `canonical`.

    Raises:
        ConfigError: The mode is unknown, or the number of anchors is not `size`.

    Source: metric scaling by majorisation, de Leeuw 1977; landmark start, de Silva and Tenenbaum 2004.
    """
    if mode not in get_args(EmbeddingMode):
        raise ConfigError(
            f"embedding_mode {mode!r} is unknown; use one of {', '.join(get_args(EmbeddingMode))}"
        )
    axes = np.eye(3) if body_axes is None else np.asarray(body_axes, np.float64)
    rest_positions = np.asarray(rest_positions, np.float64) @ axes.T
    faces = np.asarray(faces)
    graph = geodesic_graph(rest_positions, faces)
    if mode == "landmarks":
        points = None if anchors is None else np.asarray(anchors, np.float64) @ axes.T
        return anchor_coordinates(graph, rest_positions, faces, size, points)
    areas = vertex_areas(face_areas(rest_positions, faces), faces, len(rest_positions))
    weights = areas / areas.sum()
    first = int(np.argmax(rest_positions @ np.array([1e-3, 1.0, 1e-4])))  # the top; ties broken
    landmarks, distances = farthest_point_landmarks(graph, max(NUM_LANDMARKS, 4 * size), first=first)
    if mode == "raw":
        embedding = classical_scaling(landmarks, distances, size)
        embedding = majorize_stress(embedding, landmarks, distances, NUM_ITERATIONS)
        return embedding - weights @ embedding
    start = canonical_start(rest_positions, weights, size)
    embedding = majorize_stress(start, landmarks, distances, NUM_ITERATIONS)
    return align(embedding - weights @ embedding, start, weights)


def classical_scaling(landmarks: np.ndarray, distances: np.ndarray, size: int) -> np.ndarray:
    """Return the landmark classical scaling [m], shape [vertices, size]; axes that do not exist are zero.

    Args:
        landmarks: Landmark vertices, shape [landmarks].
        distances: Geodesic distances [m], shape [landmarks, vertices].
        size: Number of coordinates.
    """
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
    """Return centred rest positions followed by small monomials of them, orthogonal to what is linear [m].

    Every column is a smooth function of the rest position, with area-weighted moments: a finer mesh samples
    the same functions.
    """
    centered = rest_positions - weights @ rest_positions
    scale = np.sqrt(weights @ np.sum(centered**2, axis=1))
    unit = centered / scale
    degrees = (2, 3, 4)
    monomials = [
        unit[:, list(axes)].prod(axis=1)
        for degree in degrees
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


def majorize_stress(
    embedding: np.ndarray, landmarks: np.ndarray, distances: np.ndarray, num_iterations: int
) -> np.ndarray:
    """Return the embedding after steps of landmark stress majorisation (SMACOF with all-to-landmark weights).

    Every vertex moves to the mean of what the landmarks ask for: y_l + d_l (x - y_l) / |x - y_l|.

    Args:
        embedding: Start [m], shape [vertices, size].
        landmarks: Landmark vertices, shape [landmarks].
        distances: Geodesic distances [m], shape [landmarks, vertices].
        num_iterations: Number of steps.
    """
    targets = np.ascontiguousarray(distances.T)
    for _ in range(num_iterations):
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
    """Rotate a centred embedding so that its first three axes fit `start`'s by weighted least squares.

    The rotation acts in the plane of the old and new axes only; a reflection is excluded because majorisation
    leaves the axes close to where they began.
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
    anchors: Float[np.ndarray, "anchors 3"] | None = None,
) -> Float[np.ndarray, "vertices embedding"]:
    """Return L exp(-d / L) [m] for the geodesic distance d to each anchor, L = `ANCHOR_FALLOFF`.

    A coordinate falls with slope one at its anchor and fades to zero far away, so a missing anchor, being
    far, is a column of zeros.

    Raises:
        ConfigError: The number of anchors is not `size`.
    """
    is_default = anchors is None
    if is_default:
        low, high = rest_positions.min(axis=0), rest_positions.max(axis=0)
        corners = np.array(list(itertools.product((0.0, 1.0), repeat=3)))
        anchors = np.resize(low + corners * (high - low), (size, 3))
    if len(anchors) != size:
        raise ConfigError(
            f"{len(anchors)} anchors for an embedding of size {size}; give one anchor per coordinate"
        )
    nearest, barycentric = closest_points(anchors, rest_positions, faces)
    corners = faces[nearest]  # three sources an anchor: the nearest vertex alone would jump between meshes
    gaps = np.linalg.norm(np.einsum("ac,acx->ax", barycentric, rest_positions[corners]) - anchors, axis=1)
    from_corners = geodesic_distances(graph, corners.ravel()).reshape(*corners.shape, -1)
    distances = np.einsum("ac,acv->va", barycentric, from_corners)
    coordinates = ANCHOR_FALLOFF * np.exp(-(distances + gaps) / ANCHOR_FALLOFF)
    return coordinates if is_default else np.where(gaps <= ANCHOR_REACH, coordinates, 0.0)
