"""Motions in time: cut, repeated, settled first, and slow enough to follow (host)."""

from __future__ import annotations

import dataclasses
import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from eslr_jax.errors import MotionError
from eslr_jax.mesh.topology import face_cross_products, normalize
from eslr_jax.pose.motion import Motion, check_length, turn_joints
from eslr_jax.pose.retarget import blend_rotations, local_rotations
from eslr_jax.pose.skeleton import SkeletonMotion
from eslr_jax.types import Body, BodyMotion

_START_SECONDS = 1.0  # the start of a motion, which is searched for a pose that does not belong to it
_JUMP = 0.08  # of the skeleton's size: least step of a joint that counts as a jump
_FAR_MORE = 3.0  # a jump is at least this many times as long as every other step
_STEPS_AFTER = 5  # least number of steps after a jump
SETTLE_FRAMES = 35  # in which a garment is put on: 25 for the limbs, and those that hold the first pose
_HELD = 10  # frames of settling that hold the first pose
_FEWEST_MOVING = 15  # frames in which limbs may come from the rest pose; fewer would be a jerk
# Vertices [m] and map of every joint, by frames.
_Track = tuple[Float[Array, "frames vertices 3"], Float[Array, "frames joints 3 4"]]
_BLEND_SECONDS = 0.3  # in which the end of a loop passes into its beginning


def skip_start_pose(source: SkeletonMotion) -> tuple[SkeletonMotion, str]:
    """Return a file's motion without a T-pose that stands before it, and a line that says so, or else "".

    Many files begin with one or a few frames of the rest pose. Simulated, that is a jump. Frames are skipped
    if the step that follows them is far longer than every other step.
    """
    size = float(np.ptp(source.skeleton.rest_positions, axis=0).max()) or 1.0
    steps = np.linalg.norm(np.diff(source.positions, axis=0), axis=-1).max(axis=1) / size
    window = steps[: max(round(_START_SECONDS * source.fps), 1)]
    last = int(window.argmax()) if len(window) else 0
    others = np.delete(steps, last) if len(window) else steps
    if len(steps) - last <= _STEPS_AFTER or steps[last] < max(_JUMP, _FAR_MORE * others.max()):
        return source, ""
    kept = dataclasses.replace(
        source, rotations=source.rotations[last + 1 :], positions=source.positions[last + 1 :]
    )
    frames = "frame" if last == 0 else f"{last + 1} frames"
    text = (
        f"motion {source.name}: skipped its first {frames}, a pose from which it jumps by "
        f"{100 * steps[last]:.0f} % of the body's height"
    )
    return kept, text


def cut_start(motion: Motion, seconds: float) -> Motion:
    """Return a motion from a time on [s]; a MotionError where fewer than two frames are left."""
    first = round(seconds * motion.fps) if math.isfinite(seconds) else -1
    length = (len(motion.rotations) - 1) / motion.fps
    if not 0 <= first <= len(motion.rotations) - 2:
        raise MotionError(f"motion {motion.name} can't start at {seconds:g} s: it is {length:.2f} s long")
    return dataclasses.replace(
        motion,
        rotations=motion.rotations[first:],
        translations=motion.translations[first:],
        start=motion.start + first / motion.fps,
    )


