"""Measure what the timestep costs.

    python experiments/timestep.py [--smoke] [--out DIR] [--vertices 1k] [--garment tshirt dress]

T-shirt and dress on three clips against BDF2 at 1/960 s, by both integrators with one to eight steps a frame. All
begin with the same settled cloth. The cost is CPU time, which other jobs do not change much; it is null where the
program was compiled meanwhile. Rows of timestep.json stay until they are measured again.
"""

import time
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from harness import parser, put

from eslr_jax import SimConfig, load_body, load_garment, load_motion, pose_body, prepare_scenes, simulate
from eslr_jax.fabric.materials import COTTON
from eslr_jax.pipeline.assets import split_clips
from eslr_jax.pipeline.cli.console import use_compile_cache
from eslr_jax.pipeline.report.report import environment
from eslr_jax.pose.timing import SETTLE_FRAMES, with_settling
from eslr_jax.simulation.scene import Integrator, start_integrator
from eslr_jax.types import BodyMotion, Scene

NAMES = ("garment", "vertices", "clip", "integrator", "steps")  # of a row
FPS = 30.0
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


def measure_time(
    garments: Sequence[str], vertices: Any, clips: Sequence[str], is_smoke: bool
) -> Iterator[dict]:
    """Yield a row for every garment, clip, integrator and number of steps a frame."""
    frames, finest = (4, 2) if is_smoke else (SECOND, FINEST)
    counts: dict[Integrator, tuple[int, ...]] = {"euler": (1,), "bdf2": (1,)} if is_smoke else STEPS
    cloths, body = [load_garment(name, vertices=vertices) for name in garments], load_body()

    def posed(steps: int) -> list[BodyMotion]:
        length = (frames - 1) * steps + 1
        return [pose_body(body, load_motion(clip), fps=FPS * steps, num_frames=length) for clip in clips]

    settling = make_scenes(cloths, [with_settling(poses, SETTLE_FRAMES, body) for poses in posed(1)])
    starts = [simulate(None, scene, config=FINE).trajectory.positions[SETTLE_FRAMES] for scene in settling]

    def run(integrator: Integrator, steps: int) -> Iterator[tuple[np.ndarray, float | None]]:
        for scene, start in zip(make_scenes(cloths, posed(steps)), starts, strict=True):
            state = start_integrator(scene.initial_state.replace(position=start), integrator)
            ready = scene.replace(initial_state=state)
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
    options.add_argument("--garment", nargs="*", choices=TIMED, default=TIMED)
    options.add_argument("--vertices", default="1k")
    chosen = options.parse_args()

    use_compile_cache()
    garments = chosen.garment[: 1 if chosen.smoke else None]
    clips = split_clips("test")[: 1 if chosen.smoke else 3]
    for row in measure_time(garments, chosen.vertices, clips, chosen.smoke):
        put(chosen.out / "timestep.json", "time", row, NAMES, environment())
        print(row, flush=True)


if __name__ == "__main__":
    main()
