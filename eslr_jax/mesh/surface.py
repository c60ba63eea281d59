"""Search tables of a body surface, built once per scene on the host."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from eslr_jax.mesh.groups import compact_groups
from eslr_jax.mesh.topology import face_areas, incidence_table, vertex_areas
from eslr_jax.types import BodySurface

_PATCH_SIZE = 16  # vertices in a patch; more make the first level cheaper and the second dearer


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
    return BodySurface(
        vertex_ids=jnp.asarray(vertex_ids, jnp.int32),
        faces=jnp.asarray(faces, jnp.int32),
        face_incidence=jnp.asarray(incidence_table(faces, len(positions)), jnp.int32),
        patch_vertices=jnp.asarray(compact_groups(positions, _PATCH_SIZE), jnp.int32),
        is_boundary=jnp.asarray(np.isin(vertex_ids, [] if boundary is None else boundary)),
        vertex_areas=jnp.asarray(
            vertex_areas(face_areas(positions, faces), faces, len(positions)), jnp.float32
        ),
    )
