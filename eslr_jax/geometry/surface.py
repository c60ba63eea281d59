"""Search tables of a body surface, built once per scene on the host."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from scipy.spatial import cKDTree

from eslr_jax.geometry.topology import incidence_table
from eslr_jax.types import BodySurface

_PATCH_SIZE = 16  # most vertices per patch; more make the first level cheaper and the second dearer
_CANDIDATE_FACES = 20  # faces tried around the nearest vertex: its own and most of its neighbours'


def prepare_surface(
    rest_positions: np.ndarray, faces: np.ndarray, *, boundary: np.ndarray | None = None
) -> BodySurface:
    """Build the search tables of a body surface.

    Args:
        rest_positions: All body vertices in any pose without self-contact [m], shape [body_vertices, 3].
        faces: The faces to keep, shape [surface_faces, 3]; other vertices are dropped.
        boundary: Body vertices where the body goes on with faces that are not kept, shape [boundary_vertices];
            cloth beyond them is not in contact. None if all that the body has is kept.
    """
    vertex_ids, flat = np.unique(faces, return_inverse=True)
    faces = flat.reshape(-1, 3)
    positions = np.asarray(rest_positions, np.float64)[vertex_ids]
    centers, patch_vertices = _patches(positions)
    return BodySurface(
        vertex_ids=jnp.asarray(vertex_ids, jnp.int32),
        faces=jnp.asarray(faces, jnp.int32),
        face_incidence=jnp.asarray(incidence_table(faces, len(positions)), jnp.int32),
        patch_centers=jnp.asarray(centers, jnp.int32),
        patch_vertices=jnp.asarray(patch_vertices, jnp.int32),
        vertex_faces=jnp.asarray(_candidate_faces(positions, faces), jnp.int32),
        is_boundary=jnp.asarray(np.isin(vertex_ids, [] if boundary is None else boundary)),
    )


def _patches(positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Split vertices into compact patches of nearly equal size; return each one's medoid and its members."""
    pending, members = [np.arange(len(positions))], []
    while pending:
        ids = pending.pop()
        if len(ids) <= _PATCH_SIZE:
            members.append(ids)
            continue
        axis = np.argmax(np.ptp(positions[ids], axis=0))
        ordered = ids[np.argsort(positions[ids, axis], kind="stable")]
        pending += [ordered[: len(ids) // 2], ordered[len(ids) // 2 :]]
    centers = [
        ids[np.argmin(np.linalg.norm(positions[ids] - positions[ids].mean(axis=0), axis=1))]
        for ids in members
    ]
    return np.array(centers), np.stack([np.resize(ids, max(map(len, members))) for ids in members])


def _candidate_faces(positions: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """For each vertex its own faces, then the nearest of the faces around it."""
    centroids = positions[faces].mean(axis=1)
    count = min(_CANDIDATE_FACES, len(faces))
    _, nearest = cKDTree(centroids).query(positions, k=2 * count if 2 * count <= len(faces) else count)
    nearest = nearest.reshape(len(positions), -1)
    is_own = (faces[nearest] == np.arange(len(positions))[:, None, None]).any(axis=-1)
    order = np.argsort(~is_own, axis=1, kind="stable")
    return np.take_along_axis(nearest, order, axis=1)[:, :count]
