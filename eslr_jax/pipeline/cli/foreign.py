"""`eslr fit`, `eslr sew`, `eslr joints`, `eslr convert`: what comes from other programs."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.console import Console
from rich.table import Table

from eslr_jax.errors import AssetError, MissingExtraError
from eslr_jax.pipeline.cli.console import app, say, stderr, use_compile_cache, waiting
from eslr_jax.pipeline.cli.method import load_wearer
from eslr_jax.pipeline.cli.options import check_npz
from eslr_jax.pipeline.dressing.options import FitOptions

if TYPE_CHECKING:
    import numpy as np

    from eslr_jax.pipeline.formats.garment import GarmentFile
    from eslr_jax.types import Body


@app.command(name="fit")
@dataclasses.dataclass(frozen=True)
class Fit:
    """Fit a garment to a body once, for `eslr simulate --garment OUT`.

    Unit, axes, place and the pose of the arms are recognised if they are not given. A garment that was made for
    another body is carried from that body to this one. A picture beside OUT shows the garment before and after.
    """

    # A mesh (obj, ply, stl, glb, npz), FILE.pkl#NAME of HOOD's garments, or the name of a bundled garment for
    # another body than the bundled one.
    garment: tyro.conf.Positional[str]
    # The garment file to write, such as shirt.npz; the picture is then shirt_fit.png.
    out: Path
    # Name of a bundled body, a body file, or a moving mesh, which rests in its first frame.
    body: str = "anny"
    # Unit of the body's file: m, cm, mm, in or ft; recognised if not given.
    body_units: str | None = None
    # Shape of a body with shapes, in standard deviations.
    betas: tuple[float, ...] = ()
    # The body that the mesh was modelled on, if that is another one: a name or a file.
    made_for: str | None = None
    # Settings that replace what is recognised from the mesh.
    options: Annotated[FitOptions, tyro.conf.arg(name="")] = dataclasses.field(default_factory=FitOptions)
    # Fabric as for `eslr simulate`; it is kept in the file.
    fabric: tuple[str, ...] = ()
    # Render the picture (extra `render`).
    picture: bool = True
    # Print the report as JSON.
    json: bool = False

    def __call__(self) -> None:
        """Fit, write the file and the picture, and say what was done."""
        from eslr_jax.pipeline.dressing.report import describe_fit, describe_transfer
        from eslr_jax.pipeline.formats.garment import is_garment_file, write_garment_npz

        garment, out = self.garment, self.out
        check_npz(out, "a fitted garment")
        if Path(garment).is_file() and is_garment_file(garment):
            raise AssetError(
                f"{garment} is fitted already; give it to eslr simulate, or give eslr fit the mesh that it was "
                "fitted from"
            )
        for given in (garment, self.body, self.made_for):
            if given is not None and Path(given).is_file() and Path(given).resolve() == out.resolve():
                raise AssetError(f"--out {out} is a file that is read, which would be lost; name another")
        use_compile_cache()
        with waiting("fitting"):
            rig = load_wearer(self.body, units=self.body_units, betas=self.betas)
            stored = self._fitted(rig)
            report = stored.metadata.get("fit") or stored.metadata.get("transfer")
            if report is None:
                raise AssetError(
                    f"{self.garment} needs no fit: it is made for this body; give it to eslr simulate, or give "
                    "eslr fit a mesh"
                )
            stored = _with_fabrics(stored, self.fabric, Path(self.garment).name)
        write_garment_npz(self.out, stored)
        # The name of the file alone may be that of the garment's texture.
        drawn = self.out.with_name(f"{self.out.stem}_fit.png")
        views = [("before", stored.sewn_positions, 25.0), ("after", stored.rest_positions, 25.0)]
        has_picture = self.picture and _write_views(drawn, stored.faces, rig, views)
        if self.json:
            print(json.dumps(report, indent=2))
            for text in report.get("warnings", ()):
                say(f"warning: {text}")
        else:
            print(describe_fit(report) if "fit" in stored.metadata else describe_transfer(report))
            print(self.out)
            if has_picture:
                print(drawn)

    def _fitted(self, rig: Body) -> GarmentFile:
        """Return the garment, fitted to the body or carried to it from the one that it was made for."""
        from eslr_jax.pipeline.assets import asset_names, load_garment_file
        from eslr_jax.pipeline.dressing.fit import fit_garment
        from eslr_jax.pipeline.formats.garment import read_garment_source

        if self.made_for is None:
            return load_garment_file(self.garment, body=rig, fit=self.options)
        if not {self.garment, f"{self.garment}_1k"}.isdisjoint(asset_names("garment")):
            raise AssetError(f"garment {self.garment} is made for the bundled body; leave out --made-for")
        source, first = read_garment_source(self.garment), load_wearer(self.made_for)
        return fit_garment(source, rig, self.options, made_for=first)


def _with_fabrics(stored: GarmentFile, fabric: tuple[str, ...], name: str) -> GarmentFile:
    """Return a garment that keeps its fabrics; raise if one is unknown, or of a part that the garment lacks."""
    from eslr_jax.pipeline.assets import prepare_stored
    from eslr_jax.pipeline.fabrics import garment_material

    stored = dataclasses.replace(stored, metadata=stored.metadata | {"fabrics": list(fabric)})
    garment_material(fabric, prepare_stored(stored, name=name), stored)
    return stored


def _write_views(
    path: Path, faces: np.ndarray, rig: Body, views: Sequence[tuple[str, np.ndarray, float]]
) -> bool:
    """Render a garment on its body side by side, or say that the extra `render` is missing and return False.

    A view is a caption, the garment's vertices [m] and the angle of the camera in degrees.
    """
    import numpy as np

    from eslr_jax.pipeline.pictures import render_frame, side_by_side, write_png

    body = np.asarray(rig.rest_positions), np.asarray(rig.faces)
    look = {"rest_positions": body[0], "rig": rig, "size": (420, 560)}
    try:
        with waiting("rendering"):
            pictures = [
                render_frame(*body, positions, faces, camera=camera, **look) for _, positions, camera in views
            ]
    except MissingExtraError as error:
        say(f"no picture: {error}")
        return False
    write_png(path, side_by_side(pictures, tuple(caption for caption, _, _ in views)))
    return True


@app.command(name="sew")
@dataclasses.dataclass(frozen=True)
class Sew:
    """Sew a pattern around a body, for `eslr simulate --garment OUT`.

    A pattern is a specification of GarmentCode (..._specification.json): panels placed around a body, and
    stitches between their edges. A picture beside OUT shows the garment from the front and from the back.
    """

    # The pattern's file.
    pattern: tyro.conf.Positional[Path]
    # The garment file to write, such as shirt.npz; the picture is then shirt_sewn.png.
    out: Path
    # Name of a bundled body, a body file, or a moving mesh, which rests in its first frame: who wears it.
    body: str = "anny"
    # Unit of the body's file: m, cm, mm, in or ft; recognised if not given.
    body_units: str | None = None
    # Shape of a body with shapes, in standard deviations.
    betas: tuple[float, ...] = ()
    # The body that the pattern is made for, from which it is carried to the wearer: a name or a file; `body` is
    # the wearer itself. By default the bundled body in the shape of GarmentCode's mean body.
    made_for: str | None = None
    # About how many vertices the garment gets.
    vertices: int = 1000
    # Vertices that follow the body, as for `eslr fit`; a panel is a part, as in part:left_waistband.
    pin: tuple[str, ...] = ()
    # Fabric as for `eslr simulate`; it is kept in the file.
    fabric: tuple[str, ...] = ()
    # Render the picture (extra `render`).
    picture: bool = True
    # Print the report as JSON.
    json: bool = False

    def __call__(self) -> None:
        """Sew, write the file and the picture, and say what was done."""
        from eslr_jax.pipeline.assets.garments import sew_pattern_file
        from eslr_jax.pipeline.dressing.report import describe_sewing, describe_transfer
        from eslr_jax.pipeline.formats.garment import write_garment_npz

        check_npz(self.out, "a garment")
        with waiting("sewing"):
            rig = load_wearer(self.body, units=self.body_units, betas=self.betas)
            made_for = rig if self.made_for == "body" else self.made_for and load_wearer(self.made_for)
            stored = sew_pattern_file(
                self.pattern, rig, made_for=made_for or None, num_vertices=self.vertices, pin=self.pin
            )
            stored = _with_fabrics(stored, self.fabric, self.pattern.name)
        write_garment_npz(self.out, stored)
        report = stored.metadata["sewing"]
        print(json.dumps(report, indent=2) if self.json else describe_sewing(report))
        if "transfer" in stored.metadata:
            say(f"carried to {self.body}: {describe_transfer(stored.metadata['transfer'])}")
        drawn = self.out.with_name(f"{self.out.stem}_sewn.png")
        views = [("front", stored.rest_positions, 25.0), ("back", stored.rest_positions, 205.0)]
        has_picture = self.picture and _write_views(drawn, stored.faces, rig, views)
        if not self.json:
            print(self.out, *([drawn] if has_picture else []), sep="\n")


@app.command(name="joints")
@dataclasses.dataclass(frozen=True)
class Joints:
    """Show which joint of a motion each joint of a body follows."""

    # Name of a bundled motion, or a motion file: BVH, AMASS (.npz), HOOD or VTO (.pkl), or glTF.
    motion: str
    # Name of a bundled body, or a body file.
    body: str = "anny"
    # JSON file of changes: a joint of the body to one of the motion, "" to keep it still.
    joint_map: Path | None = None
    # File to write the map to; change it and give it to `eslr simulate --joint-map`.
    out: Path | None = None
    # Print as JSON.
    json: bool = False

    def __call__(self) -> None:
        """Print the map, and write it if a file is named."""
        from eslr_jax.files.atomic import atomic_write
        from eslr_jax.pipeline.assets import load_body
        from eslr_jax.pipeline.assets.motions import moving_skeleton, read_joint_map
        from eslr_jax.pipeline.rigs.rig import body_skeleton, is_body_model
        from eslr_jax.pose.joints import map_joints

        target = body_skeleton(load_body(self.body))
        source = moving_skeleton(self.motion)
        changes = None if self.joint_map is None else read_joint_map(self.joint_map)
        found = map_joints(target, source.skeleton, changes, same_names=is_body_model(target, source))
        values = {name: found.get(name, "") for name in target.joint_names}
        if self.out is not None:
            with atomic_write(self.out) as temporary:
                temporary.write_text(json.dumps(values, indent=2))
        if self.json:
            print(json.dumps(values, indent=2))
            return
        table = Table("joint of the body", "follows", box=None)
        for name, other in values.items():
            table.add_row(name, other or "-")
        Console().print(table, markup=False, highlight=False)
        unused = [name for name in source.skeleton.joint_names if name not in found.values()]
        stderr.print(f"not used: {', '.join(unused) or 'none'}", markup=False, highlight=False)


@app.command(name="convert")
@dataclasses.dataclass(frozen=True)
class Convert:
    """Convert a checkpoint of HOOD, for `eslr simulate --model FILE`; PyTorch is not needed."""

    # File that HOOD's training wrote: postcvpr, cvpr, fine15 or fine48.
    checkpoint: tyro.conf.Positional[Path]
    # File to write, .npz; its description gets the same name with .json.
    out: Path

    def __call__(self) -> None:
        """Read the checkpoint and write the network."""
        from eslr_jax.networks.registry import write_network
        from eslr_jax.pipeline.assets.hood import read_hood

        check_npz(self.out, "a network")
        network = read_hood(self.checkpoint)
        write_network(self.out, network, {"converted_from": self.checkpoint.name})
        print(f"{self.out}: {network.num_parameters:,} parameters")
