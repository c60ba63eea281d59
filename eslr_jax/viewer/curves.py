"""A field of each run over time: one number a frame, drawn as curves."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from eslr_jax.extras import require

_COLORS = ("#4d80b3", "#d9822b", "#4c9f70", "#b3485b", "#7a5fa8")  # of the runs, repeated
_HEIGHT = 180  # [pixels]


def frame_values(values: Float[np.ndarray, "frames vertices"], name: str) -> Float[np.ndarray, " frames"]:
    """Return one number a frame: the largest stretch, the smallest distance, or the mean of anything else.

    Args:
        values: A field of a run, shape [frames, vertices].
        name: Which field it is.
    """
    if name == "stretch":
        return values.max(axis=1)
    return values.min(axis=1) if name == "distance" else values.mean(axis=1)


def worst_frame(curves: Sequence[Float[np.ndarray, " frames"]], name: str) -> int:
    """Return the frame of the worst value of any run: the smallest distance, or else the largest value."""
    values = curve_table(curves)
    return int(values.min(axis=0).argmin() if name == "distance" else values.max(axis=0).argmax())


def curve_table(curves: Sequence[Float[np.ndarray, " frames"]]) -> Float[np.ndarray, "runs frames"]:
    """Return the curves of all runs in one table; a shorter run keeps its last value."""
    longest = max(len(curve) for curve in curves)
    return np.stack([np.pad(curve, (0, longest - len(curve)), mode="edge") for curve in curves])


def add_plot(gui: Any, names: Sequence[str], num_frames: int, timestep: float) -> Any:
    """Add an empty plot over time [s] with a curve a run to a page; return its handle.

    Args:
        gui: The page's `viser.GuiApi`.
        names: What each run is called.
        num_frames: Frames of the longest run.
        timestep: Time between frames [s].
    """
    uplot = require("viser.uplot", extra="view")
    series = [uplot.Series(label="s")]
    for number, name in enumerate(names):
        series.append(uplot.Series(label=name, stroke=_COLORS[number % len(_COLORS)], width=2))
    time = np.arange(num_frames) * timestep
    return gui.add_uplot(
        (time, *np.zeros((len(names), num_frames))),
        tuple(series),
        scales={"x": uplot.Scale(time=False)},
        height=_HEIGHT,
        visible=False,
    )


def show_plot(plot: Any, curves: Sequence[Float[np.ndarray, " frames"]]) -> None:
    """Draw the curves of all runs into a plot, or hide it if there are none."""
    plot.visible = bool(curves)
    if curves:
        plot.data = (plot.data[0], *curve_table(curves).astype(np.float64))
