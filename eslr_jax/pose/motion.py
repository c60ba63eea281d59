"""Motions on a rig, and bodies posed by them (host)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import lru_cache, partial

import jax
import jax.numpy as jnp
import numpy as np

from eslr_jax.errors import ConfigError, MotionError
from eslr_jax.mesh.surface import prepare_surface
from eslr_jax.numerics import product, to_device
from eslr_jax.pose import lbs
from eslr_jax.pose.joints import find_parts, torso_axes
from eslr_jax.pose.retarget import ARM_ABDUCTION, abduct_arms, resample
from eslr_jax.pose.skeleton import Skeleton, check_tracks
from eslr_jax.types import Body, BodyMotion, BodySurface

SHOULDERS = 0.8  # of the body's height, for a body without arms
_MAX_ABDUCTION = 90.0  # [degrees]; arms lifted further are above the shoulders
_ORDINARY_YAW = np.deg2rad(35.0)  # a resting chest that faces +Z up to this is taken to face it


@dataclasses.dataclass(frozen=True)
class Motion:
    """Joint rotations over time, for one rig."""

    name: str
    rotations: np.ndarray  # local axis-angle relative to the rest pose [rad], shape [frames, joints, 3]
    translations: np.ndarray  # position of the root joint [m], shape [frames, 3]
    fps: float
    joint_names: tuple[str, ...]
    arm_abduction: float = ARM_ABDUCTION  # [degrees] that posing adds to both arms by default
    start: float = 0.0  # time of its first frame in the file that it comes from [s]

    def __post_init__(self) -> None:
        """Raise a MotionError unless there are frames of finite values and fitting shapes at a possible rate."""
        joints = len(self.joint_names)
        tracks = {"rotations": (self.rotations, (joints, 3)), "translations": (self.translations, (3,))}
        check_tracks(f"motion {self.name}", tracks, self.fps)


def still_motion(body: Body, num_frames: int, *, fps: float = 30.0, arm_angle: float = 0.0) -> Motion:
    """Return a motion of the rest pose, with both arms lifted by an angle [degrees]; a negative lowers them."""
    rotations = np.zeros((num_frames, len(body.joint_names), 3))
    if arm_angle:
        rotations = abduct_arms(rotations, body.joint_names, arm_angle, front=chest_direction(body))
    root = np.asarray(body.joint_rest_positions)[0].copy()
    root[1] -= float(np.asarray(body.rest_positions)[:, 1].min())  # soles on the floor
    return Motion(
        "still", rotations, np.tile(root, (num_frames, 1)), fps, body.joint_names, arm_abduction=0.0
    )


def pose_body(
    body: Body,
    motion: Motion,
    *,
    fps: float = 30.0,
    arm_abduction: float | None = None,
    num_frames: int | None = None,
) -> BodyMotion:
    """Pose a body along a motion.

    Args:
        body: A rigged body.
        motion: A motion for the same rig; see `eslr_jax.pipeline.rigs.rig.make_motion` for others.
        fps: Frames per second of the simulation; the motion is resampled to it.
        arm_abduction: Angle by which both arms are lifted [degrees], to keep them from pressing into the torso;
            by default the motion's own, which is 0 if it was made on this body.
        num_frames: Number of frames to keep; None keeps all.

    Returns:
        The body in motion. Its `positions` stand on the motion's floor, at y = 0 for bundled and loaded motions.
        Its `rest_positions` have the origin of the body's rest pose, like those of garments: the bundled body's
        is at the hips, 0.82 m above the soles. `joint_transforms` lead from there to the poses.

    Raises:
        MotionError: The motion is for another skeleton or has fewer frames than asked for, or the angle
            is too large.
    """
    if motion.joint_names != body.joint_names:
        strangers = [name for name in motion.joint_names if name not in body.joint_names]
        raise MotionError(
            f"motion {motion.name} is for another skeleton ({len(motion.joint_names)} joints, "
            f"unknown: {', '.join(strangers[:4]) or 'order differs'}); load it with this body"
        )
    rotations, translations = resample(motion.rotations, motion.translations, motion.fps, fps)
    if num_frames is not None:
        if num_frames > len(rotations):
            raise MotionError(
                f"motion {motion.name} has {len(rotations)} frames at {fps:g} fps, fewer than the "
                f"{num_frames} asked for; ask for fewer or choose a longer motion"
            )
        rotations, translations = rotations[:num_frames], translations[:num_frames]
    if arm_abduction is None:
        arm_abduction = motion.arm_abduction
    if not -_MAX_ABDUCTION <= arm_abduction <= _MAX_ABDUCTION:
        raise MotionError(
            f"arms can't be lifted by {arm_abduction:g} degrees; give {-_MAX_ABDUCTION:g} to {_MAX_ABDUCTION:g}"
        )
    if arm_abduction:
        rotations = abduct_arms(rotations, body.joint_names, arm_abduction, front=chest_direction(body))
    positions, transforms = turn_joints(body, rotations, translations)
    return body_motion(body, positions, transforms, fps=fps)


def turn_joints(body: Body, rotations: np.ndarray, translations: np.ndarray) -> tuple[jax.Array, jax.Array]:
    """Return the vertices of a body whose joints are turned [m], and the map of every joint.

    Shapes [frames, body_vertices, 3] and [frames, joints, 3, 4]. Rotations are local axis-angle vectors [rad],
    and translations the root's positions [m].
    """
    transforms = joint_transforms(rotations, translations, body.joint_rest_positions, body.parents)
    skin = body.rest_positions, body.skin_weights, body.skin_indices, body.pose_directions
    return _skin_frames(*skin, transforms, np.asarray(rotations[:, 1:], np.float32)), transforms


def first_poses(poses: BodyMotion, num_frames: int) -> BodyMotion:
    """Return the first frames of a body in motion, at most all of them."""
    return poses.replace(
        positions=poses.positions[:num_frames], joint_transforms=poses.joint_transforms[:num_frames]
    )


def body_motion(body: Body, positions: jax.Array, joint_transforms: jax.Array, *, fps: float) -> BodyMotion:
    """Return a body in motion, given its vertices [m] and the map of every joint; every one is made here."""
    return BodyMotion(
        positions=positions,
        joint_transforms=joint_transforms,
        faces=body.faces,
        is_obstacle=body.is_obstacle,
        timestep=to_device(1.0 / fps),
        rest_positions=body.rest_positions,
        surface=obstacle_surface(body),
    )


def lowest_point(poses: BodyMotion) -> float:
    """Return the height of the lowest point of a moving body [m]."""
    return float(np.min(np.asarray(poses.positions)[..., 1]))


def check_length(poses: BodyMotion) -> None:
    """Raise a MotionError where a body in motion has fewer than two frames."""
    if len(poses.joint_transforms) < 2:
        raise MotionError(
            f"a simulation needs two frames or more; this motion has {len(poses.joint_transforms)}"
        )


def obstacle_surface(body: Body) -> BodySurface:
    """Return the search tables of all faces of a body that cloth may touch."""
    faces = np.asarray(body.faces)[np.asarray(body.is_obstacle)]
    rest = np.asarray(body.rest_positions, np.float32)
    return _search_tables(rest.tobytes(), np.asarray(faces, np.int32).tobytes())


@lru_cache(maxsize=4)  # once per body
def _search_tables(rest_positions: bytes, faces: bytes) -> BodySurface:
    return prepare_surface(
        np.frombuffer(rest_positions, np.float32).reshape(-1, 3),
        np.frombuffer(faces, np.int32).reshape(-1, 3),
    )


def shape_body(body: Body, betas: Sequence[float] | np.ndarray) -> Body:
    """Return a body of another shape, at rest, such as one of a SMPL model.

    Of the shape coefficients `betas` [standard deviations], shape [shapes], those left out are zero. A
    ConfigError says that there are too many, or that one is not finite.
    """
    given, known = np.asarray(betas, np.float64).ravel(), body.shape_directions.shape[-1]
    if len(given) > known or not np.isfinite(given).all():
        raise ConfigError(
            f"{len(given)} betas for a body of {known} shapes; give at most {known} finite numbers"
        )
    coefficients = jnp.asarray(np.pad(given, (0, known - len(given))), jnp.float32)
    return body.replace(
        rest_positions=body.rest_positions + product(body.shape_directions, coefficients),
        joint_rest_positions=body.joint_rest_positions + product(body.joint_shape_directions, coefficients),
    )


@partial(jax.jit, static_argnums=3)
def joint_transforms(
    rotations: np.ndarray, translations: np.ndarray, joints: jax.Array, parents: tuple[int, ...]
) -> jax.Array:
    """Return the map of every joint from rest points to posed points, shape [frames, joints, 3, 4].

    Arguments are those of `lbs.joint_transforms`, rotations and translations for every frame.
    """
    turns, places = (jnp.asarray(values, jnp.float32) for values in (rotations, translations))
    return jax.vmap(lambda turn, place: lbs.joint_transforms(turn, place, joints, parents))(turns, places)


def chest_direction(body: Body) -> np.ndarray:
    """Return the direction that the resting chest faces, shape [3]; +Z if the rig doesn't tell."""
    skeleton = Skeleton(body.joint_names, body.parents, np.asarray(body.joint_rest_positions, np.float64))
    axes = torso_axes(skeleton, find_parts(skeleton))
    if axes is None or axes[2, 2] > np.cos(_ORDINARY_YAW):
        return np.array([0.0, 0.0, 1.0])
    return axes[:, 2]


