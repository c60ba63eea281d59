"""`eslr evaluate` and `eslr stress`: how good a simulator is."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.table import Table

from eslr_jax.cli.console import app, progress, stderr, use_compile_cache
from eslr_jax.errors import MissingExtraError


@app.command
def evaluate(
    model: str,
    split: str = "test",
    vertices: Literal["1k", "4k", "10k"] = "1k",
    garments: tuple[str, ...] = (),
    clips: tuple[str, ...] = (),
    corrector_steps: int = 0,
    gap_frames: int = 40,
    every: int = 4,
    rollout_frames: int = 300,
    json_: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> None:
    """Evaluate a network on a split: optimality gap, and free rollouts.

    Args:
        model: Name of a bundled network, or an exported file.
        split: train, validation, test or unseen_motion.
        vertices: Resolution of the garments.
        garments: Only these; the training garments if not given.
        clips: Only these; all of the split if not given.
        corrector_steps: Solver iterations behind the network.
        gap_frames: Frames of each clip from which the gap is measured.
        every: Of those, measure one in so many.
        rollout_frames: Length of the free rollouts; clips are played back and forth.
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
    )
    use_compile_cache()
    with progress("evaluating", 1) as advance:
        result = run(
            params,
            architecture,
            options,
            corrector_steps=corrector_steps,
            on_scene=lambda done, total, label: advance(done, total),
        )
    result = {"model": model, "corrector_steps": corrector_steps, **result, **environment()}
    if json_:
        print(json.dumps(result, indent=2))
        return
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
    print(json.dumps(result["rollout"], indent=2))


@app.command
def stress(
    simulator: Literal["physics", "network", "corrected"] = "physics",
    model: str | None = None,
    case: tuple[str, ...] = (),
    iterations: int = 200,
    corrector_steps: int = 20,
    out: Path | None = None,
    json_: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> None:
    """Run the hard cases: fifteen situations that break simulators. Exits with 0 if they ran, passed or not.

    Args:
        simulator: The physics solver, a trained network, or a network with the solver behind it.
        model: Name of a bundled network or an exported file; the default network if not given.
        case: Only these; all if not given.
        iterations: Solver iterations per frame of the physics simulator.
        corrector_steps: Solver iterations behind the network, where it is corrected.
        out: Folder for a picture of each case, a sheet of all, and the figures with versions.
        json_: Print one row per measure as JSON: case, passed, measure, value, bar.
    """
    from eslr_jax.assets import load_model
    from eslr_jax.assets.load import default_model
    from eslr_jax.evaluation.hard_cases import CASES, find_case, network_simulator, physics_simulator
    from eslr_jax.evaluation.stress import rows, summary, write_pictures
    from eslr_jax.evaluation.stress import stress as run
    from eslr_jax.io.atomic import atomic_write, ensure_output_dir

    for name in case:
        find_case(name)
    out = None if out is None else ensure_output_dir(out)
    use_compile_cache()
    if simulator == "physics":
        chosen = physics_simulator(iterations=iterations)
    else:
        model = model or default_model()
        steps = corrector_steps if simulator == "corrected" else 0
        label = f"{model}, {steps} corrector iterations" if steps else model
        chosen = network_simulator(*load_model(model), name=label, corrector_steps=steps)
    table = Table("case", "measure", "value", "bar", "passed", title=chosen.name, box=None)
    total = len(case or CASES)
    with progress("hard cases", total) as advance:
        done: list[str] = []

        def show(name: str, outcome: Any, seconds: float) -> None:
            done.append(name)
            advance(len(done), total)
            for row in outcome.rows():
                value = "not finite" if row["value"] is None else f"{row['value']:.4g}"
                bar = "" if row["bar"] is None else f"{row['bar']:g}"
                passed = "" if row["bar"] is None else "yes" if row["passed"] else "NO"
                table.add_row(name, row["measure"], value, bar, passed)

        outcomes = run(chosen, case, on_case=show)
    if out is not None:
        with atomic_write(out / "hard_cases.json") as temporary:
            temporary.write_text(json.dumps(summary(chosen, outcomes), indent=2))
        try:
            with progress("rendering", total) as advance:
                write_pictures(outcomes, out, on_picture=advance)
        except MissingExtraError as error:
            stderr.print(f"no pictures: {error}", markup=False, highlight=False)
    if json_:
        print(json.dumps(rows(outcomes), indent=2))
        return
    Console().print(table, markup=False)
    passed = sum(outcome.is_passed for outcome in outcomes)
    for outcome in outcomes:
        if not outcome.is_passed:
            case_ = CASES[outcome.case]
            print(f"failed: {outcome.case}: {case_.reason}")
            if simulator == "physics" and case_.limit:
                print(f"    known: {case_.limit}")
    print(f"{passed} of {total} cases passed")
