"""Table IV of the paper: motions from another source than the training clips.

    python experiments/paper/new_motion.py [--smoke]

The paper takes a Mixamo character; here it is every third clip of DeepMimic, retargeted to the bundled body:
seven, a backflip, a roll and getting up from the ground among them.
"""

from __future__ import annotations

from rollouts import OPTIMUM, arguments, mean_over_garments, table, write

from eslr_jax.assets import load_splits
from eslr_jax.assets.load import default_model


def main() -> None:
    """Measure and write."""
    chosen = arguments(__doc__, frames=60)
    splits = load_splits()
    clips, garments = splits["motions"]["unseen_motion"][::3], ["tshirt", "dress"]
    models: tuple[str, ...] = (default_model(), "mgn-small-6k", OPTIMUM)
    if chosen.smoke:
        garments, clips, models = garments[:1], clips[:1], models[1:]
    measured = table(models, garments, clips, vertices=chosen.vertices, frames=chosen.frames)
    result = {"clips": clips, "frames": chosen.frames, "vertices": chosen.vertices, "garments": measured}
    write({**result, "mean": mean_over_garments(measured)}, chosen.out / "new_motion.json")


if __name__ == "__main__":
    main()
