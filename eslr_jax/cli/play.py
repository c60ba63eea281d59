"""`eslr play`: cloth that moves while it is simulated."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro

from eslr_jax.cli.console import app, open_browser, say, use_compile_cache
from eslr_jax.cli.options import DEFAULT_GARMENT


@app.command
def play(
    garment: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    motion: str | None = None,
    body: str = "anny",
    betas: tuple[float, ...] = (),
    vertices: Literal["1k", "4k", "10k"] = "1k",
    out: Path = Path("live"),
    port: int = 8080,
    host: str = "127.0.0.1",
    opens: Annotated[bool, tyro.conf.arg(name="open")] = True,
) -> None:
    """Simulate in the browser while you watch: change fabric, wind and body, pull at the cloth; Ctrl-C ends it.

    Args:
        garment: Name of a bundled garment (see `eslr assets`), or a mesh file, which is fitted to the body first.
            Give it again for what is worn over it, as in --garment pants --garment tshirt. By default a
            T-shirt.
        motion: Name of a bundled motion, or a motion file. It is played forth and back. By default the animation
            in the body's file, or else cmu_016_32.
        body: Name of a bundled body, or a SMPL model or a skinned character (glTF).
        betas: Shape of the body at first, in standard deviations; the page has sliders.
        vertices: Resolution of a bundled garment.
        out: Folder for recordings. Each is a run like those of `eslr simulate`, in a folder 1, 2, and so on.
        port: Port of the page, or the next free one.
        host: Address to listen on; 0.0.0.0 shows it to the whole network.
        opens: Open the page in the browser, if this is a terminal with a screen. Its address is printed anyway.
    """
    from eslr_jax.assets.garments import check_resolution
    from eslr_jax.assets.motions import own_motion
    from eslr_jax.viewer.live import open_live, run_live
    from eslr_jax.viewer.live_controls import Choice

    use_compile_cache()
    check_resolution(garment or (DEFAULT_GARMENT,), vertices)
    choice = Choice(garment or (DEFAULT_GARMENT,), vertices, motion or own_motion(body), body, betas)
    live = open_live(choice, out=out, host=host, port=port)
    print(live.url, flush=True)
    if opens:
        open_browser(live.url)
    say("the first frame compiles for a while; the page says when it moves")
    run_live(live)
