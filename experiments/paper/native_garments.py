"""Tables I and II of the paper: native garments on unseen clips, and the ablation of LSDMP and GSA.

    python experiments/paper/native_garments.py [--smoke]

The ablation's networks were trained with the same recipe, data and number of steps
(experiments/configs/ablation.toml); the bundled ones have recipes of their own.
"""

from __future__ import annotations

from rollouts import OPTIMUM, arguments, mean_over_garments, table, write

from eslr_jax.assets import load_splits

ABLATION = ("eslr-small-6k", "lsdmp-small-6k", "gsa-small-6k", "mgn-small-6k")
BUNDLED = ("eslr-small", "smooth-small+20")


def main() -> None:
    """Measure and write."""
    chosen = arguments(__doc__)
    splits = load_splits()
    garments, clips = splits["garments"]["train"], splits["motions"]["test"][:3]
    models = (*ABLATION, *BUNDLED, OPTIMUM)
    if chosen.smoke:
        garments, clips, models = garments[:1], clips[:1], BUNDLED[-1:]
    measured = table(models, garments, clips, vertices=chosen.vertices, frames=chosen.frames)
    result = {"clips": clips, "frames": chosen.frames, "vertices": chosen.vertices, "garments": measured}
    write({**result, "mean": mean_over_garments(measured)}, chosen.out / "native_garments.json")


if __name__ == "__main__":
    main()
