"""Score anybody's trajectory by the measures that our own is reported with (host)."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from eslr_jax.errors import ConfigError, MissingExtraError, MotionError, NonFiniteError
from eslr_jax.evaluation.foreign import foreign_trajectory, with_energies
from eslr_jax.evaluation.gap import gap_medians, trajectory_gap
from eslr_jax.evaluation.referee import judge
from eslr_jax.evaluation.report import Parts, trajectory_report
from eslr_jax.evaluation.wear import wear_report
from eslr_jax.physics.membrane import principal_stretches
from eslr_jax.scene.build import skin_garment
from eslr_jax.types import BodyMotion, Scene, Trajectory

EVERY = 4  # frames between those whose gap and intersections are measured, as in `eslr evaluate`
_LEAST_FRAMES = (
    3  # the gap is measured from the second simulated frame on: the first one's velocity is guessed
)
_INTERSECTIONS = (
    "intersections_cloth",
    "intersections_cloth_max",
    "intersections_body",
    "intersections_body_max",
)


def score_trajectory(
    trajectory: Trajectory | Float[ArrayLike, "frames vertices 3"],
    scene: Scene,
    *,
    poses: BodyMotion | None = None,
    parts: Parts = (None, ()),
    every: int = EVERY,
) -> dict[str, Any]:
    """Score a trajectory of any simulator.

    Args:
        trajectory: Vertex positions [m], shape [frames, vertices, 3], in the order of the scene's garment; or a
            trajectory, whose velocities and friction loads then count.
        scene: What was simulated, of `prepare_scene`; it has as many frames.
        poses: The whole body, see `trajectory_report`; also how the garment sits is then measured.
        parts: Parts of the garment, see `trajectory_report`.
        every: Frames between those whose gap and intersections are measured.

    Returns:
        Plain values: those of `trajectory_report` without `iterations_mean`, with `poses` those of `wear_report`,
        and
        - `stretch_p99`: the principal stretch that 99 % of all faces keep, over all frames;
        - `gap_relative_median`, `gap_relative_max`: the optimality gap in our energy, from the trajectory's own
          states, relative to what a frame has to gain; `gap_median_j`, `gap_mean_j` and `gap_p90_j` in joules;
          `gap_frames`, the number of frames that it was measured in;
        - `intersections_cloth`, `intersections_body`: pairs of triangles that intersect in the last frame, and,
          ending in `_max`, in the worst of the frames measured. None without the extra `score`.

    Raises:
        ConfigError: `every` is less than one.
        MotionError: There are fewer than three frames, or another number of frames or vertices than in the scene.
        NonFiniteError: A position is NaN or infinite.
    """
    positions = np.asarray(trajectory.positions if isinstance(trajectory, Trajectory) else trajectory)
    _check(positions, scene, every)
    if not isinstance(trajectory, Trajectory):
        trajectory = foreign_trajectory(positions, scene)
    report = trajectory_report(with_energies(trajectory, scene), scene, parts=parts, poses=poses)
    del report["iterations_mean"]  # another simulator's are not ours
    if poses is not None:
        skinned = jax.jit(skin_garment)(scene.garment, poses.joint_transforms)
        report |= wear_report(positions, scene.garment, skinned, poses)
    ends = jax.device_get(trajectory_gap(trajectory, scene, every=every))
    is_face = np.asarray(scene.garment.rest_areas) > 0
    stretches = np.asarray(_stretches(trajectory.positions[1:], scene))[:, is_face]
    return report | {
        "stretch_p99": float(np.quantile(stretches, 0.99)),
        "gap_frames": len(ends.reached),
        **gap_medians(ends, ends.reached),
        "gap_relative_max": float(np.max(ends.share(ends.reached))),
        **_count_intersections(positions, scene, every),
    }


def _check(positions: np.ndarray, scene: Scene, every: int) -> None:
    """Raise unless positions are a trajectory of the scene."""
    if every < 1:
        raise ConfigError(f"every = {every}: give a number of frames, 1 or more")
    expected = (scene.num_frames, *scene.initial_state.position.shape)
    if positions.shape != expected:
        raise MotionError(
            f"positions {positions.shape} are not those of the scene, which has {list(expected)}: frames, "
            "vertices and 3; give a trajectory of this garment and of all frames"
        )
    if len(positions) < _LEAST_FRAMES:
        raise MotionError(f"{len(positions)} frames are too few to score; give {_LEAST_FRAMES} or more")
    is_finite = np.isfinite(positions).all(axis=(1, 2))
    if not is_finite.all():
        raise NonFiniteError(f"frame {np.argmin(is_finite)} is not finite; cut the trajectory before it")


@jax.jit
def _stretches(positions: Float[Array, "frames vertices 3"], scene: Scene) -> Float[Array, "frames faces"]:
    """Return the larger principal stretch of every face."""
    return jax.lax.map(lambda position: principal_stretches(position, scene.garment)[0], positions)


def _count_intersections(positions: np.ndarray, scene: Scene, every: int) -> dict[str, int | None]:
    """Return the pairs of triangles that intersect in the last frame, and in the worst of every so many."""
    faces = np.asarray(scene.garment.faces)[np.asarray(scene.garment.rest_areas) > 0]
    body, body_faces = None, None
    if scene.body is not None:
        body, body_faces = np.asarray(scene.body.positions), np.asarray(scene.body.surface.faces)
    frames = sorted({*range(2, len(positions), every), len(positions) - 1})
    try:
        verdicts = [
            judge(positions[frame], faces, None if body is None else body[frame], body_faces)
            for frame in frames
        ]
    except MissingExtraError:
        return dict.fromkeys(_INTERSECTIONS)
    cloth, with_body = zip(*((verdict.cloth_cloth, verdict.cloth_body) for verdict in verdicts), strict=True)
    return dict(zip(_INTERSECTIONS, (cloth[-1], max(cloth), with_body[-1], max(with_body)), strict=True))
