"""Count what passes through what: garments and outfits on clips, from starts that differ by 0.01 mm.

    python experiments/contact.py [--starts 10] [--worn dress pants+tshirt] [--clip cmu_016_29] [--vertices 1k]
                                  [--frames 100]
    python experiments/contact.py --smoke --out DIR

All is simulated as `eslr simulate` does it: BDF2, put on over the rest pose, a tolerance of 1 %. In every
frame a referee counts pairs of triangles that intersect, of cloth with the body and of cloth with cloth. A start
fails where there is one, where the simulator let something through, or where a frame ends with a force of 20
weights. How far the most stretched face goes is kept, too, and how many frames were simulated in several steps.
An outfit is written from the inside outwards; a `skirt` and an `underskirt` are a dress without its top.

Rows of contact.json stay until they are measured again.
"""

from __future__ import annotations

import numpy as np
from hard_cases.case import Run, shifted
from hard_cases.measures import largest_stretch
from harness import machine, parser, put

from eslr_jax import load_body, load_motion, pose_body, prepare_scene, simulate
from eslr_jax.mesh.topology import is_on_boundary
from eslr_jax.pipeline.assets import load_garment_file, load_splits, prepare_stored
from eslr_jax.pipeline.cli.console import use_compile_cache
from eslr_jax.pipeline.dressing.outfit import combine_garments
from eslr_jax.pipeline.formats.garment import GarmentFile
from eslr_jax.pipeline.report.crossing import intersecting_pairs
from eslr_jax.pose.timing import SETTLE_FRAMES, with_settling
from eslr_jax.types import Scene, Trajectory

OUTFITS = ("pants+tshirt", "shorts+dress", "underskirt+skirt", "tank+longsleeve", "pants+skirt")
WORN = ("tshirt", "tank", "longsleeve", "shorts", "pants", "dress", *OUTFITS)
FRAMES = 60
MOST_RESIDUAL = 20.0  # [weights]
NAMES = ("worn", "vertices", "clip", "frames", "start")  # of a row


def skirt_of(dress: GarmentFile) -> GarmentFile:
    """Return a dress from the waist down, held there."""
    height = dress.rest_positions[:, 1]
    waist = height.min() + 0.55 * np.ptp(height)
    faces = dress.faces[np.all(height[dress.faces] < waist, axis=1)]
    kept, faces = np.unique(faces, return_inverse=True)
    faces = faces.reshape(-1, 3)
    upper = is_on_boundary(faces, len(kept)) & (height[kept] > waist - 0.1)
    return GarmentFile(
        dress.rest_positions[kept], faces, dress.skin_weights[kept], dress.skin_indices[kept], upper
    )


def load(worn: str, vertices: str = "1k") -> GarmentFile:
    """Return a garment, or an outfit as one garment, from its names."""

    def one(name: str) -> GarmentFile:
        is_skirt = "skirt" in name
        stored = load_garment_file("dress" if is_skirt else name, vertices=vertices)
        return skirt_of(stored) if is_skirt else stored

    names = worn.split("+")
    return one(worn) if len(names) == 1 else combine_garments([one(name) for name in names], names)


def dressed(worn: str, clip: str, vertices: str = "1k", frames: int = FRAMES) -> Scene:
    """Return the scene that the command makes of a garment, or of an outfit, on the beginning of a clip."""
    body = load_body()
    poses = with_settling(pose_body(body, load_motion(clip), num_frames=frames), SETTLE_FRAMES, body)
    return prepare_scene(prepare_stored(load(worn, vertices)), poses, integrator="bdf2")


def judge(scene: Scene, trajectory: Trajectory) -> dict[str, object]:
    """Return what passed through what after the cloth had settled."""
    assert scene.body is not None
    cloth, skin = scene.garment, np.asarray(scene.body.surface.faces)
    own = np.asarray(cloth.faces)[np.asarray(cloth.rest_areas) > 0]
    pairs = [
        intersecting_pairs(
            np.asarray(trajectory.positions[frame], np.float64), own,
            np.asarray(scene.body.positions[frame], np.float64), skin,
        )
        for frame in range(SETTLE_FRAMES, scene.num_frames)
    ]  # fmt: skip
    of_body = [int((found >= len(own)).any(axis=1).sum()) for found in pairs]
    of_cloth = [len(found) - count for found, count in zip(pairs, of_body, strict=True)]
    assert trajectory.is_passed is not None
    passed = np.flatnonzero(np.asarray(trajectory.is_passed)[SETTLE_FRAMES:])
    residual = float(np.max(np.asarray(trajectory.residuals)[SETTLE_FRAMES:]))
    refined = int(np.sum(np.asarray(trajectory.substeps)[SETTLE_FRAMES:] > scene.substeps))
    stretch = largest_stretch(Run(scene, lambda frame: (), trajectory), SETTLE_FRAMES)
    return {
        "cloth_body": sum(of_body),
        "cloth_cloth": sum(of_cloth),
        "let_through": passed.tolist(),
        "residual_max": round(residual, 2),
        "stretch_max": round(stretch, 3),
        "refined": refined,
        "iterations": round(float(np.mean(np.asarray(trajectory.iterations)[SETTLE_FRAMES:])), 1),
        "passed": not (sum(of_body) or sum(of_cloth) or len(passed)) and residual < MOST_RESIDUAL,
    }


def main() -> None:
    options = parser(__doc__, "one garment, one clip, few frames")
    options.add_argument("--starts", type=int, default=1)
    options.add_argument("--worn", nargs="*", default=WORN)
    options.add_argument("--clip", nargs="*", default=load_splits()["motions"]["test"])
    options.add_argument("--vertices", default="1k")
    options.add_argument("--frames", type=int, default=FRAMES)
    chosen = options.parse_args()

    use_compile_cache()
    frames = 4 if chosen.smoke else chosen.frames
    for worn in chosen.worn[: 1 if chosen.smoke else None]:
        for clip in chosen.clip[: 1 if chosen.smoke else None]:
            scene = dressed(worn, clip, chosen.vertices, frames)
            for start in range(chosen.starts):
                run = simulate(None, shifted(scene, start), raises=False)
                scene = run.scene.replace(initial_state=scene.initial_state)  # with buffers that suffice
                row = {
                    "worn": worn,
                    "vertices": chosen.vertices,
                    "clip": clip,
                    "frames": frames,
                    "start": start,
                }
                row |= judge(run.scene, run.trajectory)
                put(chosen.out / "contact.json", "rows", row, NAMES, machine())
                print(row, flush=True)


if __name__ == "__main__":
    main()
