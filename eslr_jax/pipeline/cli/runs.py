"""`eslr play`, `eslr view`, `eslr render`, `eslr export`: watch cloth, and take it elsewhere."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from eslr_jax.errors import AssetError, ConfigError
from eslr_jax.pipeline.cli.console import app, open_browser, progress, say, use_compile_cache
from eslr_jax.pipeline.cli.options import DEFAULT_GARMENT, parse_seconds

if TYPE_CHECKING:
    from eslr_jax.pipeline.formats.trajectory import TrajectoryFile


@app.command(name="play")
@dataclasses.dataclass(frozen=True)
class Play:
    """Simulate in the browser while you watch: change fabric, wind and body, pull the cloth; Ctrl-C ends it."""

    # Name of a bundled garment (see `eslr assets`), or a mesh file, which is fitted to the body first. Give
    # it again for what is worn over it, as in --garment pants --garment tshirt. By default a T-shirt.
    garment: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    # Name of a bundled motion, or a motion file. It is played forth and back. By default the animation in the
    # body's file, or else cmu_016_32.
    motion: str | None = None
    # Name of a bundled body, or a SMPL model or a skinned character (glTF).
    body: str = "anny"
    # Shape of the body at first, in standard deviations; the page has sliders.
    betas: tuple[float, ...] = ()
    # Resolution of a bundled garment.
    vertices: Literal["1k", "4k", "10k"] = "1k"
    # Folder for recordings. Each is a run like those of `eslr simulate`, in a folder 1, 2, and so on.
    out: Path = Path("live")
    # Port of the page, or the next free one.
    port: int = 8080
    # Address to listen on; 0.0.0.0 shows it to the whole network.
    host: str = "127.0.0.1"
    # Open the page in the browser, if this is a terminal with a screen. Its address is printed anyway.
    open: bool = True

    def __call__(self) -> None:
        """Serve the page until Ctrl-C."""
        from eslr_jax.pipeline.assets.garments import check_resolution
        from eslr_jax.pipeline.assets.motions import own_motion
        from eslr_jax.pipeline.page.live import open_live, run_live
        from eslr_jax.pipeline.page.live_controls import Choice

        use_compile_cache()
        garments = self.garment or (DEFAULT_GARMENT,)
        check_resolution(garments, self.vertices)
        motion = self.motion or own_motion(self.body)
        choice = Choice(garments, self.vertices, motion, self.body, self.betas)
        live = open_live(choice, out=self.out, host=self.host, port=self.port)
        print(live.url, flush=True)
        if self.open:
            open_browser(live.url)
        say("the first frame compiles for a while; the page says when it moves")
        run_live(live)


@app.command(name="view")
@dataclasses.dataclass(frozen=True)
class View:
    """Show runs side by side in the browser, with a timeline, colours and plots; Ctrl-C ends it."""

    # Folders that `eslr simulate` wrote.
    runs: tyro.conf.Positional[tuple[Path, ...]]
    # Port of the page, or the next free one.
    port: int = 8080
    # Address to listen on; 0.0.0.0 shows it to the whole network.
    host: str = "127.0.0.1"

    def __call__(self) -> None:
        """Serve the page until Ctrl-C."""
        from eslr_jax.pipeline.page import open_view, play
        from eslr_jax.pipeline.report.run import read_run

        page = open_view([read_run(run) for run in self.runs], host=self.host, port=self.port)
        print(page.url, flush=True)
        play(page)


@app.command(name="render")
@dataclasses.dataclass(frozen=True)
class Render:
    """Render a run without a display: a film (mp4), a contact sheet (png), or one picture (png and --at)."""

    # Folder that `eslr simulate` wrote.
    run: tyro.conf.Positional[Path]
    # File to write; .mp4 (extra `video`) or .png.
    out: Path
    # Colour the garment by this: dark blue is little, yellow much.
    color: Literal[
        "fabric",
        "stretch",
        "stretch-energy",
        "bending-energy",
        "inertia-energy",
        "gravity-energy",
        "collision-energy",
        "friction-energy",
        "gap",
        "distance",
    ] = "fabric"
    # front, side, back, or degrees from the front towards the body's left.
    camera: str = "front"
    # Turn the camera with the body; otherwise front is the world's +Z.
    follow: bool = True
    # How many times larger than with the whole body in the picture; above 1 it looks at the garment.
    zoom: float = 1.0
    # Render one picture of this moment: a frame, such as 375, or a time, such as 12.5s.
    at: str | None = None
    # Width of one picture [pixels]; its height follows.
    width: int | None = None
    # Number of frames of a film, from the first on, or number of pictures of a contact sheet.
    frames: int | None = None
    # Camera rays per pixel.
    samples: int = 9

    def __call__(self) -> None:
        """Render, and print the file's name."""
        from eslr_jax.pipeline.formats.palette import outfit_colors
        from eslr_jax.pipeline.pictures import (
            add_color_bar,
            color_scale,
            contact_sheet,
            moment_text,
            render_frames,
            write_label,
            write_png,
            write_video,
        )
        from eslr_jax.pipeline.report.fields import run_field
        from eslr_jax.pipeline.report.run import read_run

        is_film = self.out.suffix.lower() == ".mp4"
        if not is_film and self.out.suffix.lower() != ".png":
            raise AssetError(f"--out {self.out}: give a film, .mp4, or a picture, .png")
        for name in ("frames", "width", "samples"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ConfigError(f"--{name} {value}: give 1 or more")
        if self.at is not None and (is_film or self.frames is not None):
            raise ConfigError("--at is one picture: give a .png, and no --frames")
        content = read_run(self.run)
        trajectory = content.trajectory
        colors, bar = None, None
        if self.color != "fabric":
            field = run_field(content, self.color)
            colors = color_scale(field.values, field.low, field.high)
            bar = field.low, field.high, f"{self.color} [{field.unit}]" if field.unit else self.color
        elif content.garment is not None:
            colors = outfit_colors(list(content.garment.outfit.values()))
        is_angle = self.camera.lstrip("-").replace(".", "", 1).isdigit()
        body = trajectory.body
        body_mesh = (None, None) if body is None else (body.positions, body.faces)
        meshes = *body_mesh, trajectory.positions, trajectory.faces
        look: dict[str, Any] = {
            "rest_positions": None if body is None else body.rest_positions,
            "rig": None if body is None else body.skin,
            "follows": self.follow,
            "camera": float(self.camera) if is_angle else self.camera,
            "zoom": self.zoom,
            "vertex_colors": colors,
            "samples": self.samples,
        }

        def finish(picture: Any) -> Any:
            return picture if bar is None else add_color_bar(picture, *bar)

        width = self.width or 480
        size = width, round(width * 4 / 3)
        if self.at is not None:
            frame = _frame_at(self.at, trajectory)
            (picture,) = render_frames(*meshes, frame_indices=[frame], size=size, **look)
            write_png(self.out, finish(write_label(picture, moment_text(frame, trajectory.timestep))))
        elif is_film:
            count = min(self.frames or trajectory.num_frames, trajectory.num_frames)
            pictures = render_frames(*meshes, frame_indices=range(count), size=size, **look)
            with progress("rendering", count) as advance:
                film = (finish(picture) for picture in _counted(pictures, count, advance))
                write_video(self.out, film, 1.0 / trajectory.timestep)
        else:
            count, width = self.frames or 8, self.width or 252
            look |= {"num_frames": count, "size": (width, round(width * 10 / 7))}
            with progress("rendering", count) as advance:
                sheet = contact_sheet(*meshes, timestep=trajectory.timestep, on_picture=advance, **look)
            write_png(self.out, finish(sheet))
        print(self.out)


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


def _formats(_: object) -> str:
    """Return the names of all formats that are written; only `--help` asks, since it imports them all."""
    from eslr_jax.pipeline.formats.registry import WRITERS, names_of

    return f"(one of {names_of(*WRITERS)})"


_FORMAT = tyro.conf.arg(metavar="FORMAT", help_behavior_hint=_formats)


@app.command(name="export")
@dataclasses.dataclass(frozen=True)
class Export:
    """Write a simulated run in another program's format.

    The garment has the vertex order and texture coordinates of its own file, so that a point cache lies on it.
    """

    # Folder that `eslr simulate` wrote, or the trajectory in it.
    run: tyro.conf.Positional[Path]
    # File to write; with --format obj or ply a new folder, one file a frame.
    out: Path
    # Format of the file; by default what the suffix says.
    format: Annotated[str | None, _FORMAT] = None
    # garment, body, or both; by default both to glb, usd and abc, and the garment to all others.
    content: Literal["garment", "body", "both"] | None = None

    def __call__(self) -> None:
        """Write the file, print its name, and say where in the motion it begins."""
        from eslr_jax.pipeline.cli.simulate import UNFINISHED
        from eslr_jax.pipeline.formats.export import export_trajectory
        from eslr_jax.pipeline.report.run import FILES, read_run

        out = self.out.expanduser()
        file = self.run / "trajectory.npz" if self.run.is_dir() else self.run
        own = (file, *map(file.with_name, (*FILES, UNFINISHED)))
        if out.resolve() in [path.resolve() for path in own]:
            raise AssetError(f"--out {out} is a file of the run itself, which would be lost; name another")
        run = read_run(self.run)
        options = {"garment": run.garment, "format": self.format, "content": self.content}
        print(export_trajectory(run.trajectory, out, **options))
        start = run.trajectory.metadata.get("motion_start_s")
        if isinstance(start, float) and start > 0:
            say(
                f"frame 0 of {out} is {start:.3f} s after the first frame of the animation in the motion's file"
            )
