"""Cloth, bodies and scenes of the hard cases, built by hand."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import ConvexHull

from eslr_jax.fabric.materials import COTTON
from eslr_jax.mesh.parting import parted
from eslr_jax.mesh.prepare import prepare_garment
from eslr_jax.mesh.surface import prepare_surface
from eslr_jax.mesh.topology import face_cross_products
from eslr_jax.simulation.scene import initial_state
from eslr_jax.terms import Bending, Collision, Contact, Friction, Gravity, Inertia, Stretch, Term
from eslr_jax.terms.contact import starting_rows
from eslr_jax.types import Garment, Material, Obstacle, Scene

FRAME = 1.0 / 30.0  # [s]
Mesh = tuple[np.ndarray, np.ndarray]  # positions [vertices, 3] in metres, faces [faces, 3]


def grid_faces(rows: int, columns: int) -> Int[np.ndarray, "faces 3"]:
    """Return two triangles per square of a grid of vertices, diagonals alternating."""
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    is_even = (np.add.outer(np.arange(rows - 1), np.arange(columns - 1)) % 2 == 0).ravel()[:, None]
    first = np.where(is_even, np.stack([a, d, b], 1), np.stack([a, d, c], 1))
    second = np.where(is_even, np.stack([d, c, b], 1), np.stack([a, c, b], 1))
    return np.concatenate([first, second])


def same_way_faces(rows: int, columns: int) -> Int[np.ndarray, "faces 3"]:
    """Return two triangles per square of a grid of vertices, diagonals all one way."""
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    return np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def sheet(rows: int, columns: int, size: tuple[float, float]) -> Mesh:
    """Return a level sheet around the origin, facing up; `size` is along x and z [m]."""
    x, z = np.meshgrid(
        np.linspace(-0.5, 0.5, rows) * size[0], np.linspace(-0.5, 0.5, columns) * size[1], indexing="ij"
    )
    positions = np.stack([x, np.zeros_like(x), z], axis=-1).reshape(-1, 3)
    return positions, grid_faces(rows, columns)


def hanging_sheet(rows: int, columns: int, size: tuple[float, float]) -> Mesh:
    """Return an upright sheet whose upper edge is at height zero; `size` is along x and down [m]."""
    positions, faces = sheet(rows, columns, size)
    upright = np.stack([positions[:, 0], positions[:, 2] - 0.5 * size[1], np.zeros(len(positions))], axis=1)
    return upright, faces[:, ::-1].copy()


def tube(around: int, along: int, radii: tuple[float, float], length: float) -> Mesh:
    """Return an open tube around y, from height zero down, facing out; radii at the top and the bottom [m]."""
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)
    share = np.linspace(0, 1, along)
    radius = radii[0] + (radii[1] - radii[0]) * share
    positions = np.stack(
        [
            np.cos(angle)[:, None] * radius,
            np.broadcast_to(-share * length, (around, along)),
            np.sin(angle)[:, None] * radius,
        ],
        axis=-1,
    )
    index = np.arange(around * along).reshape(around, along)
    following = np.roll(index, -1, axis=0)
    a, b, c, d = (part.ravel() for part in (index[:, :-1], following[:, :-1], following[:, 1:], index[:, 1:]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return positions.reshape(-1, 3), faces


def icosphere(subdivisions: int, radius: float) -> Mesh:
    """Return a ball's surface around the origin, facing out [m]."""
    golden = (1 + np.sqrt(5)) / 2
    points = np.array([[-1, golden, 0], [1, golden, 0], [-1, -golden, 0], [1, -golden, 0]])
    positions = np.concatenate([np.roll(points, shift, axis=1) for shift in range(3)])
    faces = ConvexHull(positions).simplices
    outward = positions[faces].mean(axis=1)
    is_inside_out = np.sum(face_cross_products(positions, faces) * outward, axis=1) < 0
    faces = np.where(is_inside_out[:, None], faces[:, ::-1], faces)
    for _ in range(subdivisions):
        edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
        unique, inverse = np.unique(edges, axis=0, return_inverse=True)
        ab, bc, ca = len(positions) + inverse.reshape(3, -1)
        positions = np.concatenate([positions, positions[unique].mean(axis=1)])
        a, b, c = faces.T
        parts = [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]
        faces = np.concatenate([np.stack(part, 1) for part in parts])
    return positions / np.linalg.norm(positions, axis=1, keepdims=True) * radius, faces


def revolve(profile: Float[np.ndarray, "rings 2"], around: int) -> Mesh:
    """Return the closed surface swept by a profile of (radius, height) [m] around y, from bottom to top.

    The first and the last point lie on the axis. What comes of the case `pinch` depends on the vertices' order.
    """
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)
    rings = profile[1:-1]
    positions = np.stack(
        [
            rings[:, :1] * np.cos(angle),
            np.broadcast_to(rings[:, 1:], (len(rings), around)),
            -rings[:, :1] * np.sin(angle),
        ],
        axis=-1,
    ).reshape(-1, 3)
    poles = np.array([[0, profile[0, 1], 0], [0, profile[-1, 1], 0]])
    index = np.arange(len(rings) * around).reshape(len(rings), around)
    following = np.roll(index, -1, axis=1)
    a, b = index[:-1].ravel(), following[:-1].ravel()
    c, d = following[1:].ravel(), index[1:].ravel()
    bottom, top = len(positions), len(positions) + 1
    faces = [
        np.stack([a, b, c], 1),
        np.stack([a, c, d], 1),
        np.stack([np.full(around, bottom), following[0], index[0]], 1),
        np.stack([np.full(around, top), index[-1], following[-1]], 1),
    ]
    return np.concatenate([positions, poles]), np.concatenate(faces)


