"""Compact groups of neighbouring points, and search tables of a body surface (host)."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from eslr_jax.mesh.topology import face_areas, incidence_table, unique_edges, vertex_areas
from eslr_jax.types import BodySurface

# Vertices, faces or edges in a group; more make the first level cheaper and the second dearer.
_PATCH_SIZE = 16


def compact_groups(points: Float[np.ndarray, "points 3"], size: int) -> Int[np.ndarray, "groups size"]:
    """Split points into compact groups, which searches handle together; the last one repeats its last point.

    The set is halved along its longest side again and again, at a multiple of `size`, so the number of groups
    depends on the number of points alone.
    """
    pending, groups = [np.arange(len(points))], []
    while pending:
        ids = pending.pop()
        if len(ids) <= size:
            groups.append(np.pad(ids, (0, size - len(ids)), mode="edge"))
            continue
        ordered = ids[np.argsort(points[ids, np.argmax(np.ptp(points[ids], axis=0))], kind="stable")]
        middle = -(-len(ids) // (2 * size)) * size
        pending += [ordered[middle:], ordered[:middle]]
    return np.stack(groups)


def prepare_surface(
    rest_positions: np.ndarray, faces: np.ndarray, *, boundary: np.ndarray | None = None
) -> BodySurface:
    """Build the search tables of a body surface from its vertices in a pose without self-contact [m].

    Only the vertices of the faces to keep are kept. At `boundary` vertices the body goes on with faces that are
    not kept: cloth beyond them is not in contact.
    """
    vertex_ids, flat = np.unique(faces, return_inverse=True)
    faces = flat.reshape(-1, 3)
    positions = np.asarray(rest_positions, np.float64)[vertex_ids]
    edges = unique_edges(faces)
    return BodySurface(
        vertex_ids=jnp.asarray(vertex_ids, jnp.int32),
        faces=jnp.asarray(faces, jnp.int32),
        face_incidence=jnp.asarray(incidence_table(faces, len(positions)), jnp.int32),
        patch_vertices=jnp.asarray(compact_groups(positions, _PATCH_SIZE), jnp.int32),
        face_blocks=jnp.asarray(compact_groups(positions[faces].mean(axis=1), _PATCH_SIZE), jnp.int32),
        edges=jnp.asarray(edges, jnp.int32),
        edge_blocks=jnp.asarray(compact_groups(positions[edges].mean(axis=1), _PATCH_SIZE), jnp.int32),
        is_boundary=jnp.asarray(np.isin(vertex_ids, [] if boundary is None else boundary)),
        vertex_areas=jnp.asarray(
            vertex_areas(face_areas(positions, faces), faces, len(positions)), jnp.float32
        ),
    )
