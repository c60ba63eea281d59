"""Small cloth: sheets, a sleeve of sixty vertices, and the limb that moves in it."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import trimesh

from eslr_jax import pose_body, prepare_garment
from eslr_jax.pose.motion import Motion
from eslr_jax.types import Body, BodyMotion, Garment

LIMB_RADII = np.array([0.06, 0.15, 0.06])  # [m]
RINGS, AROUND = 6, 10


def grid_faces(rows: int, columns: int, *, is_closed: bool = False) -> np.ndarray:
    """Return the triangles of a grid of vertices, row by row; closed, the last column meets the first."""
    index = np.arange(rows * columns).reshape(rows, columns)
    if is_closed:
        index = np.concatenate([index, index[:, :1]], axis=1)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    return np.concatenate([np.stack([a, c, b], 1), np.stack([a, d, c], 1)])


def make_sheet(rows=5, columns=6, spacing=0.05, *, seed=0, jitter=0.2):
    """Return a sheet facing +y; inner vertices are moved at random, so that no two triangles are alike."""
    x, z = np.meshgrid(np.arange(columns) * spacing, np.arange(rows) * spacing)
    positions = np.stack([x, np.zeros_like(x), z], axis=-1)
    offset = np.random.default_rng(seed).uniform(-jitter, jitter, (rows - 2, columns - 2, 3))
    positions[1:-1, 1:-1] += offset * spacing * [1, 0.2, 1]
    return positions.reshape(-1, 3), grid_faces(rows, columns)


def dented_sheets(dent: float):
    """Return two level sheets 1 cm apart, the middle of the upper one pushed down by a depth [m], as a bowl."""
    flat, faces = make_sheet(13, 13, 0.02, jitter=0.1)
    flat = flat - flat.mean(axis=0)
    upper = flat + np.array([0.003, 0.01, 0.004])
    upper[:, 1] -= dent * np.exp(-np.sum(upper[:, [0, 2]] ** 2, axis=1) / (2 * 0.04**2))
    return np.concatenate([flat, upper]), np.concatenate([faces, faces + len(flat)])


def make_garment(positions, faces, *, is_pinned=None, sewn_positions=None) -> Garment:
    """Return a garment that one joint carries."""
    ones = np.ones((len(positions), 1))
    return prepare_garment(
        positions,
        faces,
        skin_weights=ones,
        skin_indices=np.zeros_like(ones, int),
        is_pinned=is_pinned,
        sewn_positions=sewn_positions,
        allow_components=True,
    )


def make_sleeve(*, is_pinned=None) -> Garment:
    """Return a sleeve of sixty vertices around the upper half of the limb, 8 mm off it."""
    height, angle = np.meshgrid(
        np.linspace(-0.06, 0.1, RINGS), np.arange(AROUND) * 2 * np.pi / AROUND, indexing="ij"
    )
    radius = LIMB_RADII[0] * np.sqrt(1 - (height / LIMB_RADII[1]) ** 2) + 0.008
    positions = np.stack([radius * np.cos(angle), height, radius * np.sin(angle)], axis=-1)
    return make_garment(
        positions.reshape(-1, 3), grid_faces(RINGS, AROUND, is_closed=True), is_pinned=is_pinned
    )


def make_limb() -> Body:
    """Return an ellipsoid on one joint."""
    ball = trimesh.creation.icosphere(subdivisions=2)
    count = len(ball.vertices)
    limb = Body(
        rest_positions=np.float32(ball.vertices * LIMB_RADII),
        shape_directions=np.zeros((count, 3, 0), np.float32),
        joint_rest_positions=np.zeros((1, 3), np.float32),
        joint_shape_directions=np.zeros((1, 3, 0), np.float32),
        skin_weights=np.ones((count, 1), np.float32),
        skin_indices=np.zeros((count, 1), np.int32),
        faces=np.int32(ball.faces),
        is_obstacle=np.ones(len(ball.faces), bool),
        parents=(-1,),
        joint_names=("limb",),
    )
    return jax.tree.map(jnp.asarray, limb)


def shaped(body: Body, place) -> Body:
    """Return a body whose rest pose is elsewhere: `place` maps its places [m]."""
    fields = ("rest_positions", "joint_rest_positions")
    return body.replace(**{name: np.float32(place(np.asarray(getattr(body, name)))) for name in fields})


def stand_at(body: Body, offset) -> Body:
    """Return a body whose rest pose stands elsewhere, by an offset [m]."""
    return shaped(body, lambda places: places + np.float32(offset))


def turn_about(body: Body, turn: np.ndarray) -> Body:
    """Return a body whose rest pose is turned about the origin: every place p is at p @ turn."""
    return shaped(body, lambda places: places @ np.float32(turn))


def swing_motion(body: Body, num_frames: int, *, sway: float = 0.02) -> Motion:
    """Return a motion of the limb sideways and round, by up to `sway` metres a frame."""
    time = np.arange(num_frames)
    rotations = np.zeros((num_frames, 1, 3))
    rotations[:, 0, 2] = 2 * sway * time
    translations = np.stack([sway * np.sin(0.8 * time), 0.2 * sway * time, 0 * time], axis=1)
    return Motion("swing", rotations, translations, 30.0, body.joint_names, arm_abduction=0.0)


def swing(body: Body, num_frames: int, *, sway: float = 0.02) -> BodyMotion:
    """Return the limb on its way, see `swing_motion`."""
    return pose_body(body, swing_motion(body, num_frames, sway=sway))
