"""The command line: `eslr simulate`, `eslr export`, `eslr joints`, `eslr assets`, ...

Results go to stdout (as JSON with `--json`), progress and messages to stderr. Exit codes: 0 done, 1 a bug, 2
something that the user can put right.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from eslr_jax.errors import AssetError, EslrError, MissingExtraError
from eslr_jax.fit.options import FitOptions

app = tyro.extras.SubcommandApp()
_stderr = Console(stderr=True)


@contextlib.contextmanager
def _progress(label: str, total: int) -> Iterator[Any]:
    """Show a progress bar on stderr; yields a function of (done, total)."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=_stderr, transient=False) as progress:
        task = progress.add_task(label, total=total)
        yield lambda done, total: progress.update(task, completed=done, total=total)


def _use_compile_cache() -> None:
    """Keep compiled programs between runs: the second run of the same command starts at once."""
    import jax

    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "eslr-jax" / "compiled"
    with contextlib.suppress(OSError):
        cache.mkdir(parents=True, exist_ok=True)
        jax.config.update("jax_compilation_cache_dir", str(cache))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


@app.command
def simulate(
    garment: str = "tshirt",
    motion: str | None = None,
    body: str = "anny",
    simulator: Literal["network", "physics"] = "network",
    model: str | None = None,
    vertices: Literal["1k", "4k", "10k"] = "1k",
    fabric: tuple[str, ...] = (),
    frames: int | None = None,
    iterations: int = 100,
    corrector_steps: int = 10,
    budget: str | None = None,
    tolerance: str | None = None,
    joint_map: Path | None = None,
    motion_up: Literal["auto", "y", "z"] = "auto",
    arm_abduction: float | None = None,
    body_fps: float | None = None,
    self_contact: bool = False,
    out: Path = Path("out"),
    pictures: bool = True,
    json_: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> None:
    """Simulate a garment on a moving body; write trajectory, animation, pictures and a report.

    Args:
        garment: Name of a bundled garment (see `eslr assets`), or a mesh file, which is fitted to the body first;
            see `eslr fit` where recognition fails.
        motion: Name of a bundled motion; turn, jump or swing; or a motion file: BVH, AMASS (.npz), HOOD or VTO
            (.pkl), glTF or FBX, FILE#CLIP to pick a clip. By default the animation in the body's file, or else
            cmu_016_32.
        body: Name of a bundled body, or a body: a SMPL, SMPL-H or SMPL-X model (.npz, .pkl), a skinned
            character (glTF, FBX), or a moving mesh (.npz, or a folder of OBJ or PLY files).
        simulator: The trained network, or the physics solver.
        model: Name of a bundled network or an exported file; the default network if not given.
        vertices: Resolution of a bundled garment.
        fabric: Name of a fabric (see `eslr assets --kind fabric`), or numbers as in
            density=0.2,bending_stiffness=1e-5; behind PART: for one part of the garment. Cotton if not given.
        frames: Simulate this many frames, the start included; all if not given.
        iterations: Solver iterations per frame of the physics simulator.
        corrector_steps: Solver iterations behind the network; 0 is the network alone.
        budget: Time per frame, such as 20ms: choose the simulator that comes closest to the optimum within it.
        tolerance: Excess over the optimum relative to what a frame gains, such as 1%: choose the fastest
            simulator that keeps it, and let it stop each frame there. See `eslr calibrate`.
        joint_map: JSON file of changes to the map of joints that `eslr joints` shows.
        motion_up: Axis that points up in a BVH motion.
        arm_abduction: Degrees by which both arms are lifted from the motion's; by default 12 for motions of
            another body and 0 for the body's own.
        body_fps: Frames per second of a body that is a moving mesh.
        self_contact: Keep layers of cloth apart; the network does so only in its corrector.
        out: Folder to write to.
        pictures: Render the contact sheet.
        json_: Print the report as JSON.
    """
    from eslr_jax.io.atomic import atomic_write, ensure_output_dir

    out = ensure_output_dir(out)
    _use_compile_cache()
    if frames is not None and frames < 2:
        raise AssetError(f"--frames {frames}: a simulation needs two frames or more")

    import numpy as np

    from eslr_jax.assets import load_garment_file, load_model, prepare_stored
    from eslr_jax.assets.load import default_model
    from eslr_jax.config import SimConfig
    from eslr_jax.evaluation.calibrate import SOLVER, choose, read_calibration
    from eslr_jax.evaluation.report import environment, trajectory_report
    from eslr_jax.fabric import beyond_training, garment_material
    from eslr_jax.fit.report import describe_fit
    from eslr_jax.io.garment import write_garment_npz
    from eslr_jax.rollout import raise_for_status, rollout_in_chunks
    from eslr_jax.scene import prepare_scene

    budget_ms, share = _parse_budget(budget), _parse_share(tolerance)
    with _stderr.status("loading garment, body and motion"):
        rig, poses, motion = _load_actor(
            body, motion, frames, joint_map=joint_map, up=motion_up, arm_abduction=arm_abduction, fps=body_fps
        )
        stored = load_garment_file(garment, vertices=vertices, body=rig)
        choice = None
        if budget_ms is not None or share is not None:
            choice = choose(
                read_calibration(), len(stored.rest_positions), budget_ms=budget_ms, tolerance=share
            )
            simulator = "physics" if choice.method == SOLVER else "network"
            model = None if choice.method == SOLVER else choice.method
            iterations = corrector_steps = choice.iterations
        params, architecture = None, None
        options: dict[str, Any] = {}
        if simulator == "network":
            model = model or default_model()
            params, architecture = load_model(model)
            options = {
                "embedding_size": architecture.embedding_size,
                "embedding_mode": architecture.embedding_mode,
            }
        cloth = prepare_stored(stored, name=Path(garment).name, **options)
        material = garment_material(fabric, cloth, stored)
        unseen = beyond_training(material) if simulator == "network" else ()
        _check_skin(garment, cloth, rig, body)
        scene = prepare_scene(cloth, poses, material=material)
    if unseen:
        text = f"no network has seen such a fabric ({', '.join(unseen)}): rather use --simulator physics"
        _stderr.print(text, markup=False, highlight=False, soft_wrap=True)
    if "fit" in stored.metadata:
        _stderr.print(describe_fit(stored.metadata["fit"]), markup=False, highlight=False, soft_wrap=True)
    config = SimConfig(
        simulator=simulator,
        model=architecture,
        solver_iterations=iterations,
        corrector_steps=corrector_steps,
        tolerance=0.0 if choice is None else choice.tolerance,
        self_contact=self_contact,
    )
    with _progress("simulating", scene.num_frames - 1) as advance:
        trajectory, timing = rollout_in_chunks(params, scene, config=config, on_frames=advance)
    raise_for_status(trajectory)
    with _stderr.status("measuring"):
        report = {
            "garment": garment,
            "fabric": list(fabric or stored.metadata.get("fabrics", ())) or ["cotton"],
            "motion": motion,
            "simulator": simulator,
            "model": model,
            **trajectory_report(trajectory, scene),
            "choice": None if choice is None else dataclasses.asdict(choice),
            "frame_ms": timing.frame_ms,
            "compile_s": timing.compile_s,
            **environment(),
        }
    positions = np.asarray(trajectory.positions)
    with _stderr.status("writing files"):
        _write_motion(out, positions, np.asarray(trajectory.velocities), cloth, rig, poses, report)
        write_garment_npz(out / "garment.npz", stored)
    if pictures:
        _write_sheet(out, positions, cloth, poses)
    with atomic_write(out / "report.json") as temporary:
        temporary.write_text(json.dumps(report, indent=2))
    if json_:
        print(json.dumps(report, indent=2))
    else:
        _print_report(report, out)


def _parse_budget(text: str | None) -> float | None:
    """Return a time in milliseconds.

    Raises:
        ConfigError: It is not a positive time.
    """
    from eslr_jax.errors import ConfigError

    if text is None:
        return None
    units = {"ms": 1.0, "s": 1e3}
    unit = "ms" if text.endswith("ms") else "s"
    try:
        value = float(text.removesuffix(unit)) * units[unit] if text.endswith(unit) else 0.0
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise ConfigError(f"--budget {text}: write a time per frame, such as 20ms or 0.1s")
    return value


def _parse_share(text: str | None) -> float | None:
    """Return a share, written as 1% or 0.01.

    Raises:
        ConfigError: It is not between 0 and 1.
    """
    from eslr_jax.errors import ConfigError

    if text is None:
        return None
    try:
        value = float(text.removesuffix("%")) / (100 if text.endswith("%") else 1)
    except ValueError:
        value = 0.0
    if not 0 < value < 1:
        raise ConfigError(f"--tolerance {text}: write a share of what a frame gains, such as 1% or 0.01")
    return value


@app.command
def calibrate(models: tuple[str, ...] = (), out: Path | None = None) -> None:
    """Measure what this device can do in how much time, for `eslr simulate --budget` and `--tolerance`.

    Takes a few minutes on an otherwise idle machine. The result is kept with the compiled programs.

    Args:
        models: Bundled networks to measure beside the solver; the default network if not given.
        out: File to write to, instead of the one that `eslr simulate` reads.
    """
    from eslr_jax.assets.load import default_model
    from eslr_jax.evaluation.calibrate import cache_path, write_calibration
    from eslr_jax.evaluation.calibrate import calibrate as run

    _use_compile_cache()
    with _stderr.status("measuring"):
        measured = run(models or (default_model(),))
    path = out or cache_path()
    write_calibration(measured, path)
    table = Table("", "vertices", "per frame [ms]", "per iteration [ms]", "excess after 20", box=None)
    for method in measured.methods:
        table.add_row(
            method.name,
            str(method.vertices),
            f"{method.fixed_ms:.1f}",
            f"{method.iteration_ms:.2f}",
            f"{method.median['20']:.2%}",
        )
    Console().print(table, markup=False)
    print(path)


def _load_actor(
    body: str,
    motion: str | None,
    frames: int | None,
    *,
    joint_map: Path | None,
    up: Literal["auto", "y", "z"],
    arm_abduction: float | None,
    fps: float | None,
) -> tuple[Any, Any, str]:
    """Load a body and set it in motion; returns both, and the name of the motion."""
    from eslr_jax.assets import load_body, load_motion
    from eslr_jax.assets.load import own_motion
    from eslr_jax.body.joints import read_joint_map
    from eslr_jax.body.motion import pose_body
    from eslr_jax.body.sequence import pose_sequence
    from eslr_jax.errors import ConfigError
    from eslr_jax.io.mesh_sequence import is_mesh_sequence, read_mesh_sequence

    if Path(body).exists() and is_mesh_sequence(body):
        if motion is not None:
            raise ConfigError(f"{body} is a mesh in motion and follows no other; leave out --motion")
        return *pose_sequence(read_mesh_sequence(body, fps=fps), num_frames=frames), body
    if fps is not None:
        raise ConfigError(f"--body-fps is for bodies that are moving meshes; {body} is none")
    rig = load_body(body)
    motion = motion or own_motion(body)
    changes = None if joint_map is None else read_joint_map(joint_map)
    clip = load_motion(motion, body=rig, joint_map=changes, up=up)
    return rig, pose_body(rig, clip, num_frames=frames, arm_abduction=arm_abduction), motion


def _check_skin(garment: str, cloth, rig, body: str) -> None:
    """Refuse a garment that hangs on the joints of another body."""
    import numpy as np

    from eslr_jax.assets import asset_names, load_body
    from eslr_jax.errors import ConfigError

    is_bundled = garment in asset_names("garment") or f"{garment}_1k" in asset_names("garment")
    is_strange = is_bundled and rig.joint_names != load_body().joint_names
    if is_strange or int(np.asarray(cloth.skin_indices).max()) >= len(rig.joint_names):
        raise ConfigError(
            f"garment {garment} was made for another body than {body}; give a mesh that fits it"
        )


def _write_motion(out: Path, positions, velocities, cloth, rig, poses, report: dict[str, Any]) -> None:
    """Write the trajectory and the animated GLB."""
    import numpy as np

    from eslr_jax.io.gltf import AnimatedMesh, write_animated_glb
    from eslr_jax.io.gltf_skin import DEFAULT_BODY_COLOR, SkinnedMesh
    from eslr_jax.io.trajectory import write_trajectory

    faces = np.asarray(cloth.faces)
    timestep = float(poses.timestep)
    write_trajectory(
        out / "trajectory.npz",
        positions=positions,
        velocities=velocities,
        faces=faces,
        timestep=timestep,
        body_positions=np.asarray(poses.positions),
        body_faces=np.asarray(poses.faces),
        metadata=report,
    )
    meshes, skinned = [AnimatedMesh("garment", positions, faces)], None
    if rig.pose_directions is None and rig.parents.count(-1) == 1:
        skinned = SkinnedMesh(
            rest_positions=np.asarray(poses.rest_positions),
            faces=np.asarray(poses.faces),
            skin_weights=np.asarray(rig.skin_weights),
            skin_indices=np.asarray(rig.skin_indices),
            joint_transforms=np.asarray(poses.joint_transforms),
            joint_rest_positions=np.asarray(rig.joint_rest_positions),
            parents=rig.parents,
            joint_names=rig.joint_names,
        )
    else:  # joints alone don't move it as it moved
        body = AnimatedMesh("body", np.asarray(poses.positions), np.asarray(poses.faces), DEFAULT_BODY_COLOR)
        meshes.append(body)
    write_animated_glb(out / "animation.glb", meshes, timestep, skinned_body=skinned)


def _write_sheet(out: Path, positions, cloth, poses) -> None:
    """Render the contact sheet; without the extra `render` say so and go on."""
    import numpy as np

    from eslr_jax.render import contact_sheet, write_png

    try:
        with _progress("rendering", 8) as advance:
            sheet = contact_sheet(
                np.asarray(poses.positions),
                np.asarray(poses.faces),
                positions,
                np.asarray(cloth.faces),
                on_picture=advance,
            )
    except MissingExtraError as error:
        _stderr.print(f"no pictures: {error}", markup=False, highlight=False)
        return
    write_png(out / "sheet.png", sheet)


def _print_report(report: dict[str, Any], out: Path) -> None:
    """Print what a person wants to know first."""
    table = Table(show_header=False, box=None)
    terms = ", ".join(f"{name} {value:.4f}" for name, value in report["terms"].items())
    rows = {
        "frames": f"{report['num_frames']} of {report['num_vertices']} vertices",
        "time": f"{report['frame_ms']:.1f} ms a frame, after {report['compile_s']:.1f} s of compilation",
        "energy": f"{report['total']:.4f} J a frame ({terms})",
        "stretch": f"{report['max_principal_stretch']:.3f} at most",
    }
    if report["penetration_max_mm"] is not None:
        rows["penetration"] = (
            f"{report['penetration_p999_mm']:.2f} mm (99.9 %), {report['penetration_max_mm']:.2f} mm at most, "
            f"{report['penetrating_share'] * 100:.2f} % of vertices"
        )
    rows["files"] = ", ".join(str(path) for path in sorted(out.iterdir()) if path.is_file())
    for label, text in rows.items():
        table.add_row(label, text)
    Console().print(table, markup=False, highlight=False)


@app.command
def fit(
    garment: tyro.conf.Positional[str],
    out: Path,
    body: str = "anny",
    options: Annotated[FitOptions, tyro.conf.arg(name="")] = FitOptions(),  # noqa: B008 - frozen
    fabric: tuple[str, ...] = (),
    picture: bool = True,
    json_: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> None:
    """Fit a garment of your own to a body once, for `eslr simulate --garment OUT`.

    What is not given is recognised: unit, axes, place, and the pose of the arms. Beside OUT stands a picture,
    before on the left and after on the right.

    Args:
        garment: A mesh (obj, ply, stl, glb, npz), or FILE.pkl#NAME of HOOD's garments.
        out: The garment file to write, such as shirt.npz.
        body: Name of a bundled body, or a body file.
        options: What is not left to recognition.
        fabric: What it is made of, as for `eslr simulate`; kept in the file.
        picture: Render the picture (extra `render`).
        json_: Print the report as JSON.
    """
    from eslr_jax.assets import load_body, load_garment_file, prepare_stored
    from eslr_jax.fabric import garment_material
    from eslr_jax.fit.report import describe_fit
    from eslr_jax.io.garment import write_garment_npz

    if out.suffix != ".npz":
        raise AssetError(f"--out {out}: a fitted garment is an npz file; name it such as {out.stem}.npz")
    _use_compile_cache()
    with _stderr.status("fitting"):
        rig = load_body(body)
        stored = load_garment_file(garment, body=rig, fit=options)
        if "fit" not in stored.metadata:
            raise AssetError(f"{garment} is fitted already; give it to eslr simulate, or fit its mesh again")
        stored = dataclasses.replace(stored, metadata=stored.metadata | {"fabrics": list(fabric)})
        garment_material(fabric, prepare_stored(stored, name=Path(garment).name), stored)
    write_garment_npz(out, stored)
    if picture:
        _write_before_and_after(out.with_suffix(".png"), stored, rig)
    report = stored.metadata["fit"]
    if json_:
        print(json.dumps(report, indent=2))
    else:
        print(describe_fit(report))
        print(out)


def _write_before_and_after(path: Path, stored, rig) -> None:
    """Render the garment as it came and as it was fitted; without the extra `render` say so and go on."""
    import numpy as np

    from eslr_jax.errors import MissingExtraError
    from eslr_jax.render import render_frame, side_by_side, write_png

    body = np.asarray(rig.rest_positions), np.asarray(rig.faces)
    try:
        with _stderr.status("rendering"):
            pictures = [
                render_frame(*body, positions, stored.faces, camera=25.0, size=(420, 560))
                for positions in (stored.sewn_positions, stored.rest_positions)
            ]
    except MissingExtraError as error:
        _stderr.print(f"no picture: {error}", markup=False, highlight=False)
        return
    write_png(path, side_by_side(pictures, ("before", "after")))


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
        _stderr.print(
            f"{color}: dark {field.low:.3g} to yellow {field.high:.3g} {field.unit}", highlight=False
        )
    angle: str | float = float(camera) if camera.lstrip("-").replace(".", "", 1).isdigit() else camera
    meshes = trajectory.body_positions, trajectory.body_faces, trajectory.positions, trajectory.faces
    if out.suffix.lower() == ".png":
        size = (width or 280, round((width or 280) * 10 / 7))
        count = frames or 8
        with _progress("rendering", count) as advance:
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
        with _progress("rendering", count) as advance:
            write_video(out, _counted(pictures, count, advance), 1.0 / trajectory.timestep)
    print(out)


def _counted(items, total: int, advance) -> Iterator[Any]:
    """Yield items and show how many there were."""
    for done, item in enumerate(items, 1):
        yield item
        advance(done, total)


@app.command
def joints(
    motion: str,
    body: str = "anny",
    joint_map: Path | None = None,
    out: Path | None = None,
    json_: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> None:
    """Show which joint of a motion moves which joint of a body.

    Args:
        motion: A motion file: BVH, AMASS (.npz), HOOD or VTO (.pkl), glTF or FBX.
        body: Name of a bundled body, or a body file.
        joint_map: JSON file of changes: the body's joint to the motion's, "" to keep it still.
        out: Write the map here, to change it and give it to `eslr simulate --joint-map`.
        json_: Print as JSON.
    """
    from eslr_jax.assets import load_body
    from eslr_jax.assets.load import read_skeleton_motion
    from eslr_jax.body.joints import complete_map, read_joint_map
    from eslr_jax.body.rig import body_skeleton
    from eslr_jax.io.atomic import atomic_write

    target = body_skeleton(load_body(body))
    file, _, clip = motion.partition("#")
    source = read_skeleton_motion(file, clip).skeleton
    changes = None if joint_map is None else read_joint_map(joint_map)
    found = complete_map(target, source, changes)
    values = {name: found.get(name, "") for name in target.joint_names}
    if out is not None:
        with atomic_write(out) as temporary:
            temporary.write_text(json.dumps(values, indent=2))
    if json_:
        print(json.dumps(values, indent=2))
        return
    table = Table("joint of the body", "follows", box=None)
    for name, other in values.items():
        table.add_row(name, other or "-")
    Console().print(table, markup=False, highlight=False)
    unused = [name for name in source.joint_names if name not in found.values()]
    _stderr.print(f"not used: {', '.join(unused) or 'none'}", markup=False, highlight=False)


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


@app.command
def assets(
    kind: Literal["all", "body", "garment", "motion", "model", "fabric"] = "all",
    verify: bool = False,
    json_: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> None:
    """List what is in the box.

    Args:
        kind: Only this kind.
        verify: Compare every file with its checksum.
        json_: Print as JSON.
    """
    from eslr_jax.assets.catalog import is_intact, list_assets

    if kind == "fabric":
        _list_fabrics(json_)
        return
    chosen = [asset for asset in list_assets() if kind in ("all", asset.kind)]
    if verify:
        damaged = [asset.file for asset in chosen if not is_intact(asset)]
        if damaged:
            raise AssetError(f"damaged: {', '.join(sorted(set(damaged)))}; install the package again")
    if json_:
        print(json.dumps([dataclasses.asdict(asset) for asset in chosen], indent=2))
        return
    table = Table("kind", "name", "what", "licence", box=None)
    for asset in chosen:
        table.add_row(asset.kind, asset.name, asset.description, asset.licence)
    Console().print(table, markup=False)


def _list_fabrics(as_json: bool) -> None:
    """Print the table of fabrics."""
    from eslr_jax.physics.materials import FABRICS, describe_cotton

    rows = {"cotton": describe_cotton(), **FABRICS}
    if as_json:
        print(json.dumps({name: dataclasses.asdict(fabric) for name, fabric in rows.items()}, indent=2))
        return
    table = Table("fabric", "kg/m2", "stretch N/m", "bending J", "what", "source", box=None)
    for name, fabric in rows.items():
        numbers = (
            f"{fabric.density:.3f}",
            f"{fabric.stretch_stiffness:.0f}",
            f"{fabric.bending_stiffness:.1e}",
        )
        table.add_row(name, *numbers, fabric.what, fabric.source)
    Console().print(table, markup=False)


@app.command
def info(
    model: str = "eslr-15",
    scene: str | None = None,
    motion: str = "cmu_016_32",
    vertices: Literal["1k", "4k", "10k"] = "1k",
    simulator: Literal["network", "physics"] = "physics",
    self_contact: bool = False,
    json_: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> None:
    """Show an architecture and its number of parameters; or with --scene, what a scene models at what cost.

    Args:
        model: Name of an architecture, or of a bundled network, or an exported file.
        scene: A garment, by name or file, on the bundled body.
        motion: Motion of the scene.
        vertices: Resolution of a bundled garment.
        simulator: Simulator of the scene; the network is the default one.
        self_contact: Keep layers of cloth apart.
        json_: Print as JSON.
    """
    if scene is not None:
        _show_scene(scene, motion, vertices, simulator, self_contact, json_)
        return
    from eslr_jax.assets import asset_names, load_model
    from eslr_jax.config import to_dict
    from eslr_jax.models.registry import MODELS, count_parameters, init_model

    if model in MODELS:
        config = MODELS[model]
        params = init_model(config)
    elif model in asset_names("model") or Path(model).suffix:
        params, config = load_model(model)
    else:
        known = ", ".join([*MODELS, *asset_names("model")])
        raise AssetError(f"no model named {model!r}: there are {known}; a path to a file works too")
    values = {"model": model, "parameters": count_parameters(params), "config": to_dict(config)}
    if json_:
        print(json.dumps(values, indent=2))
        return
    print(f"{model}: {values['parameters']:,} parameters")
    for name, value in values["config"].items():
        print(f"  {name} = {value}")


def _show_scene(
    garment: str,
    motion: str,
    vertices: Literal["1k", "4k", "10k"],
    simulator: Literal["network", "physics"],
    self_contact: bool,
    as_json: bool,
) -> None:
    """Print what a scene models, what it leaves out, and what its parts cost."""
    from eslr_jax.assets import load_body, load_garment, load_model, load_motion
    from eslr_jax.assets.load import default_model
    from eslr_jax.body.motion import pose_body
    from eslr_jax.config import SimConfig
    from eslr_jax.evaluation.scene_parts import describe_scene, time_parts
    from eslr_jax.scene import prepare_scene

    _use_compile_cache()
    params, architecture = load_model(default_model()) if simulator == "network" else (None, None)
    config = SimConfig(simulator=simulator, model=architecture, self_contact=self_contact)
    with _stderr.status("measuring"):
        rig = load_body()
        poses = pose_body(rig, load_motion(motion))
        scene = prepare_scene(load_garment(garment, vertices=vertices, body=rig), poses)
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


@app.command
def train(
    out: Path,
    config: Path | None = None,
    set_: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(name="set")] = (),
    resume: bool = False,
    start_from: str | None = None,
    tensorboard: bool = False,
    coordinator: str | None = None,
    num_processes: int | None = None,
    process_id: int | None = None,
) -> None:
    """Train a network on the physics loss; Ctrl-C or SIGTERM writes a checkpoint first.

    A batch (`--set batch_size=8`) is spread over all devices of this machine, and with --coordinator over
    those of several machines: start the same command once on each.

    Args:
        out: Folder of metrics, checkpoints and the exported model.
        config: TOML file of a training configuration; not needed with --resume.
        set_: Changes to the configuration, as key=value with dots for tables, e.g. model.passes=4.
        resume: Go on from the newest checkpoint of the folder.
        start_from: Name of a bundled network or an exported file whose weights to start from.
        tensorboard: Write event files for TensorBoard too.
        coordinator: Address of the first process as HOST:PORT, or "auto" under Slurm.
        num_processes: Number of processes; not needed with "auto".
        process_id: Number of this process, from 0; not needed with "auto".
    """
    from eslr_jax.assets import load_model
    from eslr_jax.config import parse_override
    from eslr_jax.errors import ConfigError
    from eslr_jax.models.registry import check_params
    from eslr_jax.training.checkpoint import read_run_config
    from eslr_jax.training.loop import train as run
    from eslr_jax.training.plot import plot_curves
    from eslr_jax.training.recipe import load_recipe

    if resume:
        chosen = read_run_config(out)
    elif config is None:
        raise ConfigError("no --config; give a TOML file, such as one of experiments/configs")
    else:
        chosen = load_recipe(config, dict(parse_override(text) for text in set_))
    _use_compile_cache()
    initial = None
    if start_from is not None and not resume:
        initial, _ = load_model(start_from)
        check_params(chosen.model, initial)
    if coordinator is not None:
        _join_processes(coordinator, num_processes, process_id)
    with _training_progress(chosen.iterations, out if tensorboard else None) as show:
        state = run(chosen, out, resume=resume, initial_params=initial, on_progress=show)
    if _is_other_process():
        return
    plot_curves(out)
    done = int(state.iteration)
    if done < chosen.iterations:
        _stderr.print(
            f"stopped at iteration {done} of {chosen.iterations}; go on with: eslr train --out {out} --resume",
            markup=False,
        )
    else:
        print(out / "model.npz")


def _join_processes(coordinator: str, num_processes: int | None, process_id: int | None) -> None:
    """Connect with the other processes of a training run.

    Raises:
        ConfigError: The processes are not all told, or do not answer.
    """
    import jax

    from eslr_jax.errors import ConfigError

    is_automatic = coordinator == "auto"
    if not is_automatic and (num_processes is None or process_id is None):
        raise ConfigError("--coordinator HOST:PORT needs --num-processes and --process-id too")
    try:
        jax.distributed.initialize(None if is_automatic else coordinator, num_processes, process_id)
    except (RuntimeError, ValueError) as error:
        text = str(error).splitlines()[0]
        raise ConfigError(f"the processes could not be joined: {text}; check --coordinator") from error


def _is_other_process() -> bool:
    """Return whether another process of the run does the writing."""
    import jax

    return jax.process_index() > 0


@contextlib.contextmanager
def _training_progress(total: int, tensorboard: Path | None) -> Iterator[Any]:
    """Show iterations per second, the loss, its terms and the time left.

    Raises:
        ConfigError: TensorBoard's event files are asked for and its writer is not installed.
    """
    events = None
    if tensorboard is not None:
        from eslr_jax.errors import ConfigError

        try:
            from tensorboardX import SummaryWriter
        except ImportError as error:
            raise ConfigError(
                '--tensorboard needs tensorboardX; pip install "eslr-jax[tensorboard]"'
            ) from error
        events = SummaryWriter(str(tensorboard / "events"))
    columns = (
        TextColumn("training"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[text]}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=_stderr) as progress:
        task = progress.add_task("training", total=total, text="compiling")

        def show(done: int, total: int, metrics: dict[str, float]) -> None:
            terms = ("stretch", "bending", "inertia", "collision", "friction")
            shares = "\n".join(f"{name} {metrics[name] * 1e3:.1f} mJ" for name in terms)
            text = f"{metrics['its']:.1f} it/s\nloss {metrics['loss']:.4f}\n{shares}"
            progress.update(task, completed=done, total=total, text=text)
            if events is not None:
                for name, value in metrics.items():
                    events.add_scalar(name, value, done)

        yield show
    if events is not None:
        events.close()


@app.command
def evaluate(
    model: str,
    split: str = "test",
    vertices: Literal["1k", "4k", "10k"] = "1k",
    garments: tuple[str, ...] = (),
    clips: tuple[str, ...] = (),
    corrector_steps: int = 0,
    excess_frames: int = 40,
    every: int = 4,
    rollout_frames: int = 300,
    json_: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> None:
    """Evaluate a network on a split: excess over the optimum, and free rollouts.

    Args:
        model: Name of a bundled network, or an exported file.
        split: train, validation, test or unseen_motion.
        vertices: Resolution of the garments.
        garments: Only these; the training garments if not given.
        clips: Only these; all of the split if not given.
        corrector_steps: Solver iterations behind the network.
        excess_frames: Frames of each clip from which the excess is measured.
        every: Of those, measure one in so many.
        rollout_frames: Length of the free rollouts; clips are played back and forth.
        json_: Print as JSON.
    """
    from eslr_jax.assets import load_model
    from eslr_jax.evaluation.evaluate import EvaluationOptions
    from eslr_jax.evaluation.evaluate import evaluate as run
    from eslr_jax.evaluation.report import environment

    params, architecture = load_model(model)
    options = EvaluationOptions(
        split=split,
        garments=garments,
        clips=clips,
        vertices=vertices,
        excess_frames=excess_frames,
        every=every,
        rollout_frames=rollout_frames,
    )
    _use_compile_cache()
    with _progress("evaluating", 1) as advance:
        result = run(
            params,
            architecture,
            options,
            corrector_steps=corrector_steps,
            on_scene=lambda done, total, label: advance(done, total),
        )
    result = {"model": model, "corrector_steps": corrector_steps, **result, **environment()}
    if json_:
        print(json.dumps(result, indent=2))
        return
    table = Table(
        "", "excess, median [mJ]", "relative to the drop", "on the model's own states [mJ]", box=None
    )
    own = result["on_policy"]
    rows = {model: (result, own)}
    rows |= {f"L-BFGS {count}": (result["lbfgs"][count], own["lbfgs"][count]) for count in result["lbfgs"]}
    for label, (forced, policy) in rows.items():
        table.add_row(
            label,
            f"{forced['excess_median_j'] * 1e3:.3f}",
            f"{forced['excess_relative_median']:.4f}",
            f"{policy['excess_median_j'] * 1e3:.3f}",
        )
    Console().print(table, markup=False)
    print(json.dumps(result["rollout"], indent=2))


@app.command
def stress(
    simulator: Literal["physics", "network", "corrected"] = "physics",
    model: str | None = None,
    case: tuple[str, ...] = (),
    iterations: int = 200,
    corrector_steps: int = 20,
    out: Path | None = None,
    json_: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> None:
    """Run the hard cases: fifteen situations that break simulators. Exits with 0 if they ran, passed or not.

    Args:
        simulator: The physics solver, a trained network, or a network with the solver behind it.
        model: Name of a bundled network or an exported file; the default network if not given.
        case: Only these; all if not given.
        iterations: Solver iterations per frame of the physics simulator.
        corrector_steps: Solver iterations behind the network, where it is corrected.
        out: Folder for a picture of each case, a sheet of all, and the figures with versions.
        json_: Print one row per measure as JSON: case, passed, measure, value, bar.
    """
    from eslr_jax.assets import load_model
    from eslr_jax.assets.load import default_model
    from eslr_jax.evaluation.hard_cases import CASES, find_case, network_simulator, physics_simulator
    from eslr_jax.evaluation.stress import rows, summary, write_pictures
    from eslr_jax.evaluation.stress import stress as run
    from eslr_jax.io.atomic import atomic_write, ensure_output_dir

    for name in case:
        find_case(name)
    out = None if out is None else ensure_output_dir(out)
    _use_compile_cache()
    if simulator == "physics":
        chosen = physics_simulator(iterations=iterations)
    else:
        model = model or default_model()
        steps = corrector_steps if simulator == "corrected" else 0
        label = f"{model}, {steps} corrector iterations" if steps else model
        chosen = network_simulator(*load_model(model), name=label, corrector_steps=steps)
    table = Table("case", "measure", "value", "bar", "passed", title=chosen.name, box=None)
    total = len(case or CASES)
    with _progress("hard cases", total) as advance:
        done: list[str] = []

        def show(name: str, outcome: Any, seconds: float) -> None:
            done.append(name)
            advance(len(done), total)
            for row in outcome.rows():
                value = "not finite" if row["value"] is None else f"{row['value']:.4g}"
                bar = "" if row["bar"] is None else f"{row['bar']:g}"
                passed = "" if row["bar"] is None else "yes" if row["passed"] else "NO"
                table.add_row(name, row["measure"], value, bar, passed)

        outcomes = run(chosen, case, on_case=show)
    if out is not None:
        with atomic_write(out / "hard_cases.json") as temporary:
            temporary.write_text(json.dumps(summary(chosen, outcomes), indent=2))
        try:
            with _progress("rendering", total) as advance:
                write_pictures(outcomes, out, on_picture=advance)
        except MissingExtraError as error:
            _stderr.print(f"no pictures: {error}", markup=False, highlight=False)
    if json_:
        print(json.dumps(rows(outcomes), indent=2))
        return
    Console().print(table, markup=False)
    passed = sum(outcome.is_passed for outcome in outcomes)
    for outcome in outcomes:
        if not outcome.is_passed:
            case_ = CASES[outcome.case]
            print(f"failed: {outcome.case}: {case_.reason}")
            if simulator == "physics" and case_.limit:
                print(f"    known: {case_.limit}")
    print(f"{passed} of {total} cases passed")


def main() -> None:
    """Run the command line."""
    warnings.filterwarnings("ignore", category=DeprecationWarning)
    try:
        app.cli(prog="eslr")
    except EslrError as error:
        _stderr.print(f"eslr: {error}", markup=False, highlight=False, soft_wrap=True)
        sys.exit(2)
    except KeyboardInterrupt:
        _stderr.print("eslr: interrupted", markup=False)
        sys.exit(130)


if __name__ == "__main__":
    main()