def loop_motion(motion: Motion, seconds: float) -> Motion:
    """Return a motion that repeats until it is this long [s]; a MotionError where it is too short to repeat.

    Each repetition starts where the last one ended, facing the same way, and the end passes smoothly into the
    beginning.
    """
    frames = len(motion.rotations)
    if not (math.isfinite(seconds) and seconds > 0) or frames < 4:
        raise MotionError(f"motion {motion.name} of {frames} frames can't be repeated for {seconds:g} s")
    overlap = max(min(round(_BLEND_SECONDS * motion.fps), frames // 3), 1)
    rotations, translations = np.array(motion.rotations, float), np.array(motion.translations, float)
    head, root = rotations.copy(), translations.copy()
    wanted = math.ceil(seconds * motion.fps) + 1
    share = np.arange(1, overlap + 1) / (overlap + 1)
    weight = share**2 * (3.0 - 2.0 * share)
    while len(rotations) < wanted:
        seam = len(rotations) - overlap
        # The turn about the vertical that brings the first root rotation closest to that at the seam.
        between = (
            Rotation.from_rotvec(rotations[seam, 0]) * Rotation.from_rotvec(motion.rotations[0, 0]).inv()
        )
        matrix = between.as_matrix()
        yaw = np.arctan2(matrix[0, 2] - matrix[2, 0], matrix[0, 0] + matrix[2, 2])
        turn = Rotation.from_euler("y", yaw)
        head[:, 0] = (turn * Rotation.from_rotvec(motion.rotations[:, 0])).as_rotvec()
        root = turn.apply(motion.translations)
        root = root + (translations[seam] - root[0]) * [1.0, 0.0, 1.0]
        joined = blend_rotations(rotations[seam:], head[:overlap], weight)
        path = translations[seam:] + weight[:, None] * (root[:overlap] - translations[seam:])
        rotations = np.concatenate([rotations[:seam], joined, head[overlap:]])
        translations = np.concatenate([translations[:seam], path, root[overlap:]])
    return dataclasses.replace(motion, rotations=rotations[:wanted], translations=translations[:wanted])


def with_settling(poses: BodyMotion, num_frames: int, body: Body | None = None) -> BodyMotion:
    """Return a moving body with frames before its first one, in which a garment comes to rest on it.

    In these frames the limbs move from the body's rest pose, for which its garments are made, to the first pose;
    the last frames hold the first pose. Without them, the sleeves of a garment would start inside its trunk where
    arms hang down. The body also glides over the floor at the speed of the motion's first step. So the settled
    cloth is as fast as the body when the motion begins.

    Args:
        poses: The body in motion.
        num_frames: Number of frames to put before it; drop as many from the result.
        body: Whose motion it is. Without it, for a mesh in motion, which has no skeleton, and with fewer than 25
            frames, all hold the first pose.

    Raises:
        MotionError: The number is negative, or the motion has fewer than two frames.
    """
    check_length(poses)
    if num_frames < 0:
        raise MotionError(f"can't settle for {num_frames} frames; give 0 or more")
    limbs = None
    if body is not None and begins_at_rest(num_frames, body):
        pose = np.asarray(poses.joint_transforms)[0].astype(np.float64)
        limbs = _limbs_from_rest(body, pose, num_frames - _HELD)
    positions, transforms = _glide((poses.positions, poses.joint_transforms), limbs, num_frames)
    return poses.replace(positions=positions, joint_transforms=transforms)


def begins_at_rest(num_frames: int, body: Body) -> bool:
    """Return whether `with_settling` has so many frames begin in the rest pose: its arguments."""
    return body.parents.count(-1) == 1 and num_frames - _HELD >= _FEWEST_MOVING


def _limbs_from_rest(body: Body, pose: NDArray, num_frames: int) -> _Track:
    """Return frames in which limbs come, slowly at both ends, from rest to `pose`, the map of every joint."""
    root = body.parents.index(-1)
    last = local_rotations(pose[None, :, :, :3], body.parents)
    time = np.arange(num_frames)[:, None, None] / num_frames
    rotations = time * time * (3 - 2 * time) * last
    rotations[:, root] = last[:, root]
    place = pose[root] @ [*np.asarray(body.joint_rest_positions)[root], 1.0]
    return turn_joints(body, rotations, np.tile(place, (num_frames, 1)))


@partial(jax.jit, static_argnames="num_frames")  # outside jit, every operation is a program of its own
def _glide(motion: _Track, limbs: _Track | None, num_frames: int) -> _Track:
    """Return a motion with frames before it, in which the body glides to its first frame.

    The body has the poses of `limbs`, if given, and then the pose of the first frame. Where a limb would be below
    the lowest point of the first frame, the body is lifted.
    """
    before = tuple(jnp.repeat(track[:1], num_frames, axis=0) for track in motion)
    if limbs is not None:
        before = tuple(held.at[: len(moved)].set(moved) for held, moved in zip(before, limbs, strict=True))
    step = (motion[0][1] - motion[0][0]).mean(axis=0)
    shifts = jnp.arange(-num_frames, 0, dtype=step.dtype)[:, None] * (step * jnp.array([1.0, 0.0, 1.0]))[None]
    lift = jnp.maximum(motion[0][0, :, 1].min() - before[0][:, :, 1].min(axis=1, initial=jnp.inf), 0.0)
    shifts = shifts.at[:, 1].set(lift)[:, None]
    return (
        jnp.concatenate([before[0] + shifts, motion[0]]),
        jnp.concatenate([before[1].at[..., 3].add(shifts), motion[1]]),
    )


def check_speed(poses: BodyMotion, limit: float, *, vertices: NDArray | None = None) -> None:
    """Raise a MotionError where contacts can't follow a body; it names the first such frame and its speed.

    They follow `limit` [m] along the outward normal between two frames. `vertices` are those of the body that
    cloth can reach; None for all that are an obstacle.
    """
    positions, faces = np.asarray(poses.positions), np.asarray(poses.faces)[np.asarray(poses.is_obstacle)]
    if vertices is not None:
        faces = faces[np.isin(faces, vertices).all(axis=1)]
    corners = np.unique(faces)
    for frame in range(1, len(positions)):
        moved = positions[frame] - positions[frame - 1]
        if not len(corners) or np.linalg.norm(moved[corners], axis=1).max() <= limit:
            continue  # most frames; normals are needed for the others only
        normals = normalize(face_cross_products(positions[frame - 1], faces))
        step = float(np.einsum("fka,fa->fk", moved[faces], normals).max())
        if step > limit:
            timestep = float(poses.timestep)
            kept = f"frames 0 to {frame - 1} are fine, --frames {frame} keeps them; " if frame > 1 else ""
            raise MotionError(
                f"the body moves {step:.2f} m in one frame, to frame {frame} ({frame * timestep:.2f} s; "
                f"{step / timestep:.1f} m/s), and contacts follow {limit:g} m: {kept}start later, or repair or "
                "slow down the motion"
            )
