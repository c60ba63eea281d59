"""`eslr assets`, `eslr info` and `eslr cache`: bundled files, what a network or a scene is, what runs keep."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from rich.console import Console
from rich.table import Table

from eslr_jax.errors import AssetError, ConfigError
from eslr_jax.pipeline.cli.console import app, use_compile_cache, waiting
from eslr_jax.pipeline.cli.method import FPS, choose_method, load_wearer
from eslr_jax.pipeline.cli.options import Options, refuse_given

_ARCHITECTURE = "eslr-15"  # the paper's


@app.command(name="assets")
@dataclasses.dataclass(frozen=True)
class Assets:
    """List the bundled bodies, garments, motions, networks and fabrics."""

    # List only this kind.
    kind: Literal["all", "body", "garment", "motion", "model", "fabric"] = "all"
    # Compare every file with its checksum.
    verify: bool = False
    # Write the rest body to this OBJ file instead, to model a garment on: in metres, the feet at height 0.
    # The bundled body has Y up and faces Z; another stands as its file has it.
    export: Path | None = None
    # Body to export, anny by default: name of a bundled one, a body file, or a moving mesh, whose first frame
    # is taken.
    body: str | None = None
    # Print as JSON.
    json: bool = False

    def __call__(self) -> None:
        """List what is asked for, or export a body."""
        if self.export is not None:
            refuse_given("--export writes a body and lists nothing", {
                "--kind": self.kind != "all", "--verify": self.verify, "--json": self.json,
            })  # fmt: skip
            _export_body(self.export, self.body or "anny")
            return
        refuse_given("only --export takes a body", {"--body": self.body is not None})
        if self.kind == "fabric":
            refuse_given("fabrics have no files", {"--verify": self.verify})
            if self.json:
                print(json.dumps(_fabrics(), indent=2))
            else:
                _print_fabrics()
            return
        self._list_files()

    def _list_files(self) -> None:
        """List the files of a kind, and with all kinds the fabrics too."""
        from eslr_jax.pipeline.assets import load_motion
        from eslr_jax.pipeline.assets.catalog import is_intact, list_assets
        from eslr_jax.pose.retarget import count_resampled

        chosen = [asset for asset in list_assets() if self.kind in ("all", asset.kind)]
        damaged = {asset.file for asset in chosen if self.verify and not is_intact(asset)}
        if damaged:
            raise AssetError(f"damaged or missing: {', '.join(sorted(damaged))}; install the package again")
        motions = [asset.name for asset in chosen if asset.kind == "motion"]
        clips = map(load_motion, motions)
        frames = {clip.name: count_resampled(len(clip.rotations), clip.fps, FPS) for clip in clips}
        if self.json:
            rows = [{**dataclasses.asdict(asset), "frames": frames.get(asset.name)} for asset in chosen]
            if self.kind == "all":
                rows += [{"kind": "fabric", "name": name, **fabric} for name, fabric in _fabrics().items()]
            print(json.dumps(rows, indent=2))
            return
        table = Table("kind", "name", "what", "simulated as", "licence", box=None)
        for asset in chosen:
            count = frames.get(asset.name)
            length = "" if count is None else f"{count} frames, {(count - 1) / FPS:.1f} s"
            table.add_row(asset.kind, asset.name, asset.description, length, asset.licence)
        Console().print(table, markup=False)
        if self.kind == "all":
            _print_fabrics()


def _fabrics() -> dict[str, dict[str, Any]]:
    """Return all fabrics by name, as values of JSON."""
    from eslr_jax.fabric.drapes import BANDS, DRAPES
    from eslr_jax.fabric.materials import all_fabrics, bending_lengths

    return {
        name: {
            **dataclasses.asdict(fabric),
            "drape": DRAPES.get(name),
            "drape_band": BANDS[name]._asdict() if name in BANDS else None,
            "bending_lengths": bending_lengths(fabric),
        }
        for name, fabric in all_fabrics().items()
    }


def _export_body(path: Path, name: str) -> None:
    """Write a body's rest pose as an OBJ file, standing on the origin."""
    import numpy as np

    from eslr_jax.files.atomic import atomic_write
    from eslr_jax.pipeline.formats.obj import obj_text

    if path.suffix.lower() != ".obj":
        raise AssetError(
            f"--export {path}: a body is exported as an obj file; name it such as {path.stem}.obj"
        )
    rig = load_wearer(name)
    positions = np.asarray(rig.rest_positions, np.float64)
    positions[:, 1] -= positions[:, 1].min()
    with atomic_write(path) as temporary:
        temporary.write_text(obj_text("body", positions, np.asarray(rig.faces)))
    print(f"{path}: {positions[:, 1].max():.2f} m tall, in metres, its feet at height 0")


def _print_fabrics() -> None:
    """Print the fabrics as one table."""
    from eslr_jax.fabric.drapes import BANDS, DRAPES
    from eslr_jax.fabric.materials import all_fabrics, along_threads, bending_lengths

    columns = ("fabric", "g/m2", "drape %", "of its kind", "length cm", "E N/m", "B uN m", "G N/m")
    table = Table(*columns, "what", "source", box=None)
    for name, fabric in all_fabrics().items():
        band, (stiffness, rigidity) = BANDS.get(name), along_threads(fabric)
        numbers = (
            f"{1e3 * fabric.density:.0f}",
            f"{100 * DRAPES[name]:.0f}",
            f"{band.low:g} to {band.high:g}" if band else "",
            _pair([100 * length for length in bending_lengths(fabric)], ".1f"),
            _pair(stiffness[:2], ".0f"),
            _pair([1e6 * number for number in rigidity], ".1f"),
            f"{stiffness[3]:.0f}",
        )
        table.add_row(name, *numbers, fabric.what, fabric.source)
    Console().print(table, markup=False)
    print(
        "two numbers are along warp and weft; length is the bending length of a cantilever (Peirce); E, B and G "
        "are stretch, bending and shear as the FAST system has them; drape coefficients are simulated"
    )
    for source in sorted({band.source for band in BANDS.values()}):
        print(f"of its kind: {source}")


