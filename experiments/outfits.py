"""Count where garments that are worn together pass through each other, and what substeps change.

    python experiments/outfits.py [--substeps 1 2] [--smoke] [--out DIR]

Four outfits on a walk, with what `eslr simulate` models: BDF2, skin contacts, a tolerance of 1 %. The referee of
the hard cases counts intersecting pairs of a face of one garment and a face of the other. Writes outfits.json.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from harness import keep, machine, parser

from eslr_jax import SimConfig, load_body, load_motion, pose_body, prepare_scene, simulate
from eslr_jax.mesh.topology import is_on_boundary
from eslr_jax.pipeline.assets import load_garment_file, prepare_stored
from eslr_jax.pipeline.dressing.outfit import combine_garments
from eslr_jax.pipeline.formats.garment import GarmentFile
from eslr_jax.pipeline.report.crossing import intersecting_pairs
from eslr_jax.pose.timing import SETTLE_FRAMES, with_settling

OUTFITS = (("pants", "tshirt"), ("shorts", "dress"), ("underskirt", "skirt"), ("tank", "longsleeve"))
CLIP = "cmu_016_32"  # of the test split
FRAMES = 100
EVERY = 5  # frames between those that are judged
CONFIG = SimConfig(iterations=300, tolerance=0.01)


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


def load(name: str) -> GarmentFile:
    """Return a garment of an outfit by its name."""
    return skirt_of(load_garment_file("dress")) if "skirt" in name else load_garment_file(name)


def count_pairs(names: tuple[str, ...], frames: int = FRAMES, substeps: int = 1) -> dict[str, Any]:
    """Return the pairs of two garments, the inner one first, in every so many frames of a walk."""
    outfit = combine_garments([load(name) for name in names], names)
    body = load_body()
    poses = with_settling(pose_body(body, load_motion(CLIP), num_frames=frames), SETTLE_FRAMES, body)
    options = {"integrator": "bdf2", "substeps": substeps}
    run = simulate(None, prepare_scene(prepare_stored(outfit), poses, **options), config=CONFIG)
    garment = np.repeat([0, 1], list(outfit.metadata["outfit"].values()))[outfit.faces[:, 0]]
    positions = np.asarray(run.trajectory.positions)[SETTLE_FRAMES:][::EVERY]
    counts = [
        int(np.sum(garment[pairs[:, 0]] != garment[pairs[:, 1]]))
        for pairs in (intersecting_pairs(position, outfit.faces) for position in positions)
    ]
    return {
        "outfit": names,
        "substeps": substeps,
        "pairs": counts,
        "residual_max": float(np.max(run.trajectory.residuals)),
        "frame_ms": run.timing.frame_ms,
    }


def main() -> None:
    options = parser(__doc__, "one outfit, six frames, no substeps")
    options.add_argument("--substeps", type=int, nargs="+", default=[1, 2])
    chosen = options.parse_args()
    outfits, frames, substeps = OUTFITS, FRAMES, chosen.substeps
    if chosen.smoke:
        outfits, frames, substeps = OUTFITS[:1], 6, [1]
    rows = []
    for names in outfits:
        for count in substeps:
            rows.append(row := count_pairs(names, frames, count))
            print(json.dumps(row), flush=True)
    result = {"clip": CLIP, "frames": frames, "every": EVERY, "rows": rows, **machine()}
    keep(chosen.out / "outfits.json", result)


if __name__ == "__main__":
    main()
