"""Measure what is known of cloth in closed form, and what the error of a walk consists of.

    python experiments/known_answers [--smoke] [--out DIR] [--part answers drape walk]

Answers: free fall, terminal velocity, energy of a swing, a hanging strip, rigidity of a cantilever and of a
cylinder, a twisted sheet, a slope, a ball. Drape: Cusick's coefficient of woven fabrics. Walk: millimetres by
tolerance, timestep and mesh. Writes known_answers.json, part by part, and with matplotlib (extra `plot`)
known_answers.png.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

EXPERIMENTS = Path(__file__).resolve().parents[1]
PARTS = ("answers", "drape", "walk")
_DRAPED = ("satin-woven", "jersey-woven", "suiting-woven", "denim-woven", "brocade-woven", "crepe-woven")


def measure(part: str, is_smoke: bool) -> Iterator[tuple[dict[str, Any], Any]]:
    """Yield a part's rows, each with its drape for the picture or None."""
    if part == "answers":
        from known_answers.cases import CASES

        for case in CASES:
            for one in case(is_smoke):
                numbers = {"found": float(one.found), "known": float(one.known), "is_within": one.is_within}
                yield {**one._asdict(), **numbers}, None
    elif part == "walk":
        from known_answers.walk import refine

        for row in refine(is_smoke):
            yield row._asdict(), None
    else:
        from known_answers.drape import drape

        size = {"spacing": 0.03, "frames": 6} if is_smoke else {}
        for fabric in _DRAPED[:1] if is_smoke else _DRAPED:
            one = drape(fabric, **size)
            yield {key: value for key, value in one._asdict().items() if key != "outline"}, one


def draw(result: dict[str, Any], drapes: list, path: Path) -> None:
    """Draw the answers, the drapes' shadows and the walk's error; nothing without matplotlib."""
    try:
        import matplotlib
    except ImportError:
        return
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(16, 6), layout="constrained")
    answers = result.get("answers", [])
    labels = [f"{row['case']}, {row['setting']}" for row in answers]
    errors = [100 * (row["found"] / row["known"] - 1) for row in answers]
    left.barh(
        labels, errors, color=["#3b7" if row["is_within"] in (True, None) else "#c33" for row in answers]
    )
    left.set_xlim(-20, 20)
    left.set_xlabel("error [%]")
    left.tick_params(axis="y", labelsize=6)
    left.invert_yaxis()
    for place, one in enumerate(drapes):
        rows, columns = one.outline.shape
        x, y = (place % 3) * columns, -(place // 3) * 1.25 * rows
        middle.imshow(~one.outline.T, extent=(x, x + columns, y, y + rows), cmap="gray")
        middle.text(
            x + columns / 2,
            y - 0.1 * rows,
            f"{one.fabric} {100 * one.coefficient:.0f} %",
            ha="center",
            size=7,
        )
    middle.autoscale()
    middle.set_axis_off()
    middle.set_title("Cusick's drape: shadows and coefficients")
    walk = result.get("walk", [])
    right.bar([f"{row['what']}: {row['setting']}" for row in walk], [row["rms_mm"] for row in walk])
    right.set_yscale("log")
    right.set_ylabel("distance from its refinement, rms [mm]")
    right.tick_params(axis="x", rotation=90, labelsize=7)
    figure.savefig(path, dpi=100)
    plt.close(figure)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        prog="known_answers", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--smoke", action="store_true")
    parser.add_argument("--out", type=Path, default=EXPERIMENTS / "results")
    parser.add_argument("--part", nargs="*", choices=PARTS, default=PARTS)
    arguments = parser.parse_args()

    from eslr_jax.evaluation.report import environment
    from eslr_jax.io.atomic import atomic_write

    arguments.out.mkdir(parents=True, exist_ok=True)
    path = arguments.out / "known_answers.json"
    result = json.loads(path.read_text()) if path.exists() else {}
    drapes: list = []
    for part in arguments.part:
        rows = []
        for row, drawn in measure(part, arguments.smoke):
            rows.append(row)
            drapes += [] if drawn is None else [drawn]
            result = {**result, part: rows, **environment()}
            with atomic_write(path) as temporary:
                temporary.write_text(json.dumps(result, indent=1) + "\n")
            told = {key: f"{value:.4g}" if isinstance(value, float) else value for key, value in row.items()}
            print(part, told, flush=True)
    draw(result, drapes, path.with_suffix(".png"))


if __name__ == "__main__":
    sys.path[0] = str(EXPERIMENTS)  # Python puts this folder there, but its modules belong to a package
    main()
