"""A body without a rig: a mesh in motion, on which patches of the surface stand for joints (host)."""

from __future__ import annotations

import warnings

import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy.sparse.csgraph import dijkstra

from eslr_jax.errors import MotionError
from eslr_jax.mesh.skinning import smooth
from eslr_jax.mesh.topology import unique_edges
from eslr_jax.mesh.validate import check_outward
from eslr_jax.numerics import to_device
from eslr_jax.pipeline.formats.bundled import UPRIGHT
from eslr_jax.pipeline.formats.mesh_sequence import MeshSequence
from eslr_jax.pipeline.rigs.rig import metres_per_unit
from eslr_jax.pose.motion import body_motion
from eslr_jax.pose.retarget import count_resampled
from eslr_jax.pose.skeleton import nearest_rotations
from eslr_jax.types import Body, BodyMotion

NUM_PATCHES = 48  # pieces that move almost rigidly; about two a limb segment
STILL_FRAMES = 60  # that a single mesh is held for by default: a garment hangs still by then
_BLEND_STEPS = 12  # Laplacian smoothings of the patches' weights
_INFLUENCES = 4


def pose_sequence(
    sequence: MeshSequence, *, fps: float = 30.0, num_frames: int | None = None, units: str | None = None
) -> tuple[Body, BodyMotion]:
    """Return a moving mesh as a body, and as that body in motion.

    The vertices move as in the sequence, resampled in time by straight lines. Patches of the surface stand for
    joints: each follows the best rigid motion of its vertices. They carry a garment that fits the first frame,
    which is the rest pose. `fps` are the simulation's; the first `num_frames` of its frames are kept, by default
    all. A sequence of one frame, as a mannequin, is held. The unit is by default recognised, see
    `metres_per_unit`.

    Raises:
        AssetError: The unit is unknown.
        MeshError: Its faces point inside.
        MotionError: There are fewer frames than asked for.
    """
    faces = np.asarray(sequence.faces, np.int64)
    extent = float(np.ptp(sequence.positions[0], axis=0).max())
    scaled = metres_per_unit(sequence.name, extent, units) * sequence.positions
    if len(scaled) == 1:
        scaled = np.repeat(scaled, STILL_FRAMES if num_frames is None else num_frames, axis=0)
    # By straight lines between frames.
    at = np.arange(count_resampled(len(scaled), sequence.fps, fps)) * (sequence.fps / fps)
    before = np.clip(at.astype(int), 0, max(len(scaled) - 2, 0))
    share = np.clip(at - before, 0.0, 1.0)[:, None, None]
    after = np.minimum(before + 1, len(scaled) - 1)
    rest, positions = scaled[0], (1 - share) * scaled[before] + share * scaled[after]
    check_outward(rest, faces, name=sequence.name)
    sides = np.ptp(rest, axis=0)
    if sides[2] == sides.max() and sides[1] < UPRIGHT * sides[2]:
        warnings.warn(
            f"{sequence.name} is {sides[1]:.3g} m high and {sides[2]:.3g} m long along z: if it stands, turn it "
            "so that Y is up",
            stacklevel=2,
        )
    if num_frames is not None:
        if num_frames > len(positions):
            raise MotionError(
                f"{sequence.name} has {len(positions)} frames at {fps:g} fps, fewer than the {num_frames} "
                "asked for; ask for fewer"
            )
        positions = positions[:num_frames]
    weights, indices, dense = _patch_weights(rest, faces)
    # The best rigid motion of every patch: Kabsch 1976 (doi:10.1107/S0567739476001873).
    share = dense / np.maximum(dense.sum(axis=0), 1e-12)
    centers = share.T @ rest
    transforms = np.empty((len(positions), dense.shape[1], 3, 4))
    moments = np.einsum("vp,va->vpa", share, rest) - share[:, :, None] * centers
    for frame, points in enumerate(positions):
        middle = share.T @ points
        covariance = np.einsum("va,vpb->pab", points, moments)
        turned = nearest_rotations(covariance)
        transforms[frame, :, :, :3] = turned
        transforms[frame, :, :, 3] = middle - np.einsum("pab,pb->pa", turned, centers)
    patches = dense.shape[1]
    body = Body(
        rest_positions=rest,
        shape_directions=np.zeros((len(rest), 3, 0)),
        joint_rest_positions=centers,
        joint_shape_directions=np.zeros((patches, 3, 0)),
        skin_weights=weights,
        skin_indices=indices,
        faces=faces,
        is_obstacle=np.ones(len(faces), bool),
        parents=(-1,) * patches,
        joint_names=tuple(f"patch{patch}" for patch in range(patches)),
    )
    body, *moved = to_device((body, positions, transforms))
    return body, body_motion(body, *moved, fps=fps)


def _patch_weights(rest: NDArray, faces: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Return the largest weights of soft-bordered patches at every vertex, and their patches; and all weights.

    Shapes are [vertices, influences], where rows sum to one, twice, and [vertices, patches].
    """
    edges = unique_edges(faces)
    lengths = np.maximum(np.linalg.norm(rest[edges[:, 0]] - rest[edges[:, 1]], axis=1), 1e-9)
    graph = scipy.sparse.csr_array((lengths, (edges[:, 0], edges[:, 1])), (len(rest), len(rest)))
    # Along the surface, so that a hanging arm and the hip beside it stay apart; farthest points first.
    nearest, owner = np.full(len(rest), np.inf), np.zeros(len(rest), np.int64)
    seed = int(rest[:, 1].argmax())
    for patch in range(min(NUM_PATCHES, len(rest))):
        distance = dijkstra(graph, directed=False, indices=seed, limit=float(nearest.max()))
        is_nearer = distance < nearest
        nearest[is_nearer], owner[is_nearer] = distance[is_nearer], patch
        seed = int(nearest.argmax())
        if nearest[seed] == 0:
            break
    patches = int(owner.max()) + 1
    dense = smooth(np.eye(patches)[owner], faces, _BLEND_STEPS)
    used = min(_INFLUENCES, patches)
    indices = np.argsort(-dense, axis=1, kind="stable")[:, :used]
    weights = np.take_along_axis(dense, indices, axis=1)
    return weights / weights.sum(1, keepdims=True), indices, dense
