"""Table III of the paper: garments that no network has seen, with each mode of the geodesic embedding.

    python experiments/paper/unseen_garments.py [--smoke]

The network was trained with canonical embeddings; the other modes show how far it carries over to raw ones (the
paper's limit on unseen garments) and to distances from landmarks.
"""

from __future__ import annotations

from rollouts import OPTIMUM, arguments, mean_over_garments, table, write

from eslr_jax.assets import load_splits
from eslr_jax.assets.load import START_MODEL, default_model

MODES = ("canonical", "landmarks", "raw")


def main() -> None:
    """Measure and write."""
    chosen = arguments(__doc__)
    splits = load_splits()
    garments, clips = splits["garments"]["unseen"], splits["motions"]["test"][:3]
    modes, others = MODES, ("mgn-small-6k", OPTIMUM)
    model = default_model()
    if chosen.smoke:
        garments, clips, modes, others, model = garments[:1], clips[:1], MODES[:1], (), START_MODEL
    sizes = {"vertices": chosen.vertices, "frames": chosen.frames}
    measured = {
        f"{model}, {mode}": table((model,), garments, clips, embedding_mode=mode, **sizes)[model]
        for mode in modes
    }
    measured |= table(others, garments, clips, **sizes)
    result = {"clips": clips, **sizes, "garments": measured, "mean": mean_over_garments(measured)}
    write(result, chosen.out / "unseen_garments.json")


if __name__ == "__main__":
    main()
