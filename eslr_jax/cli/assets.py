"""`eslr assets` and `eslr info`: the bundled files, and what a network or a scene consists of."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.table import Table

from eslr_jax.cli.actor import FPS
from eslr_jax.cli.console import app, use_compile_cache, waiting
from eslr_jax.cli.options import refuse_given
from eslr_jax.errors import AssetError, ConfigError

_ARCHITECTURE = "eslr-15"  # the paper's


@app.command
def assets(
    kind: Literal["all", "body", "garment", "motion", "model", "fabric"] = "all",
    verify: bool = False,
    export: Path | None = None,
    body: str | None = None,
    json_: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> None:
    """List the bundled bodies, garments, motions, networks and fabrics.

    Args:
        kind: List only this kind.
        verify: Compare every file with its checksum.
        export: Write the rest body to this OBJ file instead, to model a garment on: in metres, the feet at height
            0. The bundled body has Y up and faces Z; another stands as its file has it.
        body: Body to export, anny by default: name of a bundled one, a body file, or a moving mesh, whose first
            frame is taken.
        json_: Print as JSON.
    """
    from eslr_jax.assets.catalog import is_intact, list_assets

    if export is not None:
        refuse_given("--export writes a body and lists nothing", {
            "--kind": kind != "all", "--verify": verify, "--json": json_,
        })  # fmt: skip
        _export_body(export, body or "anny")
        return
    refuse_given("only --export takes a body", {"--body": body is not None})
    if kind == "fabric":
        refuse_given("fabrics have no files", {"--verify": verify})
        _list_fabrics(json_)
        return
    chosen = [asset for asset in list_assets() if kind in ("all", asset.kind)]
    if verify:
        damaged = [asset.file for asset in chosen if not is_intact(asset)]
        if damaged:
            raise AssetError(
                f"damaged or missing: {', '.join(sorted(set(damaged)))}; install the package again"
            )
    frames = _simulated_frames([asset.name for asset in chosen if asset.kind == "motion"])
    if json_:
        rows = [{**dataclasses.asdict(asset), "frames": frames.get(asset.name)} for asset in chosen]
        if kind == "all":
            rows += [{"kind": "fabric", "name": name, **fabric} for name, fabric in _fabrics().items()]
        print(json.dumps(rows, indent=2))
        return
    table = Table("kind", "name", "what", "simulated as", "licence", box=None)
    for asset in chosen:
        count = frames.get(asset.name)
        length = "" if count is None else f"{count} frames, {(count - 1) / FPS:.1f} s"
        table.add_row(asset.kind, asset.name, asset.description, length, asset.licence)
    Console().print(table, markup=False)
    if kind == "all":
        _list_fabrics(as_json=False)


def _fabrics() -> dict[str, dict[str, Any]]:
    """Return all fabrics by name, as values of JSON."""
    from eslr_jax.physics.materials import FABRICS, WOVEN, describe_cotton

    everything = {"cotton": describe_cotton(), **FABRICS, **WOVEN}
    return {name: dataclasses.asdict(fabric) for name, fabric in everything.items()}


def _simulated_frames(names: list[str]) -> dict[str, int]:
    """Return how many frames bundled motions have as they are simulated."""
    from eslr_jax.assets import load_motion
    from eslr_jax.body.retarget import count_resampled

    motions = map(load_motion, names)
    return {motion.name: count_resampled(len(motion.rotations), motion.fps, FPS) for motion in motions}


def _export_body(path: Path, name: str) -> None:
    """Write a body's rest pose as an OBJ file, standing on the origin."""
    import numpy as np

    from eslr_jax.cli.actor import load_wearer
    from eslr_jax.io.atomic import atomic_write
    from eslr_jax.io.obj import obj_text

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


def _list_fabrics(as_json: bool) -> None:
    """Print the table of fabrics."""
    from eslr_jax.physics.materials import FABRICS, WOVEN, describe_cotton

    if as_json:
        print(json.dumps(_fabrics(), indent=2))
        return
    table = Table("fabric", "kg/m2", "stretch N/m", "bending J", "what", "source", box=None)
    for name, fabric in {"cotton": describe_cotton(), **FABRICS}.items():
        numbers = (
            f"{fabric.density:.3f}",
            f"{fabric.stretch_stiffness:.0f}",
            f"{fabric.bending_stiffness:.1e}",
        )
        table.add_row(name, *numbers, fabric.what, fabric.source)
    Console().print(table, markup=False)
    table = Table(
        "by threads", "kg/m2", "warp N/m", "weft N/m", "shear N/m", "warp N m", "weft N m", "source", box=None
    )
    for name, woven in WOVEN.items():
        warp, weft, _, shear = woven.weave.stiffness or (0.0,) * 4
        numbers = [f"{woven.density:.3f}", *(f"{number:.0f}" for number in (warp, weft, shear))]
        table.add_row(
            name, *numbers, *(f"{number:.1e}" for number in woven.weave.rigidity or ()), woven.source
        )
    Console().print(table, markup=False)


