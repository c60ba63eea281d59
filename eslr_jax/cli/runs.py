"""`eslr view`, `eslr render`, `eslr export`: look at a run, and take it elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from eslr_jax.cli.console import app, progress, say
from eslr_jax.cli.moment import parse_seconds
from eslr_jax.errors import AssetError, ConfigError

if TYPE_CHECKING:
    from eslr_jax.io.trajectory import TrajectoryFile


@app.command
def view(
    runs: tyro.conf.Positional[tuple[Path, ...]],
    port: int = 8080,
    host: str = "127.0.0.1",
) -> None:
    """Show runs side by side in the browser, with a timeline, colours and plots; Ctrl-C ends it.

    Args:
        runs: Folders that `eslr simulate` wrote.
        port: Port of the page, or the next free one.
        host: Address to listen on; 0.0.0.0 shows it to the whole network.
    """
    from eslr_jax.io.run import read_run
    from eslr_jax.viewer import open_view, play

    page = open_view([read_run(run) for run in runs], host=host, port=port)
    print(page.url, flush=True)
    play(page)


@app.command
def render(
    run: tyro.conf.Positional[Path],
    out: Path,
    color: Literal[
        "fabric",
        "stretch",
        "stretch-energy",
        "bending-energy",
        "inertia-energy",
        "gravity-energy",
        "collision-energy",
        "friction-energy",
        "repulsion-energy",
        "gap",
        "distance",
    ] = "fabric",
    camera: str = "front",
    follow: bool = True,
    zoom: float = 1.0,
    at: str | None = None,
    width: int | None = None,
    frames: int | None = None,
    samples: int = 9,
) -> None:
    """Render a run without a display: a film (mp4), a contact sheet (png), or one picture (png and --at).

    Args:
        run: Folder that `eslr simulate` wrote.
        out: File to write; .mp4 (extra `video`) or .png.
        color: Colour the garment by this: dark blue is little, yellow much.
        camera: front, side, back, or degrees from the front towards the body's left.
        follow: Turn the camera with the body; otherwise front is the world's +Z.
        zoom: How many times larger than with the whole body in the picture; above 1 it looks at the garment.
        at: Render one picture of this moment: a frame, such as 375, or a time, such as 12.5s.
        width: Width of one picture [pixels]; its height follows.
        frames: Number of frames of a film, from the first on, or number of pictures of a contact sheet.
        samples: Camera rays per pixel.
    """
    from eslr_jax.evaluation.fields import run_field
    from eslr_jax.io.palette import outfit_colors
    from eslr_jax.io.run import read_run
    from eslr_jax.render import (
        add_color_bar,
        color_scale,
        contact_sheet,
        moment_text,
        render_frames,
        write_label,
        write_png,
        write_video,
    )

    is_film = out.suffix.lower() == ".mp4"
    if not is_film and out.suffix.lower() != ".png":
        raise AssetError(f"--out {out}: give a film, .mp4, or a picture, .png")
    for option, value in (("--frames", frames), ("--width", width), ("--samples", samples)):
        if value is not None and value < 1:
            raise ConfigError(f"{option} {value}: give 1 or more")
    if at is not None and (is_film or frames is not None):
        raise ConfigError("--at is one picture: give a .png, and no --frames")
    content = read_run(run)
    trajectory = content.trajectory
    chosen = None if at is None else _frame_at(at, trajectory)
    worn = content.garment
    colors, bar = None if worn is None else outfit_colors(list(worn.outfit.values())), None
    if color != "fabric":
        field = run_field(content, color)
        colors = color_scale(field.values, field.low, field.high)
        bar = (field.low, field.high, f"{color} [{field.unit}]" if field.unit else color)
    angle: str | float = float(camera) if camera.lstrip("-").replace(".", "", 1).isdigit() else camera
    body = trajectory.body
    body_mesh = (None, None) if body is None else (body.positions, body.faces)
    meshes = *body_mesh, trajectory.positions, trajectory.faces
    look: dict[str, Any] = {
        "rest_positions": None if body is None else body.rest_positions,
        "rig": None if body is None else body.skin,
        "follows": follow,
        "camera": angle,
        "zoom": zoom,
        "vertex_colors": colors,
        "samples": samples,
    }

    def finish(picture: Any) -> Any:
        return picture if bar is None else add_color_bar(picture, *bar)

    if not is_film and chosen is None:
        count, size = frames or 8, (width or 252, round((width or 252) * 10 / 7))
        with progress("rendering", count) as advance:
            sheet = contact_sheet(
                *meshes,
                num_frames=count,
                size=size,
                timestep=trajectory.timestep,
                on_picture=advance,
                **look,
            )
        write_png(out, finish(sheet))
    else:
        size = (width or 480, round((width or 480) * 4 / 3))
        count = min(frames or trajectory.num_frames, trajectory.num_frames)
        indices = range(count) if chosen is None else [chosen]
        pictures = render_frames(*meshes, frame_indices=indices, size=size, **look)
        if chosen is not None:
            label = moment_text(chosen, trajectory.timestep)
            write_png(out, finish(write_label(next(pictures), label)))
        else:
            with progress("rendering", count) as advance:
                film = (finish(picture) for picture in _counted(pictures, count, advance))
                write_video(out, film, 1.0 / trajectory.timestep)
    print(out)


def _frame_at(moment: str, trajectory: TrajectoryFile) -> int:
    """Return the frame of a moment of a run."""
    frame = round(parse_seconds(moment, 1.0 / trajectory.timestep, option="--at") / trajectory.timestep)
    if frame >= trajectory.num_frames:
        last = trajectory.num_frames - 1
        raise ConfigError(f"--at {moment}: the run ends at frame {last}, {last * trajectory.timestep:.2f} s")
    return frame


def _counted(items: Iterator[Any], total: int, advance: Callable[[int, int], Any]) -> Iterator[Any]:
    """Yield items, and report how many of the total are done."""
    for done, item in enumerate(items, 1):
        yield item
        advance(done, total)


def _formats() -> str:
    """Return the names of all formats that are written; only `--help` asks, since it imports them all."""
    from eslr_jax.io.registry import WRITERS, names_of

    return names_of(*WRITERS)


@app.command
def export(
    run: tyro.conf.Positional[Path],
    out: Path,
    format_: Annotated[
        str | None,
        tyro.conf.arg(name="format", metavar="FORMAT", help_behavior_hint=lambda _: f"(one of {_formats()})"),
    ] = None,
    content: Literal["garment", "body", "both"] | None = None,
) -> None:
    """Write a simulated run in another program's format.

    The garment has the vertex order and texture coordinates of its own file, so that a point cache lies on it.

    Args:
        run: Folder that `eslr simulate` wrote, or the trajectory in it.
        out: File to write; with --format obj or ply a new folder, one file a frame.
        format_: Format of the file; by default what the suffix says.
        content: garment, body, or both; by default both to glb and usd, and the garment to all others.
    """
    from eslr_jax.io.export import export_trajectory
    from eslr_jax.io.garment import read_garment_npz
    from eslr_jax.io.trajectory import read_trajectory
    from eslr_jax.io.unfinished import NAME

    out = out.expanduser()
    file = run / "trajectory.npz" if run.is_dir() else run
    own = (file, *map(file.with_name, ("garment.npz", "report.json", NAME)))
    if out.resolve() in [path.resolve() for path in own]:
        raise AssetError(f"--out {out} is a file of the run itself, which would be lost; name another")
    trajectory = read_trajectory(file)
    beside = file.with_name("garment.npz")
    garment = read_garment_npz(beside) if beside.is_file() else None
    print(export_trajectory(trajectory, out, garment=garment, format=format_, content=content))
    start = trajectory.metadata.get("motion_start_s")
    if isinstance(start, float) and start > 0:
        say(f"frame 0 of {out} is {start:.3f} s after the first frame of the animation in the motion's file")
