"""Where the threads of a fabric run on a garment's faces."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from eslr_jax.errors import MeshError
from eslr_jax.mesh.plate import rest_corners
from eslr_jax.mesh.topology import normalize
from eslr_jax.types import Garment

_UP = (0.0, 1.0, 0.0)
_LEAST = 1e-3  # length of a direction's projection below which a face does not see it


def warp_directions(
    garment: Garment,
    corner_uvs: Float[np.ndarray, "faces 3 2"] | None = None,
    *,
    direction: Sequence[float] = _UP,
) -> Float[np.ndarray, "faces 2"]:
    """Return the direction of the warp on every real face: a unit vector in the frame of `plate.rest_corners`.

    Patterns are cut and drawn with the warp along the second texture coordinate. Without texture coordinates,
    or where a face has none, the warp runs along a direction laid onto the rest mesh: by default up, as in a
    garment whose pieces hang along the grain. A face that lies across it takes the mean of the faces around
    it, or if there is none its own first edge.

    Args:
        garment: Prepared garment.
        corner_uvs: Texture coordinates of the corners of its faces.
        direction: Where the warp runs without them, any length.

    Raises:
        MeshError: The texture coordinates fit another mesh, or the direction is no direction.
    """
    corners = rest_corners(garment)
    warp = _laid(garment, corners, direction)
    if corner_uvs is None:
        return warp
    uvs = np.asarray(corner_uvs, np.float64)
    if uvs.shape != corners.shape:
        raise MeshError(f"texture coordinates of shape {uvs.shape} don't fit {len(corners)} faces")
    in_plane, in_texture = (np.stack([x[:, 0] - x[:, 2], x[:, 1] - x[:, 2]], axis=2) for x in (corners, uvs))
    determinant = np.linalg.det(in_texture)
    is_mapped = np.abs(determinant) > 1e-12
    columns = np.linalg.solve(
        np.where(is_mapped[:, None, None], in_texture, np.eye(2)), np.array([[0.0], [1.0]])
    )
    along = normalize((in_plane @ columns)[:, :, 0])
    return np.where(is_mapped[:, None], along, warp)


def _laid(garment: Garment, corners: np.ndarray, direction: Sequence[float]) -> np.ndarray:
    """Return a direction of space in the plane of every face."""
    wanted = np.asarray(direction, np.float64)
    if wanted.shape != (3,) or not np.linalg.norm(wanted) > 0:
        raise MeshError(f"{direction} is no direction; give three numbers")
    positions, faces = (
        np.asarray(garment.rest_positions, np.float64),
        np.asarray(garment.faces)[: len(corners)],
    )
    points = positions[faces]
    first = normalize(points[:, 0] - points[:, 2])
    normal = normalize(np.cross(points[:, 0] - points[:, 2], points[:, 1] - points[:, 2]))

    def laid(vectors: np.ndarray) -> np.ndarray:
        return vectors - np.vecdot(normal, vectors)[:, None] * normal

    seen = laid(wanted / np.linalg.norm(wanted))
    while (is_blind := np.linalg.norm(seen, axis=1) < _LEAST).any():
        around = np.zeros_like(positions)
        known = normalize(np.where(is_blind[:, None], 0.0, seen))
        np.add.at(around, faces.ravel(), np.repeat(known, 3, axis=0))
        mean = laid(around[faces].sum(axis=1))
        is_found = is_blind & (np.linalg.norm(mean, axis=1) > _LEAST)
        if not is_found.any():  # no face beside it sees the direction
            seen = np.where(is_blind[:, None], first, seen)
            break
        seen = np.where(is_found[:, None], mean, seen)
    second = np.cross(normal, first)
    return normalize(np.stack([np.vecdot(seen, first), np.vecdot(seen, second)], axis=1))