@app.command
def info(
    model: str | None = None,
    scene: str | None = None,
    motion: str | None = None,
    vertices: Literal["1k", "4k", "10k", "50k", "200k"] = "1k",
    simulator: Literal["network", "physics"] = "physics",
    self_contact: bool = False,
    json_: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> None:
    """Show an architecture and its number of parameters, or with --scene the parts of a scene and their costs.

    Args:
        model: Name of a bundled network, or an exported file, as for `eslr simulate`; or else of an architecture,
            by default the paper's, eslr-15.
        scene: A garment, by name or file, on the bundled body.
        motion: Motion of the scene, by default cmu_016_32.
        vertices: Resolution of a bundled garment; from 50k on it is made at run time.
        simulator: Simulator of the scene; the network is the default one.
        self_contact: Keep all layers of cloth apart, also where they don't seem to meet.
        json_: Print as JSON.
    """
    if scene is not None:
        if model is not None:
            raise ConfigError(
                "--model shows an architecture, --scene a scene with the default network: give one"
            )
        _show_scene(scene, motion, vertices, simulator, self_contact, json_)
        return
    refuse_given("only a --scene takes these", {
        "--motion": motion is not None, "--vertices": vertices != "1k", "--simulator": simulator != "physics",
        "--self-contact": self_contact,
    })  # fmt: skip
    from eslr_jax.assets import load_model
    from eslr_jax.assets.catalog import is_path
    from eslr_jax.config import to_dict
    from eslr_jax.models.registry import MODELS, count_parameters, init_model

    model = model or _ARCHITECTURE
    try:
        params, config = load_model(model)
    except AssetError as error:
        if is_path(model):
            raise
        if model not in MODELS:
            raise AssetError(f"{error}; of architectures there are {', '.join(MODELS)}") from error
        config = MODELS[model]
        params = init_model(config)
    values = {"model": model, "parameters": count_parameters(params), "config": to_dict(config)}
    if json_:
        print(json.dumps(values, indent=2))
        return
    print(f"{model}: {values['parameters']:,} parameters")
    for name, value in values["config"].items():
        print(f"  {name} = {value}")


def _show_scene(
    garment: str,
    motion: str | None,
    vertices: Literal["1k", "4k", "10k", "50k", "200k"],
    simulator: Literal["network", "physics"],
    self_contact: bool,
    as_json: bool,
) -> None:
    """Print the parts that a scene models, those it leaves out, and their costs."""
    from eslr_jax.assets import load_body, load_garment, load_model, load_motion
    from eslr_jax.assets.garments import check_resolution
    from eslr_jax.assets.models import DEFAULT_MODEL
    from eslr_jax.assets.motions import DEFAULT_MOTION
    from eslr_jax.body.motion import pose_body
    from eslr_jax.cli.method import BEHIND_NETWORK, ITERATIONS
    from eslr_jax.config import SimConfig
    from eslr_jax.evaluation.scene_parts import describe_scene, time_parts
    from eslr_jax.scene.plan import SceneOptions, prepare_scene

    use_compile_cache()
    params, architecture = load_model(DEFAULT_MODEL) if simulator == "network" else (None, None)
    check_resolution([garment], vertices)
    config = SimConfig(model=architecture, iterations=ITERATIONS if architecture is None else BEHIND_NETWORK)
    options = SceneOptions(  # those of `eslr simulate`
        self_contact=self_contact or None, has_folds=True, has_skin=True, integrator="bdf2"
    )
    with waiting("measuring"):
        rig = load_body()
        poses = pose_body(rig, load_motion(motion or DEFAULT_MOTION))
        scene = prepare_scene(load_garment(garment, vertices=vertices, body=rig), poses, options=options)
        parts = describe_scene(scene, poses, config)
        costs = time_parts(params, scene, config)
    if as_json:
        print(json.dumps({**dataclasses.asdict(parts), "cost_ms": costs}, indent=2))
        return
    for title, entries in (("modelled", parts.modelled), ("left out", parts.left_out)):
        print(title)
        for name, size in entries.items():
            print(f"  {name}: {size}")
    print("cost on this device")
    for name, cost in costs.items():
        print(f"  {name}: {cost:.2f} ms")
