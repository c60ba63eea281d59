"""What MAT computes on a garment's rest mesh: faces to their changes and back, and the step off the body."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from eslr_jax.mesh.geodesic import geodesic_distances, geodesic_graph
from eslr_jax.numerics import safe_normalize
from eslr_jax.terms.collision import penetration
from eslr_jax.types import Contacts, Garment

_GEODESIC_REACH = 0.05  # [m] over which a face's weight for another falls by e
_CLEARANCE = 4e-3  # [m] from the body (MAT)
_PUSH, _SMOOTH, _STAY = 4.0, 2.0, 1e-3  # weights of the step off the body (MAT)
_PUSH_ITERATIONS = 20  # of conjugate gradients


@struct.dataclass
class Space:
    """What a garment's rest mesh says once and for all."""

    garment: Garment
    inverse_frames: Float[Array, "faces 3 3"]  # of the rest faces [e1, e2, n]
    cotangents: Float[Array, "faces 3"]  # half of the angle's across the edge that leaves a corner
    geodesic: Float[Array, "faces faces"]  # rows sum to one
    poisson: Float[Array, "vertices vertices"]  # pseudo-inverse of the cotangent Laplacian
    laplacian: Float[Array, "vertices vertices"]
    smooth_inverse: Float[Array, "vertices vertices"]  # of the step off the body, were no vertex inside

    @property
    def face_mask(self) -> Float[Array, " faces"]:
        """One for real faces, zero for padding."""
        return (self.garment.rest_areas > 0).astype(jnp.float32)


class Change(NamedTuple):
    """What a frame does to the cloth, in the garment's heading."""

    faces: Float[Array, "faces 9"]  # change of every face's frame, less the identity
    whole: Float[Array, " 3"]  # displacement of the mean vertex [m]


def prepare_space(garment: Garment) -> Space:
    """Return what the rest mesh says, of a garment with or without padding; host."""
    positions, faces = np.asarray(garment.rest_positions, float), np.asarray(garment.faces)
    is_vertex, is_face = np.asarray(garment.vertex_mask), np.asarray(garment.rest_areas) > 0
    count, real = is_vertex.sum(), faces[is_face]
    frames = np.broadcast_to(np.eye(3), (len(faces), 3, 3)).copy()
    frames[is_face] = np.asarray(face_frames(garment.rest_positions, garment))[is_face]
    cotangents, laplacian = np.zeros((len(faces), 3)), np.zeros((len(positions), len(positions)))
    for k in range(3):
        i, j, tip = np.roll(real, -k, axis=1).T
        a, b = positions[i] - positions[tip], positions[j] - positions[tip]
        w = 0.5 * np.sum(a * b, axis=1) / np.linalg.norm(np.cross(a, b), axis=1)
        cotangents[is_face, k] = w
        for row, column, sign in ((i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1)):
            np.add.at(laplacian, (row, column), sign * w)
    away = geodesic_distances(geodesic_graph(positions[:count], real), np.arange(count))
    corners = np.zeros((len(real), count))
    np.put_along_axis(corners, real, 1.0 / 3.0, axis=1)
    geodesic = np.zeros((len(faces), len(faces)))
    near = np.exp(-(corners @ away @ corners.T) / _GEODESIC_REACH)
    geodesic[np.ix_(is_face, is_face)] = near / near.sum(axis=1, keepdims=True)
    smooth = _SMOOTH * laplacian.T @ laplacian + _STAY * np.eye(len(positions))
    poisson = np.linalg.pinv(laplacian, hermitian=True)
    tables = (np.linalg.inv(frames), cotangents, geodesic, poisson, laplacian, np.linalg.inv(smooth))
    return Space(garment, *(jnp.asarray(table, jnp.float32) for table in tables))


