"""`eslr fit`: make a garment file ready for a body."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from eslr_jax.cli.console import app, say, use_compile_cache, waiting
from eslr_jax.errors import AssetError, MissingExtraError
from eslr_jax.fit.options import FitOptions

if TYPE_CHECKING:
    from eslr_jax.io.garment import GarmentFile
    from eslr_jax.types import Body


@app.command
def fit(
    garment: tyro.conf.Positional[str],
    out: Path,
    body: str = "anny",
    body_units: str | None = None,
    betas: tuple[float, ...] = (),
    made_for: str | None = None,
    options: Annotated[FitOptions, tyro.conf.arg(name="")] = FitOptions(),  # noqa: B008 - frozen
    fabric: tuple[str, ...] = (),
    picture: bool = True,
    json_: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> None:
    """Fit a garment to a body once, for `eslr simulate --garment OUT`.

    Unit, axes, place and the pose of the arms are recognised if they are not given. A garment that was made for
    another body is carried from that body to this one. A picture beside OUT shows the garment before and after.

    Args:
        garment: A mesh (obj, ply, stl, glb, npz), FILE.pkl#NAME of HOOD's garments, or the name of a bundled
            garment for another body than the bundled one.
        out: The garment file to write, such as shirt.npz; the picture is then shirt_fit.png.
        body: Name of a bundled body, a body file, or a moving mesh, which rests in its first frame.
        body_units: Unit of the body's file: m, cm, mm, in or ft; recognised if not given.
        betas: Shape of a body with shapes, in standard deviations.
        made_for: The body that the mesh was modelled on, if that is another one: a name or a file.
        options: Settings that replace what is recognised from the mesh.
        fabric: Fabric as for `eslr simulate`; it is kept in the file.
        picture: Render the picture (extra `render`).
        json_: Print the report as JSON.
    """
    from eslr_jax.assets import load_garment_file, prepare_stored
    from eslr_jax.cli.actor import load_wearer
    from eslr_jax.fabric import garment_material
    from eslr_jax.fit.report import describe_cost, describe_fit, describe_transfer
    from eslr_jax.io.garment import is_garment_file, write_garment_npz

    if out.suffix != ".npz":
        raise AssetError(f"--out {out}: a fitted garment is an npz file; name it such as {out.stem}.npz")
    if Path(garment).is_file() and is_garment_file(garment):
        raise AssetError(
            f"{garment} is fitted already; give it to eslr simulate, or give eslr fit the mesh that it was "
            "fitted from"
        )
    for given in (garment, body, made_for):
        if given is not None and Path(given).is_file() and Path(given).resolve() == out.resolve():
            raise AssetError(f"--out {out} is a file that is read, which would be lost; name another")
    use_compile_cache()

    def describe_source(source) -> None:
        text = describe_cost(len(source.mesh.positions))
        if text and options.edge_length is None:  # else it is remeshed, and its size is chosen
            say(text)

    with waiting("fitting"):
        rig = load_wearer(body, units=body_units, betas=betas)
        if made_for is None:
            stored = load_garment_file(garment, body=rig, fit=options, on_source=describe_source)
        else:
            stored = _carry(garment, (rig, load_wearer(made_for)), options, describe_source)
        report = stored.metadata.get("fit") or stored.metadata.get("transfer")
        if report is None:
            raise AssetError(
                f"{garment} needs no fit: it is made for this body; give it to eslr simulate, or give eslr fit "
                "a mesh"
            )
        stored = dataclasses.replace(stored, metadata=stored.metadata | {"fabrics": list(fabric)})
        garment_material(fabric, prepare_stored(stored, name=Path(garment).name), stored)
    write_garment_npz(out, stored)
    # The name of the file alone may be that of the garment's texture.
    drawn = out.with_name(f"{out.stem}_fit.png")
    has_picture = picture and _write_before_and_after(drawn, stored, rig)
    if json_:
        print(json.dumps(report, indent=2))
        for text in report.get("warnings", ()):
            say(f"warning: {text}")
    else:
        print(describe_fit(report) if "fit" in stored.metadata else describe_transfer(report))
        print(out)
        if has_picture:
            print(drawn)


def _carry(garment: str, bodies: tuple[Body, Body], options: FitOptions, on_source: Callable) -> GarmentFile:
    """Return a mesh that was modelled on the second body, fitted to the first.

    Raises:
        AssetError: The garment is no mesh of its own.
    """
    from eslr_jax.assets import asset_names
    from eslr_jax.fit.fit import fit_garment
    from eslr_jax.io.garment import read_garment_source

    if garment in asset_names("garment") or f"{garment}_1k" in asset_names("garment"):
        raise AssetError(f"garment {garment} is made for the bundled body; leave out --made-for")
    source = read_garment_source(garment)
    on_source(source)
    return fit_garment(source, bodies[0], options, made_for=bodies[1])


def _write_before_and_after(path: Path, stored, rig) -> bool:
    """Render the garment before and after the fit, or say that the extra `render` is missing and return False."""
    import numpy as np

    from eslr_jax.render import render_frame, side_by_side, write_png

    body = np.asarray(rig.rest_positions), np.asarray(rig.faces)
    try:
        with waiting("rendering"):
            pictures = [
                render_frame(
                    *body,
                    positions,
                    stored.faces,
                    rest_positions=body[0],
                    rig=rig,
                    camera=25.0,
                    size=(420, 560),
                )
                for positions in (stored.sewn_positions, stored.rest_positions)
            ]
    except MissingExtraError as error:
        say(f"no picture: {error}")
        return False
    write_png(path, side_by_side(pictures, ("before", "after")))
    return True
