"""Count where skin comes through cloth, and measure what the timestep costs.

    python experiments/time_and_skin.py [--smoke] [--out DIR] [--part skin time] [--vertices 1k] [--garment ...]

Skin: garments on the six test clips as `eslr simulate` has them with its tolerance of 1 %, but for at most 100
iterations a frame, by BDF2 and by implicit Euler. In every fifth frame the referee of the hard cases counts pairs
of intersecting triangles of cloth and body, and of cloth and cloth. Frames in which the body intersects itself
within 5 cm of the cloth are told apart: there two limbs pinch it.

Time: T-shirt and dress on three clips against BDF2 at 1/960 s, by both integrators with one to eight steps a
frame. All begin with the same settled cloth. The cost is CPU time, which other jobs do not change much; it is
null where the program was compiled during the measurement.

Rows of time_and_skin.json stay until they are measured again.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from harness import parser, put
from scipy.spatial import cKDTree

from eslr_jax import SimConfig, load_body, load_garment, load_motion, pose_body, simulate
from eslr_jax.fabric.materials import COTTON
from eslr_jax.mesh.closest import nearest_places
from eslr_jax.mesh.topology import vertex_normals
from eslr_jax.pipeline.assets import load_splits
from eslr_jax.pipeline.cli.console import use_compile_cache
from eslr_jax.pipeline.report.crossing import intersecting_pairs
from eslr_jax.pipeline.report.report import environment
from eslr_jax.pose.timing import SETTLE_FRAMES, with_settling
from eslr_jax.simulation.plan import prepare_scenes
from eslr_jax.simulation.scene import Integrator, start_integrator
from eslr_jax.types import Scene

PARTS = ("skin", "time")
NAMES = ("garment", "vertices", "clip", "integrator", "steps")  # of a row
GARMENTS = ("tshirt", "tank", "longsleeve", "shorts", "pants", "dress")
INTEGRATORS: tuple[Integrator, ...] = ("bdf2", "euler")
FPS, FRAMES = 30.0, 60
EVERY = 5  # frames between those that are judged
PINCH = 0.05  # [m] from the cloth, within which the body may not intersect itself
DEFAULT = SimConfig(iterations=100, tolerance=0.01)  # the command allows 500, and takes 45 on average
TIMED = ("tshirt", "dress")
SECOND = 31  # frames
STEPS: dict[Integrator, tuple[int, ...]] = {"euler": (1, 2, 4, 8), "bdf2": (1, 2, 4)}  # a frame
FINEST = 32  # 1/960 s
FINE = SimConfig(iterations=100, tolerance=1e-3)
_NO_COMPILATION = 1.0  # [s] of waiting for a program that is there already, at most


def make_scenes(garments: list[Any], motions: list[Any]) -> list[Scene]:
    """Return every garment on every motion: scenes of one shape, which share a program, garment by garment."""
    count = len(motions)
    cloths = [garment for garment in garments for _ in range(count)]
    return prepare_scenes(cloths, motions * len(garments), [COTTON] * len(cloths))


def begun(scene: Scene, integrator: Integrator) -> Scene:
    """Return a scene that is stepped by an integrator."""
    return scene.replace(initial_state=start_integrator(scene.initial_state, integrator))


def measure_skin(garments: Sequence[str], vertices: Any, clips: Sequence[str], frames: int) -> Iterator[dict]:
    """Yield a row for every garment, clip and integrator."""
    body = load_body()
    motions = [
        with_settling(pose_body(body, load_motion(clip), fps=FPS, num_frames=frames), SETTLE_FRAMES, body)
        for clip in clips
    ]
    scenes = make_scenes([load_garment(name, vertices=vertices) for name in garments], motions)
    pinched = [_own_crossings(scene, frames) for scene in scenes[: len(clips)]]
    for number, scene in enumerate(scenes):
        garment, clip = divmod(number, len(clips))
        for integrator in INTEGRATORS:
            run = simulate(None, begun(scene, integrator), config=DEFAULT)
            judged = [
                judge_frame(scene, np.asarray(run.trajectory.positions[frame], np.float64), frame, crossings)
                for frame, crossings in pinched[clip].items()
            ]
            yield {
                "garment": garments[garment], "vertices": vertices, "clip": clips[clip],
                "integrator": integrator,
                **{name: [frame[name] for frame in judged] for name in judged[0]},
            }  # fmt: skip


def _own_crossings(scene: Scene, frames: int) -> dict[int, np.ndarray]:
    """Return where the body intersects itself, centres of faces [m], by the frames that are judged."""
    found = {}
    for frame in range(SETTLE_FRAMES, SETTLE_FRAMES + frames, EVERY):
        body, faces = _body(scene, frame)
        found[frame] = body[faces[np.unique(intersecting_pairs(body, faces))]].mean(axis=1)
    return found


def _body(scene: Scene, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the body's vertices in a frame [m], and its faces, as far as garments reach it."""
    assert scene.body is not None
    return np.asarray(scene.body.positions[frame], np.float64), np.asarray(scene.body.surface.faces)


