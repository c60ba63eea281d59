"""Compact groups of neighbouring points, and search tables of a body surface (host)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from eslr_jax.mesh.padding import round_up
from eslr_jax.mesh.topology import (
    face_areas,
    incidence_table,
    is_on_boundary,
    moved_incidence,
    unique_edges,
    vertex_areas,
)
from eslr_jax.numerics import to_device
from eslr_jax.types import BodySurface, Obstacle

# Vertices, faces or edges in a group; more make the first level cheaper and the second dearer.
_PATCH_SIZE = 16

# A part of a body of so many vertices or more is padded, by an eighth at most: then most motions of a garment,
# which reaches a little more or less of it in each, share programs; a T-shirt's frame at 1k takes 4 % longer.
_SHARED, _STEPS = 1024, 8
_FAR = 1e3  # [m] from the origin along all axes, where padded vertices of a body are


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


def prepare_surface(rest_positions: np.ndarray, faces: np.ndarray) -> BodySurface:
    """Build the search tables of a body surface from its vertices in a pose without self-contact [m].

    Only the vertices of the faces to keep are kept. Where those end, as at a wrist without its hand, cloth beyond
    is not in contact.
    """
    vertex_ids, flat = np.unique(faces, return_inverse=True)
    faces = flat.reshape(-1, 3)
    positions = np.asarray(rest_positions, np.float64)[vertex_ids]
    edges = unique_edges(faces)
    _, place = np.unique(positions, axis=0, return_inverse=True)  # at a seam of its mesh a body does not end
    place = place.reshape(-1)
    surface = BodySurface(
        vertex_ids=vertex_ids,
        faces=faces,
        face_incidence=incidence_table(faces, len(positions)),
        patch_vertices=compact_groups(positions, _PATCH_SIZE),
        face_blocks=compact_groups(positions[faces].mean(axis=1), _PATCH_SIZE),
        edges=edges,
        edge_blocks=compact_groups(positions[edges].mean(axis=1), _PATCH_SIZE),
        is_boundary=is_on_boundary(place[faces], len(positions))[place],
        vertex_areas=vertex_areas(face_areas(positions, faces), faces, len(positions)),
    )
    return to_device(surface)


def pad_surface(surface: BodySurface) -> BodySurface:
    """Pad a large surface to a number of vertices that others have, with twice the faces and thrice the edges.

    Padded faces and edges point at the last vertex. What is padded is in groups of its own, which are far away
    (`pad_body`), so no search looks into them. The `vertex_ids` of padded vertices name no vertex of the body.
    """
    have = len(surface.vertex_ids)
    num_vertices = round_up(have + 1, _STEPS)
    is_sheet = len(surface.faces) <= 2 * num_vertices and len(surface.edges) <= 3 * num_vertices
    if have < _SHARED or not is_sheet:
        return surface
    last, num_faces, num_edges = num_vertices - 1, 2 * num_vertices, 3 * num_vertices

    def longer(values: np.ndarray, rows: int, value: int) -> np.ndarray:
        values = np.asarray(values)
        return np.pad(values, [(0, rows - len(values)), *[(0, 0)] * (values.ndim - 1)], constant_values=value)

    def grouped(groups: np.ndarray, first: int, count: int) -> np.ndarray:
        groups = np.asarray(groups)
        size = groups.shape[1]
        added = first + np.arange((-(-count // size) - len(groups)) * size, dtype=groups.dtype)
        return np.concatenate([groups, np.minimum(added, count - 1).reshape(-1, size)])

    degree = 2 * -(-surface.face_incidence.shape[1] // 2)
    return BodySurface(
        vertex_ids=longer(surface.vertex_ids, num_vertices, np.iinfo(np.int32).max),
        faces=longer(surface.faces, num_faces, last),
        face_incidence=moved_incidence(
            np.asarray(surface.face_incidence), 3, len(surface.faces), num_faces, num_vertices, degree
        ),
        patch_vertices=grouped(surface.patch_vertices, have, num_vertices),
        face_blocks=grouped(surface.face_blocks, len(surface.faces), num_faces),
        edges=longer(surface.edges, num_edges, last),
        edge_blocks=grouped(surface.edge_blocks, len(surface.edges), num_edges),
        is_boundary=longer(surface.is_boundary, num_vertices, False),
        vertex_areas=longer(surface.vertex_areas, num_vertices, 0),
    )


def pad_body(body: Obstacle) -> Obstacle:
    """Return a body with a padded surface, see `pad_surface`; padded vertices are far from any cloth."""
    surface, positions = pad_surface(body.surface), np.asarray(body.positions)
    added = ((0, 0), (0, len(surface.vertex_ids) - positions.shape[1]), (0, 0))
    return Obstacle(surface, np.pad(positions, added, constant_values=_FAR))
