"""Measure what is known of cloth in closed form, and what the error of a walk consists of.

    python experiments/known_answers [--smoke] [--out DIR] [--part answers peers drape walk]

Answers: free fall, terminal velocity, energy of a swing, a hanging strip, rigidity of a cantilever and of a
cylinder, a twisted sheet, a buckled one, a slope, a ball; with both integrators where time matters. Peers: four
of these by Newton's solvers (extra `peers`) and Blender's cloth (BLENDER_PYTHON, see peers.py), where they are
installed. Drape: Cusick's coefficient of woven fabrics. Walk: millimetres by tolerance, timestep and mesh.
Writes known_answers.json, part by part, and with matplotlib (extra `plot`) known_answers.png and
known_drapes.png.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

EXPERIMENTS = Path(__file__).resolve().parents[1]
PARTS = ("answers", "peers", "drape", "walk")
_DRAPED = ("satin-woven", "jersey-woven", "suiting-woven", "denim-woven", "brocade-woven", "crepe-woven")


def measure(part: str, is_smoke: bool) -> Iterator[tuple[dict[str, Any], Any]]:
    """Yield a part's rows, each with its drape for the picture or None."""
    if part == "answers":
        from known_answers.cases import answer

        yield from ((one.as_dict(), None) for one in answer(is_smoke))
    elif part == "peers":
        from known_answers.peers import compare

        yield from ((one.as_dict(), None) for one in compare(is_smoke))
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
    """Draw the answers, the walk's error and what was draped just now; nothing without matplotlib."""
    try:
        import matplotlib.pyplot as plt
    except ImportError:
        return

    if drapes:
        _draw_drapes(drapes, path.with_name("known_drapes.png"))
    figure, (left, others, right) = plt.subplots(1, 3, figsize=(18, 10), layout="constrained")
    for axes, part, limit, title in ((left, "answers", 5, "ours"), (others, "peers", 60, "other simulators")):
        _draw_errors(axes, result.get(part, []), limit)
        axes.set_title(title)
    walk = result.get("walk", [])
    right.barh([f"{row['what']}: {row['setting']}" for row in walk], [row["rms_mm"] for row in walk])
    right.set_title("a walk: what its error comes from")
    right.set_xlabel("distance from its refinement, rms [mm]")
    right.tick_params(axis="y", labelsize=10)
    right.invert_yaxis()
    figure.savefig(path, dpi=100)
    plt.close(figure)


def _draw_drapes(drapes: list, path: Path) -> None:
    """Draw the shadows of drapes with their coefficients."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6, 5), layout="constrained")
    for place, one in enumerate(drapes):
        rows, columns = one.outline.shape
        x, y = (place % 3) * columns, -(place // 3) * 1.25 * rows
        axes.imshow(~one.outline.T, extent=(x, x + columns, y, y + rows), cmap="gray")
        label = f"{one.fabric} {100 * one.coefficient:.0f} %"
        axes.text(x + columns / 2, y - 0.1 * rows, label, ha="center", size=9)
    axes.autoscale()
    axes.set_axis_off()
    axes.set_title("Cusick's drape: shadows and coefficients")
    figure.savefig(path, dpi=100)
    plt.close(figure)


def _draw_errors(axes: Any, rows: list[dict[str, Any]], limit: float) -> None:
    """Draw errors as bars, up to a limit [%]; then as numbers. Red misses its bar, grey has none."""
    errors = [100 * (row["found"] / row["known"] - 1) for row in rows]
    labels = [f"{row['case']}, {row['setting']}" for row in rows]
    colors = [{True: "#3b7", False: "#c33", None: "#999"}[row["is_within"]] for row in rows]
    axes.barh(labels, errors, color=colors)
    for place, error in enumerate(errors):
        if abs(error) > limit:
            side = 1 if error > 0 else -1
            aligned = {"ha": "right" if side > 0 else "left", "va": "center", "size": 9}
            axes.text(0.97 * side * limit, place, f"{error:.0f} %", **aligned)
    axes.set_xlim(-limit, limit)
    axes.set_xlabel("error [%]")
    axes.tick_params(axis="y", labelsize=9)
    axes.invert_yaxis()


def main() -> None:
    import harness

    parser = harness.parser(__doc__, "the smallest of every part")
    parser.add_argument("--part", nargs="*", choices=PARTS, default=PARTS)
    arguments = parser.parse_args()

    from eslr_jax.pipeline.report.report import environment

    path = arguments.out / "known_answers.json"
    result = harness.kept(path)
    drapes: list = []
    for part in arguments.part:
        rows = []
        for row, drawn in measure(part, arguments.smoke):
            rows.append(row)
            drapes += [] if drawn is None else [drawn]
            result = {**result, part: rows, **environment()}
            harness.keep(path, result)
            told = {key: f"{value:.4g}" if isinstance(value, float) else value for key, value in row.items()}
            print(part, told, flush=True)
    draw(result, drapes, path.with_suffix(".png"))


if __name__ == "__main__":
    sys.path[0] = str(EXPERIMENTS)  # Python puts this folder there, but its modules belong to a package
    main()