def heading(position: Float[Array, "vertices 3"], space: Space) -> Float[Array, "3 3"]:
    """Return the turn about the vertical that best carries the rest mesh to `position`."""
    garment, mask = space.garment, space.garment.vertex_mask[:, None]

    def centred(x: Array) -> Array:
        return jnp.where(mask, x - jnp.mean(x, axis=0, where=mask, keepdims=True), 0.0)

    rest, moved = centred(garment.rest_positions), centred(position)
    along = jnp.sum(rest[:, 0] * moved[:, 0] + rest[:, 2] * moved[:, 2])
    across = jnp.sum(rest[:, 2] * moved[:, 0] - rest[:, 0] * moved[:, 2])
    cos, sin = safe_normalize(jnp.stack([along, across]))
    zero, one = jnp.zeros_like(cos), jnp.ones_like(cos)
    return jnp.stack([cos, zero, sin, zero, one, zero, -sin, zero, cos]).reshape((3, 3))


def face_frames(position: Float[Array, "vertices 3"], garment: Garment) -> Float[Array, "faces 3 3"]:
    """Return two edges and the unit normal of every face, as columns."""
    a, b, c = jnp.moveaxis(position[garment.faces], 1, 0)
    return jnp.stack([b - a, c - a, safe_normalize(jnp.cross(b - a, c - a))], axis=2)


def change_between(
    position: Float[Array, "vertices 3"],
    after: Float[Array, "vertices 3"],
    space: Space,
    turn: Float[Array, "3 3"],
) -> Change:
    """Return what carries `position` to `after` [m]: the network's target."""
    now, then = (face_frames(x @ turn, space.garment) for x in (position, after))
    is_face, same = (space.garment.rest_areas > 0)[:, None, None], jnp.eye(3)[None]
    carried = then @ jnp.linalg.inv(jnp.where(is_face, now, same))
    faces = jnp.where(is_face, carried - same, 0.0)
    whole = jnp.mean((after - position) @ turn, axis=0, where=space.garment.vertex_mask[:, None])
    return Change(faces.reshape((-1, 9)), whole)


def rebuild(
    change: Change, position: Float[Array, "vertices 3"], space: Space, turn: Float[Array, "3 3"]
) -> Float[Array, "vertices 3"]:
    """Return the positions [m] whose edges are nearest to the changed ones: a Poisson solve on the rest mesh."""
    garment = space.garment
    x = position @ turn
    carried = change.faces.reshape((-1, 3, 3)) + jnp.eye(3)[None]
    corners = x[garment.faces]
    edges = jnp.einsum("fab,fkb->fka", carried, corners - jnp.roll(corners, -1, axis=1))
    pulls = space.cotangents[:, :, None] * edges
    pulls = pulls - jnp.roll(pulls, 1, axis=1)  # an edge pulls its ends apart
    right = jnp.zeros_like(x).at[garment.faces].add(pulls)
    solved = space.poisson @ right
    is_real = garment.vertex_mask[:, None]
    centre = jnp.mean(x, axis=0, where=is_real) + change.whole - jnp.mean(solved, axis=0, where=is_real)
    return jnp.where(is_real, (solved + centre[None]) @ turn.T, position)


def step_off(
    position: Float[Array, "vertices 3"], contacts: Contacts, space: Space
) -> Float[Array, "vertices 3"]:
    """Return positions [m] that keep off the body, and as smooth and as near as they can.

    The offset d minimises 4 sum_v (n_v . d_v - depth_v)^2 over vertices inside, + 2 |L d|^2 + 1e-3 |d|^2.
    """
    depth = penetration(position, contacts, _CLEARANCE)
    normals = jnp.where(depth[:, None] > 0, contacts.next_normals, 0.0)

    def matrix(offset: Array) -> Array:
        smooth = _SMOOTH * (space.laplacian.T @ (space.laplacian @ offset)) + _STAY * offset
        return smooth + _PUSH * normals * jnp.sum(normals * offset, axis=1, keepdims=True)

    offset, _ = jax.scipy.sparse.linalg.cg(
        matrix,
        _PUSH * depth[:, None] * normals,
        maxiter=_PUSH_ITERATIONS,
        M=lambda residual: space.smooth_inverse @ residual,
    )
    return position + offset
