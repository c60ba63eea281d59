"""From a garment on a posed body to its place on the resting body, with skin weights."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from eslr_jax.fit.clearance import push_out
from eslr_jax.fit.postures import Posture, rest_posture, unpose
from eslr_jax.geometry.skinning import transfer_skin_weights
from eslr_jax.types import Body

_SMOOTHING = 3  # Laplacian steps over transferred skin weights, as for the bundled shirts
_LOOSE_SMOOTHING = 20  # for skirts, or the two legs tear them, as for the bundled dresses
_LOOSE = 0.05  # [m] from the body; a garment is loose if a tenth of its vertices are farther away


class Rested(NamedTuple):
    """A garment on the resting body."""

    positions: Float[np.ndarray, "vertices 3"]  # [m]
    skin_weights: Float[np.ndarray, "vertices 4"]
    skin_indices: Int[np.ndarray, "vertices 4"]
    penetration: dict[str, Any]  # what was inside the posed body; see `push_out`


def lay_to_rest(
    sewn: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    posture: Posture,
    body: Body,
    *,
    is_pushed: bool = True,
) -> Rested:
    """Return a garment in the body's rest pose, given it in another pose.

    Args:
        sewn: Garment vertices in the posture's pose [m], shape [vertices, 3].
        faces: Triangles, shape [faces, 3].
        posture: The body in that pose.
        body: The body at rest.
        is_pushed: Move vertices that lie inside the body out of it.
    """
    clear, penetration = push_out(sewn, faces, posture) if is_pushed else (sewn, {})
    is_loose = np.quantile(posture.heights(clear), 0.9) > _LOOSE
    weights, indices = transfer_skin_weights(
        clear,
        posture.positions,
        posture.faces,
        np.asarray(body.skin_weights, np.float64),
        np.asarray(body.skin_indices),
        smoothing_steps=_LOOSE_SMOOTHING if is_loose else _SMOOTHING,
        faces=faces,
    )
    rest = clear
    if not np.array_equal(posture.transforms, np.broadcast_to(np.eye(3, 4), posture.transforms.shape)):
        rest = unpose(clear, weights, indices, posture.transforms)
        rest = push_out(rest, faces, rest_posture(body))[0] if is_pushed else rest
    return Rested(rest, weights, indices, penetration)
