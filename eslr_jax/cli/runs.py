"""`eslr view`, `eslr render`, `eslr export`: look at a run, and take it elsewhere."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from eslr_jax.cli.console import app, progress, stderr
from eslr_jax.errors import AssetError


@app.command
def view(
    runs: tyro.conf.Positional[tuple[Path, ...]],
    port: int = 8080,
    host: str = "127.0.0.1",
) -> None:
    """Show runs side by side in the browser: timeline, colours, wireframe, export of a picture; Ctrl-C ends it.

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
    width: int | None = None,
    frames: int | None = None,
    samples: int = 16,
) -> None:
    """Render a run without a display: a film (mp4) or a contact sheet (png).

    Args:
        run: Folder that `eslr simulate` wrote.
        out: File to write; .mp4 (extra `video`) or .png.
        color: Colour the garment by this: dark blue is little, yellow much.
        camera: front, side, back, or degrees from the front towards the side.
        width: Width of one picture [pixels]; three quarters of its height.
        frames: Only the first so many frames of a film, or so many pictures of a sheet.
        samples: Camera rays per pixel.
    """
    from eslr_jax.evaluation.fields import run_field
    from eslr_jax.io.run import read_run
    from eslr_jax.render import color_scale, contact_sheet, render_frames, write_png, write_video

    if out.suffix.lower() not in (".mp4", ".png"):
        raise AssetError(f"--out {out}: give a film, .mp4, or a picture, .png")
    content = read_run(run)
    trajectory = content.trajectory
    colors = None
    if color != "fabric":
        field = run_field(content, color)
        colors = color_scale(field.values, field.low, field.high)
        stderr.print(
            f"{color}: dark {field.low:.3g} to yellow {field.high:.3g} {field.unit}", highlight=False
        )
    angle: str | float = float(camera) if camera.lstrip("-").replace(".", "", 1).isdigit() else camera
    body = trajectory.body
    body_mesh = (None, None) if body is None else (body.positions, body.faces)
    meshes = *body_mesh, trajectory.positions, trajectory.faces
    if out.suffix.lower() == ".png":
        size = (width or 280, round((width or 280) * 10 / 7))
        count = frames or 8
        with progress("rendering", count) as advance:
            sheet = contact_sheet(
                *meshes, num_frames=count, camera=angle, size=size, vertex_colors=colors, samples=samples,
                on_picture=advance,
            )  # fmt: skip
        write_png(out, sheet)
    else:
        size = (width or 480, round((width or 480) * 4 / 3))
        count = min(frames or trajectory.num_frames, trajectory.num_frames)
        pictures = render_frames(
            *meshes,
            frame_indices=range(count),
            camera=angle,
            size=size,
            vertex_colors=colors,
            samples=samples,
        )
        with progress("rendering", count) as advance:
            write_video(out, _counted(pictures, count, advance), 1.0 / trajectory.timestep)
    print(out)


def _counted(items, total: int, advance) -> Iterator[Any]:
    """Yield items and show how many there were."""
    for done, item in enumerate(items, 1):
        yield item
        advance(done, total)


@app.command
def export(
    run: tyro.conf.Positional[Path],
    out: Path,
    format_: Annotated[
        Literal["glb", "usd", "usda", "usdc", "obj", "ply", "pc2", "mdd", "npz"] | None,
        tyro.conf.arg(name="format"),
    ] = None,
    content: Literal["garment", "body", "both"] | None = None,
) -> None:
    """Write a simulated run in another program's format.

    The garment has the vertex order and texture coordinates of its own file, so that a point cache lies on it.

    Args:
        run: Folder that `eslr simulate` wrote, or the trajectory in it.
        out: File to write; with --format obj or ply a new folder, one file a frame.
        format_: glb, usd, usda, usdc, obj, ply, pc2, mdd or npz; by default what the suffix says.
        content: garment, body, or both; by default both to glb and usd, and the garment to all others.
    """
    from eslr_jax.io.export import export_trajectory
    from eslr_jax.io.garment import read_garment_npz
    from eslr_jax.io.trajectory import read_trajectory

    file = run / "trajectory.npz" if run.is_dir() else run
    trajectory = read_trajectory(file)
    beside = file.with_name("garment.npz")
    garment = read_garment_npz(beside) if beside.is_file() else None
    print(export_trajectory(trajectory, out, garment=garment, format=format_, content=content))
