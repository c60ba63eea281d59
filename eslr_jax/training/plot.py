"""Training curves (extra `plot`)."""

from __future__ import annotations

import json
from pathlib import Path

from eslr_jax.config import TrainConfig
from eslr_jax.files.atomic import atomic_write

_TERMS = ("stretch", "bending", "inertia", "collision", "friction")


def plot_curves(folder: Path, config: TrainConfig) -> Path | None:
    """Draw the curves of a run's `metrics.jsonl` into `curves.png`; None without matplotlib or metrics."""
    try:
        import matplotlib
    except ImportError:
        return None
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    records = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    if not records:
        return None
    steps = [record["step"] for record in records]
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
    losses = [record["loss"] for record in records]
    spans_decades = not 0 < max(losses) < 10 * min(losses)
    left.plot(steps, losses)
    left.set(xlabel="step", ylabel=f"loss, {_unit(config)}", yscale="symlog" if spans_decades else "linear")
    for term in _TERMS:
        right.plot(steps, [max(record[term], 1e-7) for record in records], label=term)
    right.set(xlabel="step", ylabel="energy at the prediction, median [J]", yscale="log")
    right.legend()
    with atomic_write(folder / "curves.png") as temporary:
        figure.savefig(temporary, format="png", dpi=100)
    plt.close(figure)
    return folder / "curves.png"


def _unit(config: TrainConfig) -> str:
    """Return what a run's loss is measured in, see `training.loss`."""
    if config.iterations:
        return "mean logarithm of the shares of gap and squared distance that are left"
    if config.refinement_weights == "contraction":
        return "mean share of a pass's gap that it leaves"
    return "J" if config.energy_set == "hood" else "in units of lifting the garment by 1 cm"
