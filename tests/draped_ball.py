"""The smallest garment on the smallest moving body: a square of cloth over a ball that drifts."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from cloth import grid_faces

from eslr_jax import prepare_garment
from eslr_jax.mesh.surface import prepare_surface
from eslr_jax.types import BodyMotion, Garment

RADIUS = 0.1  # [m]
TIMESTEP = 1 / 30  # [s]


def ball(rings: int = 7, around: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """A closed ball around the origin, facing out."""
    polar = np.linspace(0, np.pi, rings + 2)[1:-1]
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)
    ring = np.stack(np.broadcast_arrays(
        np.sin(polar)[:, None] * np.sin(angle), np.cos(polar)[:, None], np.sin(polar)[:, None] * np.cos(angle)
    ), axis=-1).reshape(-1, 3)  # fmt: skip
    positions = np.concatenate([ring, [[0, 1, 0]], [[0, -1, 0]]]) * RADIUS
    first, second = np.split(grid_faces(rings, around, is_closed=True), 2)
    index, top = np.arange(rings * around).reshape(rings, around), np.full(around, len(positions) - 2)
    caps = [top, index[0], np.roll(index[0], -1)], [top + 1, np.roll(index[-1], -1), index[-1]]
    return positions, np.concatenate([second, first, *(np.stack(cap, 1) for cap in caps)])


def square(side: int = 8, size: float = 0.24, *, is_pinned: np.ndarray | None = None) -> Garment:
    """A level square of side x side vertices just above the ball, carried by both joints."""
    x, z = np.meshgrid(
        np.linspace(-0.5, 0.5, side) * size, np.linspace(-0.5, 0.5, side) * size, indexing="ij"
    )
    positions = np.stack([x, np.full_like(x, RADIUS + 0.004), z], axis=-1).reshape(-1, 3)
    share = (x.ravel() / size + 0.5)[:, None]
    return prepare_garment(
        positions,
        grid_faces(side, side)[:, [0, 2, 1]],
        skin_weights=np.concatenate([share, 1 - share], axis=1),
        skin_indices=np.broadcast_to([0, 1], (side * side, 2)),
        is_pinned=is_pinned,
    )


def drifting_ball(
    num_frames: int = 6, *, speed: float = 0.3, mesh: tuple | None = None, below: float = 0.0
) -> BodyMotion:
    """A ball that drifts along x at `speed` [m/s] and rises a little, and two joints `below` [m] over it."""
    positions, faces = ball() if mesh is None else mesh
    time = np.arange(num_frames) * TIMESTEP
    shift = np.stack([speed * time, 0.2 * speed * time, np.zeros(num_frames)], axis=1)
    transforms = np.broadcast_to(np.eye(3, 4), (num_frames, 2, 3, 4)).copy()
    transforms[..., 3] = shift[:, None]
    return BodyMotion(
        positions=jnp.asarray(positions - [0, below, 0] + shift[:, None], jnp.float32),
        joint_transforms=jnp.asarray(transforms, jnp.float32),
        faces=jnp.asarray(faces, jnp.int32),
        is_obstacle=jnp.ones(len(faces), bool),
        timestep=jnp.float32(TIMESTEP),
        rest_positions=jnp.asarray(positions, jnp.float32),
        surface=prepare_surface(positions, faces),
    )
