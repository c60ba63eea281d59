"""Garments on clips: what the tables measure on, and what supervised systems learn from."""

import functools
from typing import NamedTuple

import numpy as np

from eslr_jax.errors import NonFiniteError, Status
from eslr_jax.fabric.materials import COTTON
from eslr_jax.pipeline.assets import load_body, load_garment, load_motion
from eslr_jax.pose.motion import back_and_forth, pose_body
from eslr_jax.simulation.plan import prepare_scenes
from eslr_jax.terms import FAST
from eslr_jax.types import BodyMotion, Scene, Trajectory

OPTIMUM_ITERATIONS = 60  # of L-BFGS: leaves 0.03 % of the initial gap


class Setting(NamedTuple):
    """What the rows of a table share."""

    garments: tuple[str, ...]  # names of bundled garments
    clips: tuple[str, ...]  # names of bundled clips, played back and forth
    frames: int  # of every rollout
    vertices: str


class Worn(NamedTuple):
    """A garment on a clip."""

    garment: str
    scene: Scene
    poses: BodyMotion

    def root_height(self) -> float:
        """Return the height of the root joint in the first frame [m]."""
        rest = np.append(np.asarray(load_body().joint_rest_positions[0]), 1.0)
        return float((self.poses.joint_transforms[0, 0] @ rest)[1])


def not_finite(trajectory: Trajectory) -> float:
    """Return one where something was not finite at some frame, else zero.

    A network that corrects the solver's guess falls back to it there, and the positions do not show it.
    """
    return float(Status.NON_FINITE in Status(int(trajectory.status)))


def check_optimum(trajectory: Trajectory, garment: str) -> None:
    """Raise NonFiniteError, with garment and frame, if a rollout that others are compared with is not finite."""
    if not_finite(trajectory):
        frame = int(trajectory.first_bad_frame)
        raise NonFiniteError(
            f"{garment}: the optimum's rollout is not finite in frame {frame}; nothing compares"
        )


@functools.lru_cache(maxsize=1)
def wear(garment_options: tuple[tuple[str, object], ...], setting: Setting) -> list[Worn]:
    """Return every garment on every clip, in cotton; all share a compiled rollout.

    The last answer is kept, as most systems ask for the same options of `load_garment`.
    """
    body = load_body()
    motions = [
        pose_body(body, back_and_forth(load_motion(clip), setting.frames), num_frames=setting.frames)
        for clip in setting.clips
    ]
    names = [name for name in setting.garments for _ in motions]
    worn = [load_garment(name, vertices=setting.vertices, **dict(garment_options)) for name in names]  # type: ignore[arg-type]
    poses = motions * len(setting.garments)
    scenes = prepare_scenes(worn, poses, [COTTON] * len(worn), terms=FAST)
    return [Worn(*row) for row in zip(names, scenes, poses, strict=True)]
