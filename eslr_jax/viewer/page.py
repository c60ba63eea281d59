"""The page: what is in it, and how it follows its controls."""

from __future__ import annotations

import dataclasses
import io
import threading
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import trimesh

from eslr_jax.body.clothing import Piece, body_pieces, garment_pieces
from eslr_jax.errors import AssetError, EslrError
from eslr_jax.evaluation.fields import FIELDS, Field, run_field
from eslr_jax.extras import require
from eslr_jax.io.palette import byte_color
from eslr_jax.io.run import Run
from eslr_jax.render import color_scale
from eslr_jax.viewer.curves import add_plot, frame_values, show_plot, worst_frame

PLAIN = "fabric"  # colour by nothing
_SPACING = 1.3  # [m] between runs: arms held out pass each other
_LABEL_HEIGHT = 0.2  # [m] of a run's name above its head
_PICTURE_SIZE = (1280, 960)  # width, height [pixels]


class Figure(NamedTuple):
    """What is drawn of a run."""

    garments: list[Piece]
    body: list[Piece]


@dataclasses.dataclass(frozen=True)
class View:
    """A page that shows runs; its controls are the state."""

    server: Any  # viser.ViserServer
    runs: tuple[Run, ...]
    fields: dict[tuple[int, str], Field]  # of a run's number and a field's name, filled as they are asked for
    controls: dict[str, Any]
    pieces: tuple[Figure, ...]  # of every run
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
    num_frames = max(run.trajectory.num_frames for run in runs)
    gui = server.gui
    controls = {
        "frame": gui.add_slider("frame", 0, max(num_frames - 1, 1), 1, 0),
        "playing": gui.add_checkbox("play", False),
        "speed": gui.add_slider("speed", 0.1, 2.0, 0.1, 1.0),
        "color": gui.add_dropdown("colour by", (PLAIN, *FIELDS), initial_value=PLAIN),
        "legend": gui.add_markdown(""),
        "plot": add_plot(gui, [run.name for run in runs], num_frames, runs[0].trajectory.timestep),
        "worst": gui.add_button("go to the worst frame", visible=False),
        "wireframe": gui.add_checkbox("wireframe", False),
        "body": gui.add_checkbox("body", True),
        "follow": gui.add_checkbox("follow", True),
        "save": gui.add_button("save picture"),
    }
    view = View(server, tuple(runs), {}, controls, tuple(map(_figure, runs)), threading.Lock())
    _place_scene(view)
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
            _show_run(view, k, run, frame, colors)
            if fields:
                now.append(f"{frame_values(fields[k].values[frame : frame + 1], color)[0]:.3g}")
        legend = message
        if fields:
            moment = f"frame {asked}, {asked * view.runs[0].trajectory.timestep:.2f} s: {', '.join(now)}"
            legend = f"dark {low:.3g} to yellow {high:.3g} {fields[0].unit}\n\n{moment}"
        view.controls["legend"].content = legend


def go_to_worst(view: View) -> None:
    """Move the timeline to the frame with the worst value of what is coloured by."""
    name = view.controls["color"].value
    curves = _curves(view, name)
    if curves:
        view.controls["playing"].value = False
        view.controls["frame"].value = worst_frame(curves, name)


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


def _place_scene(view: View) -> None:
    """Set up the vertical, the camera and the floor."""
    scene, count = view.server.scene, len(view.runs)
    scene.set_up_direction("+y")
    middle = 0.5 * _SPACING * (count - 1)
    view.server.initial_camera.position = (middle, 1.2, 2.6 + 0.8 * count)
    view.server.initial_camera.look_at = (middle, 0.9, 0.0)
    view.server.initial_camera.up = (0.0, 1.0, 0.0)
    scene.add_grid("/floor", width=4.0 + _SPACING * count, height=4.0, plane="xz", cell_size=0.25)


def _show_run(view: View, k: int, run: Run, frame: int, colors: np.ndarray | None) -> None:
    """Show one frame of one run, with its name above it.

    Args:
        view: The page.
        k: Number of the run, counted from the left.
        run: The run.
        frame: Which frame.
        colors: sRGB per garment vertex in [0, 1], shape [vertices, 3]; None for the fabric's colour.
    """
    scene, trajectory = view.server.scene, run.trajectory
    wireframe = bool(view.controls["wireframe"].value)
    subject = trajectory.positions if trajectory.body is None else trajectory.body.positions
    walked = (subject[frame].mean(axis=0) - subject[0].mean(axis=0)) * [1.0, 0.0, 1.0]
    # Where the subjects walk, the runs walk beside each other, or on the spot if the page follows.
    offset = np.array([_SPACING * k, 0.0, 0.0]) - (walked if view.controls["follow"].value else 0.0)
    top = subject[frame].mean(axis=0) * [1.0, 0.0, 1.0] + [
        0.0,
        subject[frame][:, 1].max() + _LABEL_HEIGHT,
        0.0,
    ]
    scene.add_label(f"/runs/{k}/name", run.name, position=tuple(top + offset))
    points = (trajectory.positions[frame] + offset).astype(np.float32)
    name, figure = f"/runs/{k}/garment", view.pieces[k]
    if colors is None or wireframe:
        for number, piece in enumerate(figure.garments):
            scene.add_mesh_simple(
                name if number == 0 else f"{name}_{number}",
                piece.place(points),
                piece.faces,
                color=byte_color(piece.color),
                wireframe=wireframe,
                side="double",
            )
    else:
        for number in range(1, len(figure.garments)):
            scene.remove_by_name(f"{name}_{number}")
        mesh = trimesh.Trimesh(
            points, trajectory.faces, vertex_colors=np.round(255 * colors).astype(np.uint8), process=False
        )
        scene.add_mesh_trimesh(name, mesh)
    if trajectory.body is not None:
        for number, piece in enumerate(figure.body):
            scene.add_mesh_simple(
                f"/runs/{k}/body" if number == 0 else f"/runs/{k}/body_{piece.name}",
                piece.place(trajectory.body.positions[frame] + offset),
                piece.faces,
                color=byte_color(piece.color),
                visible=bool(view.controls["body"].value),
            )


def _figure(run: Run) -> Figure:
    """Return what is drawn of a run."""
    trajectory, body = run.trajectory, run.trajectory.body
    outfit = run.garment.outfit if run.garment is not None else {"garment": trajectory.positions.shape[1]}
    return Figure(
        garment_pieces(trajectory.faces, outfit),
        [] if body is None else body_pieces(body.rest_positions, body.faces, body.skin),
    )


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


def _curves(view: View, name: str) -> list[np.ndarray]:
    """Return what is coloured by as one number a frame for every run; nothing without a field."""
    with view.lock:
        return [frame_values(field.values, name) for field in _fields(view, name)[0]]


def _change_color(view: View) -> None:
    """Show another field, and its plot."""
    curves = _curves(view, view.controls["color"].value)
    show_plot(view.controls["plot"], curves)
    view.controls["worst"].visible = bool(curves)
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