def _pair(values: Sequence[float], form: str) -> str:
    """Return two numbers, or one where they are the same."""
    first, second = (format(value, form) for value in values)
    return first if first == second else f"{first}, {second}"


@app.command(name="info")
@dataclasses.dataclass(frozen=True)
class Info:
    """Show an architecture and its number of parameters, or with --scene the parts of a scene and their costs."""

    # Name of a bundled network, or an exported file, as for `eslr simulate`; or else of an architecture, by
    # default the paper's, eslr-15.
    model: str | None = None
    # A garment, by name or file, on the bundled body.
    scene: str | None = None
    # Motion of the scene, by default cmu_016_32.
    motion: str | None = None
    # Resolution of a bundled garment; from 50k on it is made at run time.
    vertices: Literal["1k", "4k", "10k", "50k", "200k"] = "1k"
    # Simulator of the scene; the network is the default one.
    simulator: Literal["network", "physics"] = "physics"
    # How contact is kept, as of eslr simulate.
    contact: Literal["strict", "fast"] = "strict"
    # Print as JSON.
    json: bool = False

    def __call__(self) -> None:
        """Print what the options ask for."""
        if self.scene is not None:
            if self.model is not None:
                raise ConfigError(
                    "--model shows an architecture, --scene a scene with the default network: give one"
                )
            self._show_scene(self.scene)
            return
        refuse_given("only a --scene takes these", {
            "--motion": self.motion is not None, "--vertices": self.vertices != "1k",
            "--simulator": self.simulator != "physics", "--contact": self.contact != "strict",
        })  # fmt: skip
        self._show_network(self.model or _ARCHITECTURE)

    def _show_network(self, model: str) -> None:
        """Print an architecture and its number of parameters."""
        from eslr_jax.networks.network import describe_system
        from eslr_jax.networks.registry import MODELS
        from eslr_jax.pipeline.assets import load_model
        from eslr_jax.pipeline.assets.catalog import is_path

        try:
            network = load_model(model)
        except AssetError as error:
            if is_path(model):
                raise
            if model not in MODELS:
                raise AssetError(f"{error}; of architectures there are {', '.join(MODELS)}") from error
            network = MODELS[model].new_network()
        values = {
            "model": model, "form": network.config.form, "parameters": network.num_parameters,
            "config": describe_system(network.config),
        }  # fmt: skip
        if self.json:
            print(json.dumps(values, indent=2))
            return
        print(f"{model}: {values['parameters']:,} parameters; predicts {values['form']}")
        for name, value in values["config"].items():
            print(f"  {name} = {value}")

    def _show_scene(self, garment: str) -> None:
        """Print the parts that a scene models, those it leaves out, and their costs."""
        from eslr_jax.pipeline.assets import load_body, load_garment, load_motion
        from eslr_jax.pipeline.assets.garments import check_resolution
        from eslr_jax.pipeline.assets.motions import DEFAULT_MOTION
        from eslr_jax.pipeline.report.scene_parts import describe_scene, time_parts
        from eslr_jax.pose.motion import pose_body
        from eslr_jax.simulation.plan import prepare_scene

        use_compile_cache()
        check_resolution([garment], self.vertices)
        options = Options(simulator=self.simulator, contact=self.contact)
        method = choose_method(options)
        with waiting("measuring"):
            rig = load_body()
            poses = pose_body(rig, load_motion(self.motion or DEFAULT_MOTION))
            cloth = load_garment(garment, vertices=self.vertices, body=rig)
            scene = prepare_scene(cloth, poses, terms=options.terms(), integrator="bdf2")
            parts = describe_scene(scene, poses, method.params)
            costs = time_parts(method.params, scene, method.config)
        if self.json:
            print(json.dumps({**dataclasses.asdict(parts), "cost_ms": costs}, indent=2))
            return
        for title, entries in (("modelled", parts.modelled), ("left out", parts.left_out)):
            print(title)
            for name, size in entries.items():
                print(f"  {name}: {size}")
        print("cost on this device")
        for name, cost in costs.items():
            print(f"  {name}: {cost:.2f} ms")


@app.command(name="cache")
@dataclasses.dataclass(frozen=True)
class Cache:
    """Show what runs keep for the next ones: garments that were prepared, programs that were compiled."""

    # Remove it; the next run prepares and compiles anew.
    clear: bool = False
    # Print as JSON.
    json: bool = False

    def __call__(self) -> None:
        """Print folders with their sizes, as they are or were."""
        from eslr_jax.pipeline.assets.cache import cache_folder, compiled_folder, files_of

        kept = {}
        for folder in (cache_folder(), compiled_folder()):
            sizes = [size for _, size, _ in files_of(folder)]
            kept[folder.name] = {"folder": str(folder), "files": len(sizes), "mb": round(sum(sizes) / 1e6, 1)}
            if self.clear:
                shutil.rmtree(folder, ignore_errors=True)
        if self.json:
            print(json.dumps({**kept, "removed": self.clear}, indent=2))
            return
        for name, size in kept.items():
            done = ", removed" * self.clear
            print(f"{name}: {size['files']} files, {size['mb']} MB in {size['folder']}{done}")
