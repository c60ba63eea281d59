"""Measure what is known of cloth in closed form, and what the error of a walk consists of.

    python experiments/known_answers [--smoke] [--out DIR] [--part answers rotations peers drape order walk]

Answers: those of `cases.py`, with both integrators where time matters. Rotations: strips that bend far, and a
plane that turns. Peers: four answers by Newton's solvers (extra `peers`) and Blender's cloth (BLENDER_PYTHON, see
peers.py), where they are installed. Drape: Cusick's coefficient of the named fabrics. Order: of the integrators,
without folds. Walk: millimetres by tolerance, timestep and mesh. Writes known_answers.json, part by part, and
with matplotlib (extra `plot`) known_answers.png, known_rotations.png and known_drapes.png.
"""

import importlib
import sys
from pathlib import Path
from typing import Any

EXPERIMENTS = Path(__file__).resolve().parents[1]
PARTS = {  # each with the module and function that yields its rows
    "answers": ("cases", "answer"), "rotations": ("rotations", "turned"), "peers": ("cases", "compare"),
    "drape": ("drape", "drapes"), "order": ("refinement", "orders"), "walk": ("refinement", "refine"),
}  # fmt: skip


def draw(result: dict[str, Any], drapes: list, path: Path) -> None:
    """Draw the answers, the walk's error and what was draped just now; nothing without matplotlib."""
    try:
        import matplotlib.pyplot as plt
    except ImportError:
        return

    if drapes:
        _draw_drapes(drapes, path.with_name("known_drapes.png"))
    if rotations := result.get("rotations"):
        figure, axes = plt.subplots(figsize=(10, 9), layout="constrained")
        _draw_errors(axes, _worst(rotations), 5)
        axes.set_title("large rotations, the worst of all loads")
        figure.savefig(path.with_name("known_rotations.png"), dpi=100)
        plt.close(figure)
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


def _worst(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the row that is farthest off of every case, mesh and unit, whatever the load."""
    worst: dict[tuple[str, str], dict[str, Any]] = {}
    for row in rows:
        case = f"{row['case'].partition(',')[0]}, {row['unit']}"
        error = abs(row["found"] / row["known"] - 1)
        before = worst.setdefault((case, row["setting"]), {"off": -1.0})
        if error > before["off"]:
            before.update(row, case=case, off=error)
    return list(worst.values())


def _draw_drapes(drapes: list, path: Path) -> None:
    """Draw the shadows of drapes at their usual mesh, with their coefficients and bands."""
    import matplotlib.pyplot as plt

    from eslr_jax.fabric.drapes import BANDS

    figure, axes = plt.subplots(figsize=(12, 9), layout="constrained")
    usual = [one for one in drapes if one[0].spacing == drapes[0][0].spacing]
    for place, (row, hung) in enumerate(usual):
        shadow = hung.shadow()
        count = len(shadow)
        x, y = (place % 6) * count, -(place // 6) * 1.35 * count
        axes.imshow(~shadow.T, extent=(x, x + count, y, y + count), cmap="gray")
        band = f" ({BANDS[row.fabric].low:g} to {BANDS[row.fabric].high:g})" if row.fabric in BANDS else ""
        label = f"{row.fabric}\n{100 * row.median:.0f} %{band}"
        axes.text(x + count / 2, y - 0.02 * count, label, ha="center", va="top", size=9)
    axes.autoscale()
    axes.set_axis_off()
    axes.set_title("Cusick's drape: shadows of one start, coefficients in the median, bands of their kind")
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
    parser.add_argument("--part", nargs="*", choices=list(PARTS), default=list(PARTS))
    arguments = parser.parse_args()

    from eslr_jax.pipeline.report.report import environment

    path = arguments.out / "known_answers.json"
    result = harness.kept(path)
    drapes: list = []
    for part in arguments.part:
        rows = []
        module, name = PARTS[part]
        for found in getattr(importlib.import_module(f"known_answers.{module}"), name)(arguments.smoke):
            if part == "drape":
                drapes.append(found)
            answer = found[0] if part == "drape" else found
            row = getattr(answer, "as_dict", answer._asdict)()
            rows.append(row)
            result = {**result, part: rows, **environment()}
            harness.keep(path, result)
            told = {key: f"{value:.4g}" if isinstance(value, float) else value for key, value in row.items()}
            print(part, told, flush=True)
    draw(result, drapes, path.with_suffix(".png"))
    missed = [row for part in arguments.part for row in result.get(part, []) if row.get("is_within") is False]
    if arguments.smoke and missed:
        sys.exit("outside their bar: " + "; ".join(f"{row['case']}, {row['setting']}" for row in missed))


if __name__ == "__main__":
    sys.path[0] = str(EXPERIMENTS)  # Python puts this folder there, but its modules belong to a package
    main()
