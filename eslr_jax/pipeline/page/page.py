"""The page: what is in it, and how it follows its controls."""

from __future__ import annotations

import dataclasses
import io
import itertools
import threading
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float

from eslr_jax.errors import AssetError, EslrError
from eslr_jax.pipeline.extras import require
from eslr_jax.pipeline.formats.palette import byte_color
from eslr_jax.pipeline.pictures import color_scale
from eslr_jax.pipeline.report.fields import FIELDS, Field, run_field
from eslr_jax.pipeline.report.run import Run
from eslr_jax.pipeline.rigs.clothing import Piece, body_pieces, garment_pieces

PLAIN = "fabric"  # colour by nothing
_SPACING = 1.3  # [m] between runs: arms held out pass each other
_LABEL_HEIGHT = 0.2  # [m] of a run's name above its head
_PICTURE_SIZE = (1280, 960)  # width, height [pixels]
_CURVE_COLORS = ("#4d80b3", "#d9822b", "#4c9f70", "#b3485b", "#7a5fa8")  # of the runs, repeated
_PLOT_HEIGHT = 180  # [pixels]


@dataclasses.dataclass(frozen=True)
class View:
    """A page that shows runs; its controls are the state."""

    server: Any  # viser.ViserServer
    runs: tuple[Run, ...]
    fields: dict[tuple[int, str], Field]  # of a run's number and a field's name, filled as they are asked for
    controls: dict[str, Any]
    garments: tuple[list[Piece], ...]  # what is drawn of every run
    bodies: tuple[list[Piece], ...]
    lock: threading.Lock

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://localhost:{self.server.get_port()}"


def open_view(runs: Sequence[Run], *, host: str = "127.0.0.1", port: int = 8080) -> View:
    """Serve a page with runs side by side.

    It has a timeline, colours, a plot of what is coloured by over time, a wireframe, a camera that follows,
    and a button that saves a picture.

    Args:
        runs: Runs of `read_run`, shown from left to right.
        host: Address to listen on; only this machine by default.
        port: Port, or the next free one.

    Returns:
        The view; `play` moves its timeline.

    Raises:
        AssetError: There is no run.
        MissingExtraError: The extra `view` is not installed.
    """
    if not runs:
        raise AssetError("nothing to view; give one run or more")
    viser = require("viser", extra="view")
    server = viser.ViserServer(host=host, port=port, verbose=False)
    count, num_frames = len(runs), max(run.trajectory.num_frames for run in runs)
    middle = 0.5 * _SPACING * (count - 1)
    server.scene.set_up_direction("+y")
    server.scene.add_grid("/floor", width=4.0 + _SPACING * count, height=4.0, plane="xz", cell_size=0.25)
    server.initial_camera.position = (middle, 1.2, 2.6 + 0.8 * count)
    server.initial_camera.look_at = (middle, 0.9, 0.0)
    server.initial_camera.up = (0.0, 1.0, 0.0)
    gui = server.gui
    uplot = require("viser.uplot", extra="view")
    series = [uplot.Series(label="s")]
    for run, color in zip(runs, itertools.cycle(_CURVE_COLORS), strict=False):
        series.append(uplot.Series(label=run.name, stroke=color, width=2))
    time = np.arange(num_frames) * runs[0].trajectory.timestep
    controls = {
        "frame": gui.add_slider("frame", 0, max(num_frames - 1, 1), 1, 0),
        "playing": gui.add_checkbox("play", False),
        "speed": gui.add_slider("speed", 0.1, 2.0, 0.1, 1.0),
        "color": gui.add_dropdown("colour by", (PLAIN, *FIELDS), initial_value=PLAIN),
        "legend": gui.add_markdown(""),
        "plot": gui.add_uplot(
            (time, *np.zeros((len(runs), num_frames))),
            tuple(series),
            scales={"x": uplot.Scale(time=False)},
            height=_PLOT_HEIGHT,
            visible=False,
        ),
        "worst": gui.add_button("go to the worst frame", visible=False),
        "wireframe": gui.add_checkbox("wireframe", False),
        "body": gui.add_checkbox("body", True),
        "follow": gui.add_checkbox("follow", True),
        "save": gui.add_button("save picture"),
    }
    garments, bodies = [], []
    for run in runs:
        trajectory, body = run.trajectory, run.trajectory.body
        outfit = {"garment": trajectory.positions.shape[1]} if run.garment is None else run.garment.outfit
        garments.append(garment_pieces(trajectory.faces, outfit))
        bodies.append([] if body is None else body_pieces(body.rest_positions, body.faces, body.skin))
    view = View(server, tuple(runs), {}, controls, tuple(garments), tuple(bodies), threading.Lock())
    for name in ("frame", "wireframe", "body", "follow"):
        controls[name].on_update(lambda _: show(view))
    controls["color"].on_update(lambda _: _change_color(view))
    controls["worst"].on_click(lambda _: go_to_worst(view))
    controls["save"].on_click(lambda event: _save_picture(event.client))
    show(view)
    return view


def show(view: View) -> None:
    """Bring the scene in line with the controls."""
    color = view.controls["color"].value
    with view.lock:
        fields, message = _fields(view, color)
    with view.lock, view.server.atomic():
        low = min((field.low for field in fields), default=0.0)
        high = max((field.high for field in fields), default=1.0)
        asked = int(view.controls["frame"].value)
        now = []
        for k, run in enumerate(view.runs):
            frame = min(asked, run.trajectory.num_frames - 1)
            colors = color_scale(fields[k].values[frame], low, high) if fields else None
            _show_run(view, k, frame, colors)
            if fields:
                now.append(f"{_frame_values(fields[k].values[frame : frame + 1], color)[0]:.3g}")
        legend = message
        if fields:
            moment = f"frame {asked}, {asked * view.runs[0].trajectory.timestep:.2f} s: {', '.join(now)}"
            legend = f"dark {low:.3g} to yellow {high:.3g} {fields[0].unit}\n\n{moment}"
        view.controls["legend"].content = legend