@jax.jit
def _skin_frames(rest, weights, indices, directions, transforms, rotations):
    """Return posed vertices of every frame, with pose blend shapes if any (Loper et al. 2015, eqs. 8 and 9)."""

    def pose(frame):
        if directions is None:
            return lbs.skin(rest, weights, indices, frame[1])
        turned = jax.vmap(lbs.rotation_matrix)(frame[0]) - jnp.eye(3)[None]
        return lbs.skin(rest + lbs.bend(directions, turned), weights, indices, frame[1])

    return jax.lax.map(pose, (rotations, transforms))


def _frame_at(step: int, num_frames: int, first: int = 0) -> int:
    """Return the frame at the beginning of a step; see `there_and_back`."""
    if step < first:
        return step
    period = max(2 * (num_frames - 1 - first), 1)
    place = (step - first) % period
    return first + min(place, period - place)


def there_and_back(step: int, num_frames: int, first: int = 0) -> tuple[int, int]:
    """Return the two frames of a step of a motion that is played forth and back; those before `first` once."""
    return _frame_at(step, num_frames, first), _frame_at(step + 1, num_frames, first)


def back_and_forth(motion: Motion, num_frames: int, fps: float = 30.0) -> Motion:
    """Return a motion of at least `num_frames` frames at `fps`, played forwards and backwards by turns."""
    needed = int(np.ceil(num_frames * motion.fps / fps)) + 1
    index = [_frame_at(step, len(motion.translations)) for step in range(needed)]
    return dataclasses.replace(
        motion, rotations=motion.rotations[index], translations=motion.translations[index]
    )
