"""Skin weights of a garment, taken from the body beneath it."""

from __future__ import annotations

import numpy as np
import scipy.sparse
from jaxtyping import Float, Int

from eslr_jax.mesh.closest import closest_points
from eslr_jax.mesh.topology import unique_edges

MAX_INFLUENCES = 4


def transfer_skin_weights(
    positions: Float[np.ndarray, "vertices 3"],
    body_positions: Float[np.ndarray, "body_vertices 3"],
    body_faces: Int[np.ndarray, "body_faces 3"],
    body_skin_weights: Float[np.ndarray, "body_vertices influences"],
    body_skin_indices: Int[np.ndarray, "body_vertices influences"],
    *,
    faces: Int[np.ndarray, "faces 3"],
    smoothing_steps: int = 10,
) -> tuple[Float[np.ndarray, "vertices 4"], Int[np.ndarray, "vertices 4"]]:
    """Take each garment vertex's weights from the closest body point, then smooth them over the garment.

    Positions are in the body's rest pose [m]. Loose skirts need about 20 Laplacian smoothings: the two legs tear
    them otherwise. The result is the four largest weights of every vertex, which sum to one, and their joints.
    """
    nearest, barycentric = closest_points(positions, body_positions, body_faces)
    corners = body_faces[nearest]
    num_vertices, num_joints = len(positions), int(body_skin_indices.max()) + 1
    weights = np.zeros((num_vertices, max(num_joints, MAX_INFLUENCES)))
    values = barycentric[:, :, None] * body_skin_weights[corners]
    rows = np.broadcast_to(np.arange(num_vertices)[:, None, None], values.shape)
    np.add.at(weights, (rows, body_skin_indices[corners]), values)
    weights = smooth(weights, faces, smoothing_steps)
    joints = np.argsort(-weights, axis=1, kind="stable")[:, :MAX_INFLUENCES]
    top = np.take_along_axis(weights, joints, axis=1)
    return top / top.sum(axis=1, keepdims=True), joints.astype(np.int32)


def smooth(
    values: Float[np.ndarray, "vertices features"], faces: Int[np.ndarray, "faces 3"], num_steps: int
) -> Float[np.ndarray, "vertices features"]:
    """Replace every vertex's value by its mean with the neighbours' mean, `num_steps` times."""
    edges = unique_edges(faces)
    rows, columns = np.concatenate([edges, edges[:, ::-1]]).T
    degrees = np.maximum(np.bincount(rows, minlength=len(values)), 1)
    shape = (len(values), len(values))
    mean = scipy.sparse.csr_array((1.0 / degrees[rows], (rows, columns)), shape)
    for _ in range(num_steps):
        values = 0.5 * values + 0.5 * (mean @ values)
    return values
