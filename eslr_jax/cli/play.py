"""`eslr play`: cloth that moves while it is simulated."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from eslr_jax.cli.console import app, say, use_compile_cache


@app.command
def play(
    garment: str = "tshirt",
    motion: str = "cmu_016_32",
    vertices: Literal["1k", "4k", "10k"] = "1k",
    out: Path = Path("live"),
    port: int = 8080,
    host: str = "127.0.0.1",
) -> None:
    """Simulate in the browser while you watch: change fabric and wind, pull at the cloth, record; Ctrl-C ends it.

    Args:
        garment: Name of a bundled garment (see `eslr assets`), or a mesh file, which is fitted to the body first.
        motion: Name of a bundled motion, or a motion file. It is played forth and back.
        vertices: Resolution of a bundled garment.
        out: Folder that what is recorded is written to, as a run of `eslr simulate`.
        port: Port of the page, or the next free one.
        host: Address to listen on; 0.0.0.0 shows it to the whole network.
    """
    from eslr_jax.viewer.live import Choice, open_live, run_live

    use_compile_cache()
    live = open_live(Choice(garment, vertices, motion), out=out, host=host, port=port)
    print(live.url, flush=True)
    say("the first frame compiles for a while; the page says when it moves")
    run_live(live)
