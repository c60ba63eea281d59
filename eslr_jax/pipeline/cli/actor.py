"""Who moves in `eslr simulate`: a body and its motion."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from eslr_jax.errors import ConfigError
from eslr_jax.pipeline.cli.options import Options, parse_seconds, refuse_given

if TYPE_CHECKING:
    from eslr_jax.types import Body, BodyMotion

FPS = 30.0  # of the simulation


class Actor(NamedTuple):
    """A body, and how it moves."""

    rig: Body
    poses: BodyMotion
    motion: str  # its name
    start: float  # time of the first frame in the motion's file [s]


def is_moving_mesh(body: str) -> bool:
    """Tell a mesh in motion from a rigged body; a folder that has the name of a bundled body is none."""
    from eslr_jax.files.parsing import split_name
    from eslr_jax.pipeline.assets import asset_names
    from eslr_jax.pipeline.formats.mesh_sequence import is_mesh_sequence

    path = body if Path(body).exists() else split_name(body)[0]
    return Path(path).exists() and body not in asset_names("body") and is_mesh_sequence(path)


def load_wearer(body: str, *, units: str | None = None, betas: tuple[float, ...] = ()) -> Body:
    """Load a body at rest; a moving mesh rests in its first frame."""
    from eslr_jax.pipeline.assets import load_body
    from eslr_jax.pipeline.formats.mesh_sequence import read_mesh_sequence
    from eslr_jax.pipeline.rigs.sequence import pose_sequence

    if not is_moving_mesh(body):
        return load_body(body, units=units, betas=betas)
    if betas:
        raise ConfigError(f"{body} is a mesh in motion and has no shapes; leave out --betas")
    return pose_sequence(read_mesh_sequence(body), num_frames=1, units=units)[0]


def load_actor(options: Options) -> Actor:
    """Load a body and set it in motion."""
    from eslr_jax.pipeline.assets import load_body, load_motion
    from eslr_jax.pipeline.assets.motions import own_motion, read_joint_map
    from eslr_jax.pipeline.formats.mesh_sequence import read_mesh_sequence
    from eslr_jax.pipeline.rigs.sequence import pose_sequence
    from eslr_jax.pose.motion import pose_body
    from eslr_jax.pose.timing import cut_start, loop_motion

    body = options.body
    if is_moving_mesh(body):
        given = {
            "--motion": options.motion is not None,
            "--start": options.start is not None,
            "--loop": options.loop is not None,
            "--joint-map": options.joint_map is not None,
            "--arm-abduction": options.arm_abduction is not None,
            "--motion-up": options.motion_up != "auto",
            "--betas": bool(options.betas),
        }
        refuse_given(f"{body} is a mesh in motion and follows no other", given)
        sequence = read_mesh_sequence(body, fps=options.body_fps)
        return Actor(*pose_sequence(sequence, num_frames=options.frames, units=options.body_units), body, 0.0)
    if options.body_fps is not None:
        raise ConfigError(f"--body-fps is for bodies that are moving meshes, which {body} is not")
    rig = load_body(body, units=options.body_units, betas=options.betas)
    motion = options.motion or own_motion(body)
    changes = None if options.joint_map is None else read_joint_map(options.joint_map)
    clip = load_motion(motion, body=rig, joint_map=changes, up=options.motion_up)
    if options.start is not None:
        clip = cut_start(clip, parse_seconds(options.start, FPS, option="--start"))
    if options.loop is not None:
        clip = loop_motion(clip, parse_seconds(options.loop, FPS, option="--loop"))
    poses = pose_body(rig, clip, num_frames=options.frames, arm_abduction=options.arm_abduction)
    return Actor(rig, poses, motion, clip.start)