def capsule(radius: float, length: float, *, around: int = 32, rings: int = 24) -> Mesh:
    """Return a capsule along x around the origin; `length` is that of its axis [m]."""
    cap = np.linspace(-np.pi / 2, 0, max(around // 4, 3))
    lower = np.stack([radius * np.cos(cap), radius * np.sin(cap) - length / 2], axis=1)
    upper = lower[::-1] * [1, -1]
    straight = np.stack(
        [np.full(rings, radius), np.linspace(-length / 2, length / 2, rings + 2)[1:-1]], axis=1
    )
    positions, faces = revolve(np.concatenate([lower, straight, upper]), around)
    return positions[:, [1, 2, 0]], faces


def plane(size: float, count: int, tilt: float) -> Mesh:
    """Return a square of a plane through the origin that rises towards +x by `tilt` [rad], facing up."""
    positions, faces = sheet(count, count, (size, size))
    cosine, sine = np.cos(tilt), np.sin(tilt)
    return np.stack([positions[:, 0] * cosine, positions[:, 0] * sine, positions[:, 2]], axis=1), faces


def turn_about_x(
    positions: Float[np.ndarray, "vertices 3"], angles: Float[np.ndarray, "frames angles"]
) -> Float[np.ndarray, "frames vertices 3"]:
    """Return positions [m] turned about the x axis in every frame, by an angle [rad] for each or for all."""
    x, y, z = positions.T
    sine, cosine = np.sin(angles), np.cos(angles)
    y, z = y * cosine - z * sine, y * sine + z * cosine
    return np.stack([np.broadcast_to(x, y.shape), y, z], axis=-1)


def join_meshes(*meshes: Mesh) -> Mesh:
    """Return several meshes as one of several components."""
    counts = np.cumsum([0] + [len(positions) for positions, _ in meshes])
    faces = [faces + count for (_, faces), count in zip(meshes, counts[:-1], strict=True)]
    return np.concatenate([positions for positions, _ in meshes]), np.concatenate(faces)


def make_cloth(
    mesh: Mesh, options: Mapping[str, Any], *, is_pinned: np.ndarray | None = None, **more: Any
) -> Garment:
    """Return a garment that hangs on no body: every vertex has the same made-up joint; see `prepare_garment`."""
    ones = np.ones((len(mesh[0]), 1))
    joints = np.zeros_like(ones, int)
    return prepare_garment(
        *mesh, skin_weights=ones, skin_indices=joints, is_pinned=is_pinned, **options, **more
    )


def corners_of(
    positions: np.ndarray, *signs: tuple[int, int], axes: tuple[int, int]
) -> Bool[np.ndarray, " vertices"]:
    """Mark the vertices farthest in diagonal directions, given by signs along two axes."""
    mask = np.zeros(len(positions), bool)
    for sign in signs:
        mask[np.argmax(positions[:, axes] @ np.array(sign))] = True
    return mask


def make_scene(
    garment: Garment,
    start: Float[np.ndarray, "vertices 3"],
    num_frames: int,
    *,
    timestep: float = FRAME,
    material: Material = COTTON,
    gravity: float = Gravity.acceleration,
    friction: float = Friction.coefficient,
    body: Mesh | None = None,
    body_positions: Float[np.ndarray, "frames body_vertices 3"] | None = None,
    pin_targets: Float[np.ndarray, "frames vertices 3"] | None = None,
    self_contact: bool = False,
) -> Scene:
    """Put cloth, body and pins together; the cloth starts at rest.

    Without their tracks [m] the body, whose vertices all have faces, stands still, and pinned vertices stay
    where they start. In frame 0 the body must not touch itself. Nothing passes through the cloth where there is a
    body, or with `self_contact`.
    """
    position = jnp.asarray(start, jnp.float32)
    obstacle = pins = None
    terms: list[Term] = [Stretch(), Bending(), Inertia(), Gravity(gravity)]
    if body is not None:
        terms += [Collision(), Friction(friction)]
        track = (
            body[0][None] if body_positions is None else parted(body_positions, body_positions[0], body[1])
        )
        obstacle = Obstacle(
            surface=prepare_surface(track[0], body[1]),
            positions=jnp.asarray(np.broadcast_to(track, (num_frames, *body[0].shape)), jnp.float32),
        )
    if self_contact or body is not None:
        terms.append(Contact(rows=starting_rows(len(start))))
    if np.any(garment.is_pinned):
        targets = np.asarray(start)[None] if pin_targets is None else pin_targets
        pins = jnp.asarray(np.broadcast_to(targets, (num_frames, *position.shape)), jnp.float32)
    return Scene(
        garment=garment,
        material=material,
        timestep=jnp.float32(timestep),
        initial_state=initial_state(position, jnp.zeros_like(position)),
        body=obstacle,
        pin_targets=pins,
        terms=tuple(terms),
        num_frames=num_frames,
    )