def go_to_worst(view: View) -> None:
    """Move the timeline to the frame with the worst value of what is coloured by."""
    name = view.controls["color"].value
    curves = _curves(view, name)
    if curves is not None:
        view.controls["playing"].value = False
        is_least = name == "distance"
        worst = curves.min(axis=0).argmin() if is_least else curves.max(axis=0).argmax()
        view.controls["frame"].value = int(worst)


def play(view: View, *, until: threading.Event | None = None) -> None:
    """Advance the timeline at the runs' own rate while "play" is ticked; return when `until` is set."""
    until = until or threading.Event()
    slider = view.controls["frame"]
    while not until.is_set():
        began = time.perf_counter()
        if view.controls["playing"].value:
            slider.value = (int(slider.value) + 1) % (int(slider.max) + 1)  # shows the frame by its callback
        pause = view.runs[0].trajectory.timestep / float(view.controls["speed"].value)
        until.wait(max(pause - (time.perf_counter() - began), 0.005))


def _show_run(view: View, k: int, frame: int, colors: np.ndarray | None) -> None:
    """Show a frame of the run that is the k-th from the left, with its name above it.

    `colors` are sRGB per garment vertex in [0, 1], shape [vertices, 3]; None shows the fabric's colour.
    """
    scene, run, trajectory = view.server.scene, view.runs[k], view.runs[k].trajectory
    wireframe = bool(view.controls["wireframe"].value)
    subject = trajectory.positions if trajectory.body is None else trajectory.body.positions
    center = subject[frame].mean(axis=0) * [1.0, 0.0, 1.0]
    walked = center - subject[0].mean(axis=0) * [1.0, 0.0, 1.0]
    # Where the subjects walk, the runs walk beside each other, or on the spot if the page follows.
    offset = np.array([_SPACING * k, 0.0, 0.0]) - (walked if view.controls["follow"].value else 0.0)
    top = offset + center
    top[1] += subject[frame][:, 1].max() + _LABEL_HEIGHT
    scene.add_label(f"/runs/{k}/name", run.name, position=tuple(top))
    points = (trajectory.positions[frame] + offset).astype(np.float32)
    name, garments = f"/runs/{k}/garment", view.garments[k]

    def draw(name: str, piece: Piece, whole: np.ndarray, **options: Any) -> None:
        color = byte_color(piece.color)
        scene.add_mesh_simple(name, piece.place(whole), piece.faces, color=color, **options)

    if colors is None or wireframe:
        for number, piece in enumerate(garments):
            own = name if number == 0 else f"{name}_{number}"
            draw(own, piece, points, wireframe=wireframe, side="double")
    else:
        for number in range(1, len(garments)):
            scene.remove_by_name(f"{name}_{number}")
        mesh = trimesh.Trimesh(
            points, trajectory.faces, vertex_colors=np.round(255 * colors).astype(np.uint8), process=False
        )
        scene.add_mesh_trimesh(name, mesh)
    if trajectory.body is not None:
        for number, piece in enumerate(view.bodies[k]):
            name = f"/runs/{k}/body" if number == 0 else f"/runs/{k}/body_{piece.name}"
            is_shown = bool(view.controls["body"].value)
            draw(name, piece, trajectory.body.positions[frame] + offset, visible=is_shown)


def _fields(view: View, name: str) -> tuple[list[Field], str]:
    """Return a field of every run, computed once; or none, and why."""
    if name == PLAIN:
        return [], ""
    try:
        for k, run in enumerate(view.runs):
            if (k, name) not in view.fields:
                view.controls["legend"].content = f"computing {name} of {run.name}"
                view.fields[k, name] = run_field(run, name)
    except EslrError as error:
        return [], str(error)
    return [view.fields[k, name] for k in range(len(view.runs))], ""


def _frame_values(values: Float[np.ndarray, "frames vertices"], name: str) -> Float[np.ndarray, " frames"]:
    """Return one number a frame: the largest stretch, the smallest distance, or the mean of anything else."""
    if name == "stretch":
        return values.max(axis=1)
    return values.min(axis=1) if name == "distance" else values.mean(axis=1)


def _curves(view: View, name: str) -> Float[np.ndarray, "runs frames"] | None:
    """Return a field as one number a frame, None without it; a run that is shorter keeps its last value."""
    with view.lock:
        curves = [_frame_values(field.values, name) for field in _fields(view, name)[0]]
    if not curves:
        return None
    longest = max(map(len, curves))
    return np.stack([np.pad(curve, (0, longest - len(curve)), "edge") for curve in curves])


def _change_color(view: View) -> None:
    curves, plot = _curves(view, view.controls["color"].value), view.controls["plot"]
    plot.visible = view.controls["worst"].visible = curves is not None
    if curves is not None:
        plot.data = (plot.data[0], *curves.astype(np.float64))
    show(view)


def _save_picture(client: Any) -> None:
    """Render what a client sees and hand it over as a download."""
    if client is None:
        return
    width, height = _PICTURE_SIZE
    picture = client.get_render(height=height, width=width, transport_format="png")
    stream = io.BytesIO()
    require("PIL.Image", extra="view").fromarray(picture).save(stream, format="PNG")
    client.send_file_download("garment.png", stream.getvalue(), save_immediately=True)  # else a link