def judge_frame(scene: Scene, positions: np.ndarray, frame: int, crossings: np.ndarray) -> dict[str, Any]:
    """Return the pairs of a frame, its depth for 99.9 % of vertices [mm], and whether the body pinches it.

    `crossings` are where the body intersects itself [m].
    """
    cloth, (body, faces) = scene.garment, _body(scene, frame)
    own = np.asarray(cloth.faces)[np.asarray(cloth.rest_areas) > 0]
    is_body = (intersecting_pairs(positions, own, body, faces) >= len(own)).any(axis=1)
    real = positions[np.asarray(cloth.vertex_mask)]
    place = nearest_places(real, body, faces, vertex_normals(body, faces))
    depth = -np.einsum("px,px->p", place.offsets, place.normals)
    nearest = cKDTree(real).query(crossings)[0] if len(crossings) else np.array([np.inf])
    return {
        "cloth_body": int(np.sum(is_body)),
        "cloth_cloth": int(np.sum(~is_body)),
        "is_pinched": bool(nearest.min() < PINCH),
        "depth_mm": round(1e3 * max(float(np.quantile(depth, 0.999)), 0.0), 3),
    }


def measure_time(
    garments: Sequence[str], vertices: Any, clips: Sequence[str], is_smoke: bool
) -> Iterator[dict]:
    """Yield a row for every garment, clip, integrator and number of steps a frame."""
    frames, finest = (4, 2) if is_smoke else (SECOND, FINEST)
    counts: dict[Integrator, tuple[int, ...]] = {"euler": (1,), "bdf2": (1,)} if is_smoke else STEPS
    cloths, body = [load_garment(name, vertices=vertices) for name in garments], load_body()

    def posed(steps: int) -> list[Scene]:
        length = (frames - 1) * steps + 1
        motions = [pose_body(body, load_motion(clip), fps=FPS * steps, num_frames=length) for clip in clips]
        return make_scenes(cloths, motions)

    usual = [pose_body(body, load_motion(clip), fps=FPS, num_frames=frames) for clip in clips]
    settling = make_scenes(cloths, [with_settling(poses, SETTLE_FRAMES, body) for poses in usual])
    starts = [simulate(None, scene, config=FINE).trajectory.positions[SETTLE_FRAMES] for scene in settling]

    def run(integrator: Integrator, steps: int) -> Iterator[tuple[np.ndarray, float | None]]:
        for scene, start in zip(posed(steps), starts, strict=True):
            ready = begun(scene, integrator)
            ready = ready.replace(initial_state=ready.initial_state.replace(position=start))
            began = time.process_time()
            done = simulate(None, ready, config=FINE)
            took = 1e3 * (time.process_time() - began) / (frames - 1)
            # Compilation takes another share of the processor than of the clock, so it can't be subtracted.
            has_compiled = done.timing.compile_s > _NO_COMPILATION
            yield np.asarray(done.trajectory.positions, np.float64)[::steps], None if has_compiled else took

    references = [positions for positions, _ in run("bdf2", finest)]
    for integrator, numbers in counts.items():
        for steps in numbers:
            for number, (positions, cost) in enumerate(run(integrator, steps)):
                is_real = np.asarray(settling[number].garment.vertex_mask)
                distance = 1e3 * np.linalg.norm(positions - references[number], axis=-1)[1:, is_real]
                garment, clip = divmod(number, len(clips))
                yield {
                    "garment": garments[garment], "vertices": vertices, "clip": clips[clip],
                    "integrator": integrator, "steps": steps,
                    "rms_mm": float(np.sqrt(np.mean(distance**2))),
                    "first_third_rms_mm": float(np.sqrt(np.mean(distance[: frames // 3] ** 2))),
                    "median_mm": float(np.median(distance)),
                    "cpu_ms": cost,
                }  # fmt: skip


def main() -> None:
    options = parser(__doc__, "one garment, one clip, few frames")
    options.add_argument("--part", nargs="*", choices=PARTS, default=PARTS)
    options.add_argument("--garment", nargs="*", choices=GARMENTS)
    options.add_argument("--vertices", default="1k")
    chosen = options.parse_args()

    use_compile_cache()
    clips, is_smoke = list(load_splits()["motions"]["test"]), chosen.smoke
    path = chosen.out / "time_and_skin.json"
    for part in chosen.part:
        garments = list(chosen.garment or (GARMENTS if part == "skin" else TIMED))[: 1 if is_smoke else None]
        if part == "skin":
            frames, some = (6, clips[:1]) if is_smoke else (FRAMES, clips)
            rows = measure_skin(garments, chosen.vertices, some, frames)
        else:
            rows = measure_time(garments, chosen.vertices, clips[: 1 if is_smoke else 3], is_smoke)
        for row in rows:
            put(path, part, row, NAMES, environment())
            print(part, row, flush=True)


if __name__ == "__main__":
    main()
