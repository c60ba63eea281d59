"""`eslr convert`: networks of other projects."""

from __future__ import annotations

from pathlib import Path

import tyro

from eslr_jax.cli.console import app
from eslr_jax.errors import AssetError


@app.command
def convert(checkpoint: tyro.conf.Positional[Path], out: Path) -> None:
    """Convert a checkpoint of HOOD, for `eslr simulate --model FILE`; PyTorch is not needed.

    Args:
        checkpoint: File that HOOD's training wrote: postcvpr, cvpr, fine15 or fine48.
        out: File to write, .npz; its description gets the same name with .json.
    """
    from eslr_jax.io.hood import read_hood
    from eslr_jax.io.weights import write_weights
    from eslr_jax.models.registry import check_params, count_parameters

    if out.suffix != ".npz":
        raise AssetError(f"--out {out}: a network is written as an npz file; name it such as {out.stem}.npz")
    params, config = read_hood(checkpoint)
    check_params(config, params)
    write_weights(out, params, config, {"converted_from": checkpoint.name})
    print(f"{out}: {count_parameters(params):,} parameters")
