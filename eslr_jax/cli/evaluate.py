"""`eslr evaluate`: how good a network is."""

from __future__ import annotations

import json
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.table import Table

from eslr_jax.cli.console import app, progress, use_compile_cache


@app.command
def evaluate(
    model: str,
    split: str = "test",
    vertices: Literal["1k", "4k", "10k"] = "1k",
    garments: tuple[str, ...] = (),
    clips: tuple[str, ...] = (),
    iterations: int = 0,
    gap_frames: int = 40,
    every: int = 4,
    rollout_frames: int = 300,
    control: Literal["untrained", "no_decoder", "no_embedding", "random_embedding"] | None = None,
    json_: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> None:
    """Evaluate a network on a split: optimality gap, and free rollouts.

    Args:
        model: Name of a bundled network, or an exported file.
        split: train, validation, test or unseen_motion.
        vertices: Resolution of the garments.
        garments: Only these; the training garments if not given.
        clips: Only these; all of the split if not given.
        iterations: Solver iterations behind the network.
        gap_frames: Number of frames of each clip in which the gap is measured. 0 skips the gap, which takes most
            of the time.
        every: Measure only every n-th of these frames.
        rollout_frames: Length of the free rollouts; clips are played back and forth.
        control: Take something away, to see what it does: weights that were never trained, a decoder of zeros,
            geodesic coordinates that are zero, or random ones.
        json_: Print as JSON.
    """
    from eslr_jax.assets import load_model
    from eslr_jax.evaluation.evaluate import EvaluationOptions
    from eslr_jax.evaluation.evaluate import evaluate as run
    from eslr_jax.evaluation.report import environment

    params, architecture = load_model(model)
    options = EvaluationOptions(
        split=split,
        garments=garments,
        clips=clips,
        vertices=vertices,
        gap_frames=gap_frames,
        every=every,
        rollout_frames=rollout_frames,
        control=control,
    )
    use_compile_cache()
    with progress("evaluating", 1) as advance:
        result = run(
            params,
            architecture,
            options,
            iterations=iterations,
            on_scene=lambda done, total, label: advance(done, total),
        )
    result = {"model": model, "iterations": iterations, "control": control, **result, **environment()}
    if json_:
        print(json.dumps(result, indent=2))
        return
    if "on_policy" in result:
        _print_gaps(model, result)
    print(json.dumps(result["rollout"], indent=2))


def _print_gaps(model: str, result: dict[str, Any]) -> None:
    """Print the gaps of a network beside those of the solver."""
    table = Table(
        "", "gap, median [mJ]", "relative to the initial gap", "on the model's own states [mJ]", box=None
    )
    own = result["on_policy"]
    rows = {model: (result, own)}
    rows |= {f"L-BFGS {count}": (result["lbfgs"][count], own["lbfgs"][count]) for count in result["lbfgs"]}
    for label, (forced, policy) in rows.items():
        table.add_row(
            label,
            f"{forced['gap_median_j'] * 1e3:.3f}",
            f"{forced['gap_relative_median']:.4f}",
            f"{policy['gap_median_j'] * 1e3:.3f}",
        )
    Console().print(table, markup=False)
