"""Linear blend skinning: joint rotations to posed points, with gradients that exist at zero rotation.

Rotations are local axis-angle vectors in world-aligned rest axes: if all are zero, the body is in its rest pose.
Matrix products use full float32: the default of some GPUs keeps ten bits, which moves a hand by millimetres.

Source: Loper et al. 2015 (doi:10.1145/2816795.2818013), section 3.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from eslr_jax.numerics import product
from eslr_jax.types import Garment

SERIES_BELOW = 1e-2  # [rad^2], where the truncated series are exact to float32 and the closed forms are not


def rotation_matrix(rotation: Float[Array, " 3"]) -> Float[Array, "3 3"]:
    """Return the matrix I + a K + b K^2 of an axis-angle vector [rad], smooth at zero.

    K is the cross-product matrix of `rotation`, a = sin(t)/t, b = (1 - cos(t))/t^2, t = |rotation|.

    Source: Rodrigues' formula.
    """
    x, y, z = rotation
    squared = x * x + y * y + z * z
    is_small = squared < SERIES_BELOW
    angle = jnp.sqrt(jnp.where(is_small, 1.0, squared))
    a = jnp.where(is_small, 1.0 - squared / 6.0 + squared**2 / 120.0, jnp.sin(angle) / angle)
    b = jnp.where(
        is_small, 0.5 - squared / 24.0 + squared**2 / 720.0, 0.5 * (jnp.sin(0.5 * angle) / (0.5 * angle)) ** 2
    )
    outer = rotation[:, None] * rotation[None, :]
    zero = jnp.zeros_like(x)
    cross = jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape((3, 3))
    identity = jnp.eye(3, dtype=rotation.dtype)
    return identity * (1.0 - b * squared) + a * cross + b * outer


def joint_transforms(
    rotations: Float[Array, "joints 3"],
    translation: Float[Array, " 3"],
    joint_rest_positions: Float[Array, "joints 3"],
    parents: tuple[int, ...],
) -> Float[Array, "joints 3 4"]:
    """Return the affine map of every joint from rest points to posed points.

    With parent p, local rotation R_j and rest position r_j: G_j = G_p R_j, x_j = x_p + G_p (r_j - r_p), and
    the map of a point q is G_j q + (x_j - G_j r_j); the root has G = R, x = `translation`.

    Args:
        rotations: Local axis-angle rotations relative to the rest pose [rad].
        translation: Posed position of the root joint [m].
        joint_rest_positions: Rest positions of the joints [m].
        parents: Parent of each joint, -1 for the root; a parent comes before its children. Static.

    Source: Loper et al. 2015, equations 2-4.
    """
    turned = jax.vmap(rotation_matrix)(rotations)
    posed = jnp.broadcast_to(translation, joint_rest_positions.shape)

    def hang(level: Int[Array, ""], chain: tuple[Array, Array]) -> tuple[Array, Array]:
        turned, posed = chain
        joints, above = generations[level]
        bones = joint_rest_positions[joints] - joint_rest_positions[above]
        posed = posed.at[joints].set(posed[above] + _apply(turned[above], bones), mode="drop")
        return turned.at[joints].set(product(turned[above], turned[joints]), mode="drop"), posed

    # A loop, not a row of copies: a skeleton of twenty generations would be a second of compilation.
    generations = jnp.asarray(_generations(parents))
    if generations.size:  # else there is a root alone
        turned, posed = jax.lax.fori_loop(0, len(generations), hang, (turned, posed))
    offsets = posed - _apply(turned, joint_rest_positions)
    return jnp.concatenate([turned, offsets[:, :, None]], axis=2)


def skin(
    positions: Float[Array, "vertices 3"],
    weights: Float[Array, "vertices influences"],
    indices: Int[Array, "vertices influences"],
    transforms: Float[Array, "joints 3 4"],
) -> Float[Array, "vertices 3"]:
    """Return rest points [m] moved by the joints' affine maps, of `joint_transforms`, blended by weight.

    Rows of the weights sum to one; `indices` are their joints.

    Source: Loper et al. 2015, equation 1.
    """
    joints = jnp.arange(transforms.shape[0], dtype=indices.dtype)
    is_joint = indices[:, :, None] == joints[None, None, :]
    # A product beats gathers everywhere.
    dense = jnp.sum(jnp.where(is_joint, weights[:, :, None], 0.0), axis=1)
    blended = product(dense, transforms.reshape((-1, 12))).reshape((-1, 3, 4))
    return _apply(blended[:, :, :3], positions) + blended[:, :, 3]


def skin_garment(
    garment: Garment, transforms: Float[Array, "frames joints 3 4"]
) -> Float[Array, "frames vertices 3"]:
    """Return the garment carried by the joints [m], shape [frames, vertices, 3].

    One frame after the other: a vmap would hold frames x vertices x influences matrices at once.
    """
    rest = garment.rest_positions, garment.skin_weights, garment.skin_indices
    return jax.lax.map(lambda frame: skin(*rest, frame), transforms)


def bend(
    directions: Float[Array, "vertices 3 entries"], turned: Float[Array, "joints 3 3"]
) -> Float[Array, "vertices 3"]:
    """Return the displacement of rest points by pose blend shapes [m].

    `directions` are displacements per entry of R - I [m], and `turned` holds R - I of all joints but the root.

    Source: Loper et al. 2015, equation 9.
    """
    flat = directions.reshape((-1, directions.shape[2]))
    return product(flat, turned.reshape((-1, 1))).reshape((-1, 3))


def _generations(parents: tuple[int, ...]) -> Int[np.ndarray, "generations 2 width"]:
    """Return the joints of each depth below the root, and their parents; rows are filled up with no joint."""
    depths: list[int] = []
    for parent in parents:
        depths.append(0 if parent < 0 else depths[parent] + 1)
    depth, parent = np.array(depths), np.array(parents)
    members = [np.flatnonzero(depth == level) for level in range(1, depth.max() + 1)]
    width = max((len(joints) for joints in members), default=0)
    rows = np.zeros((len(members), 2, width), np.int32)
    rows[:, 0] = len(parents)
    for row, joints in zip(rows, members, strict=True):
        row[:, : len(joints)] = joints, parent[joints]
    return rows


def _apply(matrices: Float[Array, "n 3 3"], vectors: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Return the product of each matrix with its vector; elementwise, so never in reduced precision."""
    return jnp.sum(matrices * vectors[:, None, :], axis=2)
