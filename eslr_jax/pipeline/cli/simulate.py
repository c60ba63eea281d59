"""`eslr simulate`: a garment on a moving body, to files."""

from __future__ import annotations

import dataclasses
import json
import sys
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from eslr_jax.errors import AssetError, ConfigError, EslrError, MissingExtraError
from eslr_jax.pipeline.cli.console import (
    EXIT_CODE,
    app,
    print_report,
    progress,
    say,
    use_compile_cache,
    waiting,
)
from eslr_jax.pipeline.cli.method import Actor, Method, choose_method, load_actor
from eslr_jax.pipeline.cli.options import Options

if TYPE_CHECKING:
    import numpy as np
    from jax import Array
    from jaxtyping import Int

    from eslr_jax.pipeline.formats.garment import GarmentFile
    from eslr_jax.simulation.interrupt import Interruption
    from eslr_jax.simulation.simulate import Simulation
    from eslr_jax.types import BodyMotion, Garment, Scene, Trajectory

_LONG = 5.0  # [s]; a longer wait for the compiler is reported
_KEPT = 1.2  # times the budget; a longer mean time per frame counts as a miss
UNFINISHED = "unfinished.npz"
_WORDS = {"content": "interrupted simulation", "remedy": "start without --resume in another folder"}


@app.command(name="simulate")
@dataclasses.dataclass(frozen=True)
class Simulate(Options):
    """Simulate a garment on a moving body; write trajectory, animation, pictures and a report.

    By default the solver ends a frame within 1 % of its initial optimality gap; give another tolerance, a budget,
    a number of iterations or a network to change this. Ctrl-C keeps the frames that are done, and --resume goes
    on from them.
    """

    # Folder to write to.
    out: Path = Path("out")
    # Go on with the simulation that was interrupted in this folder, with its own options.
    resume: bool = False
    # Render the contact sheet.
    pictures: bool = True
    # Print the report as JSON.
    json: bool = False

    def __call__(self) -> None:
        """Simulate, write the run's folder, and print the report; from the first frames on, Ctrl-C keeps them."""
        from eslr_jax.simulation.interrupt import Interruption

        out = self.out.expanduser()
        words = "stopping when these frames are written; Ctrl-C again stops at once and loses them"
        use_compile_cache()
        with Interruption(lambda: say(words)) as stop:
            report = simulate_run(dataclasses.replace(self, out=out), stop)
        if self.json:
            print(json.dumps(report, indent=2))
        else:
            spent = f"{report['frame_ms']:.1f} ms a frame, after {report['compile_s']:.1f} s of compilation"
            files = ", ".join(str(path) for path in sorted(out.iterdir()) if path.is_file())
            print_report(report, {"time": spent, "files": files})
        if report["error"] is not None:
            raise EslrError(f"{report['error']}; the frames before are kept in {out}")
        if report["interrupted_at"] is not None:
            say(
                f"stopped at frame {report['interrupted_at']['frame']}; "
                f"go on with: eslr simulate --out {out} --resume"
            )
            sys.exit(EXIT_CODE)


class _Setting(NamedTuple):
    """A body in motion, what it wears, and how it is simulated."""

    garments: list[GarmentFile]  # each of them as the body wears it; none where a simulation goes on
    stored: GarmentFile  # all of them together
    actor: Actor
    method: Method
    settle: int  # frames before frame 0


class Unfinished(NamedTuple):
    """A simulation that was interrupted: all that it needs to go on."""

    options: Options  # with plain values
    actor: Actor  # over all frames
    settle: int
    scene: Scene  # over all frames, with the buffers that sufficed
    done: Trajectory  # its first frames, without an error


def simulate_run(
    options: Simulate, stop: Interruption, *, near: Int[np.ndarray, " near"] | None = None
) -> dict[str, Any]:
    """Simulate, write the run's folder, and return the report.

    `near` are body vertices to search instead of those in reach: scenes that share them share a compiled program.
    """
    from eslr_jax.files.atomic import ensure_output_dir

    done = None
    if options.resume:
        options, setting, scene, done = _read_interrupted(options)
    else:
        options.check()
        with waiting("preparing garment, body and motion"):
            setting, scene = _prepare(options, near)
        ensure_output_dir(options.out)
        _announce(options, setting, scene)
    simulation = _run(setting, scene, done, stop)
    timing, budget_ms = simulation.timing, setting.method.budget_ms
    if timing.compile_s > _LONG:
        say(f"waited {timing.compile_s:.0f} s for the compiler; the next run of such a scene does not wait")
    if budget_ms is not None and timing.frame_ms > _KEPT * budget_ms:
        say(
            f"missed --budget {options.budget}: a frame took {timing.frame_ms:.1f} ms; eslr info --scene tells "
            "what the scene costs, eslr calibrate what this machine can do"
        )
    report = _write(options, setting, simulation)
    stop.end()
    if options.pictures and report["interrupted_at"] is None and not stop.is_wanted:
        _write_sheet(options.out, setting, simulation.trajectory.positions[setting.settle :])
    return report


def _read_interrupted(given: Simulate) -> tuple[Simulate, _Setting, Scene, Trajectory]:
    """Return the options of an interrupted simulation, what is simulated, and the frames that are done."""
    from eslr_jax.pipeline.formats.garment import read_garment_npz
    from eslr_jax.simulation.archive import read_tree

    if not (given.out / UNFINISHED).is_file():
        raise AssetError(f"{given.out} holds no interrupted simulation; leave out --resume")
    own, actor, settle, scene, done = read_tree(given.out / UNFINISHED, Unfinished, **_WORDS)
    asked = given.record()
    for field in dataclasses.fields(Options):
        value, known = asked[field.name], getattr(own, field.name)
        if value not in (field.default, known):
            raise ConfigError(
                f"{given.out} was simulated with {field.name.replace('_', '-')} = {_typed(known)}, not "
                f"{_typed(value)}; leave out all options but --out to go on, or start in another folder without "
                "--resume"
            )
    stored = read_garment_npz(given.out / "garment.npz")
    method = choose_method(own).within_budget(len(stored.rest_positions), own.substeps)
    return dataclasses.replace(given, **vars(own)), _Setting([], stored, actor, method, settle), scene, done


def _typed(value: Any) -> str:
    """Return an option's value as it is typed."""
    if value is None or value == ():
        return "none"
    return " ".join(map(str, value)) if isinstance(value, tuple) else str(value)


def reached_vertices(options: Options) -> Int[np.ndarray, " near"]:
    """Return the vertices of the body that the cloth of a scene can reach, see `simulate_run`."""
    import numpy as np

    from eslr_jax.terms.worn import Worn

    _, cloth, settling = _dress(options)
    surface = Worn(cloth, settling).surface
    return np.zeros(0, int) if surface is None else np.asarray(surface.vertex_ids)


def _dress(options: Options) -> tuple[_Setting, Garment, BodyMotion]:
    """Load garments, body and motion, and choose how to simulate them; the motion has the frames before."""
    from eslr_jax.pipeline.assets import load_garment_file, prepare_stored
    from eslr_jax.pipeline.assets.garments import check_resolution
    from eslr_jax.pipeline.dressing.outfit import wear_together
    from eslr_jax.pose.timing import SETTLE_FRAMES, with_settling

    names, method = options.garments, choose_method(options)
    check_resolution(names, options.vertices)
    actor = load_actor(options)
    garments = [load_garment_file(name, vertices=options.vertices, body=actor.rig) for name in names]
    stored = wear_together(garments, names)
    method = method.within_budget(len(stored.rest_positions), options.substeps)
    cloth = prepare_stored(stored, name="+".join(names), **method.garment_options)
    settle = options.settle
    if settle is None:
        settle = SETTLE_FRAMES if method.config.iterations > 0 else 0
    settling = with_settling(actor.poses, settle, actor.rig)
    return _Setting(garments, stored, actor, method, settle), cloth, settling


def _prepare(options: Options, near: Int[np.ndarray, " near"] | None) -> tuple[_Setting, Scene]:
    """Prepare the scene, and begin to compile it."""
    import numpy as np

    from eslr_jax.contact.nearest import MAX_APPROACH
    from eslr_jax.pipeline.fabrics import garment_material
    from eslr_jax.pose.timing import check_speed
    from eslr_jax.simulation.plan import prepare_scene
    from eslr_jax.simulation.simulate import begin_compiling
    from eslr_jax.terms.worn import surface_near

    setting, cloth, settling = _dress(options)
    method = setting.method
    begin = partial(begin_compiling, method.params, config=method.config, is_paced=method.pace is not None)
    surface = None
    if near is not None:
        surface = surface_near(np.isin(np.arange(settling.positions.shape[1]), near), settling)
    scene = prepare_scene(
        cloth,
        settling,
        material=garment_material(options.fabric, cloth, setting.stored),
        terms=options.terms(),
        integrator=options.integrator or ("bdf2" if method.config.iterations > 0 else "euler"),
        substeps=options.substeps,
        surface=surface,
        on_shapes=begin,
    )
    if scene.body is not None:
        vertices = np.asarray(scene.body.surface.vertex_ids)
        check_speed(setting.actor.poses, MAX_APPROACH * options.substeps, vertices=vertices)
    return setting, scene


def _announce(options: Options, setting: _Setting, scene: Scene) -> None:
    """Say what a person wants to know before the simulation begins."""
    from eslr_jax.pipeline.dressing.report import LARGE, describe_fit, describe_sewing, describe_transfer
    from eslr_jax.pipeline.fabrics import beyond_training
    from eslr_jax.pipeline.report.report import describe_start, start_crossing
    from eslr_jax.pose.timing import begins_at_rest

    method, stored = setting.method, setting.stored
    if method.network is not None:
        if method.model != method.network and options.iterations is None:
            say(f"a frame is solved by {method.model}; --iterations 0 is the network alone")
        # A tolerance is kept by the solver behind a network, whatever the network knows of the fabric.
        unseen = beyond_training(scene.material)
        if unseen and method.tolerance is None:
            say(f"no network has seen such a fabric ({', '.join(unseen)}): rather use --simulator physics")
    crossing = start_crossing(scene, parts=(stored.face_parts, stored.part_names))
    start = describe_start(crossing, is_put_on=begins_at_rest(setting.settle, setting.actor.rig))
    if start is not None:
        say(start)
    for name, worn in zip(options.garments, setting.garments, strict=True):
        if "fit" in worn.metadata:
            say(describe_fit(worn.metadata["fit"]))
        if "sewing" in worn.metadata:
            say(describe_sewing(worn.metadata["sewing"]))
        if "transfer" in worn.metadata:
            say(f"{name} carried to {options.body}: {describe_transfer(worn.metadata['transfer'])}")
    num_vertices = len(stored.rest_positions)
    if num_vertices >= LARGE:
        say(method.describe_load(num_vertices, scene.num_frames, scene.substeps))


def _run(setting: _Setting, scene: Scene, done: Trajectory | None, stop: Interruption) -> Simulation:
    """Compile and simulate with progress; Ctrl-C ends it after the frames in work."""
    import jax

    from eslr_jax.pipeline.report.metrics import measures_program
    from eslr_jax.simulation.plan import first_frames
    from eslr_jax.simulation.simulate import simulate

    method = setting.method
    # The first frames compile; the bar counts the time.
    with progress("compiling a frame", scene.num_frames - 1) as advance:

        def on_frames(count: int, total: int) -> None:
            advance(count, total, "simulating")
            stop.begin()  # before the first frames are done there is nothing to keep

        began = time.perf_counter()
        # The measures of the frames that are kept are compiled while a thread compiles their rollout.
        num_frames, start = setting.actor.poses.positions.shape[0], scene.initial_state.position
        positions = jax.ShapeDtypeStruct((num_frames, *start.shape), start.dtype)
        measures_program(positions, first_frames(scene, num_frames)).wait()
        waited = time.perf_counter() - began
        simulation = simulate(
            method.params,
            scene,
            config=method.config,
            pace=method.pace,
            on_frames=on_frames,
            is_stopping=lambda: stop.is_wanted,
            done=done,
            raises=False,
        )
    timing = simulation.timing
    return simulation._replace(timing=timing._replace(compile_s=waited + timing.compile_s))


def _write(options: Simulate, setting: _Setting, simulation: Simulation) -> dict[str, Any]:
    """Write the good frames of a simulation, and what --resume needs if some are missing; return the report."""
    import jax
    import numpy as np

    from eslr_jax.pipeline.fabrics import worn_fabrics
    from eslr_jax.pipeline.report.report import describe_model, environment, trajectory_report
    from eslr_jax.pipeline.report.run import write_run
    from eslr_jax.pipeline.report.wear import wear_report
    from eslr_jax.pose.lbs import skin_garment
    from eslr_jax.pose.motion import first_poses
    from eslr_jax.simulation.archive import write_tree
    from eslr_jax.simulation.plan import first_frames
    from eslr_jax.simulation.simulate import good_frames, last_frames, raise_for_status
    from eslr_jax.simulation.stepper import keeps_tolerance

    whole, scene, method, out = simulation.trajectory, simulation.scene, setting.method, options.out
    (rig, poses, motion, motion_start), stored = setting.actor, setting.stored
    kept, total, error = good_frames(whole), poses.positions.shape[0], None
    count = kept.num_frames - setting.settle
    try:
        raise_for_status(whole, settle=setting.settle)
    except EslrError as raised:
        if count < 2:
            raise
        error = str(raised)
    is_unfinished = count < total
    if is_unfinished:
        if count < 2:
            raise KeyboardInterrupt
        unfinished = Unfinished(Options(**options.record()), setting.actor, setting.settle, scene, kept)
        write_tree(out / UNFINISHED, unfinished, content=_WORDS["content"])
        poses = first_poses(poses, count)
        scene = first_frames(scene, kept.num_frames)
    trajectory, scene = last_frames(kept, scene, count)
    with waiting("measuring"):
        parts = stored.face_parts, stored.part_names
        skinned = jax.jit(skin_garment)(scene.garment, poses.joint_transforms)
        bounds, residuals = (np.asarray(track)[1:] for track in (trajectory.gap_bounds, trajectory.residuals))
        is_kept = keeps_tolerance(bounds, residuals, method.config.tolerance)
        last = {"frame": count - 1, "time_s": (count - 1) * float(poses.timestep)}
        report = {
            "garment": "+".join(options.garments),
            "fabric": list(worn_fabrics(options.fabric, stored)) or ["cotton"],
            "motion": motion,
            "motion_start_s": motion_start,
            **describe_model(scene),
            "settle": setting.settle,
            "wind_m_s": options.wind,
            "gust": options.gust,
            "damping_s": options.damping,
            "interrupted_at": last if is_unfinished else None,
            "error": error,
            "simulator": "physics" if method.network is None else "network",
            "model": method.model,
            **trajectory_report(trajectory, scene, parts=parts, poses=poses, outfit=stored.outfit),
            **wear_report(trajectory.positions, scene.garment, skinned, poses, parts=parts),
            "budget_ms": method.budget_ms,
            "tolerance": method.tolerance,
            "within_tolerance": None if method.tolerance is None else float(np.mean(is_kept)),
            "frame_ms": simulation.timing.frame_ms,
            "compile_s": simulation.timing.compile_s,
            **environment(),
        }
    with waiting("writing files"):
        write_run(out, trajectory, scene, (rig, poses, stored), report=report)
        (out / "sheet.png").unlink(missing_ok=True)  # of an earlier run
        if not is_unfinished:
            (out / UNFINISHED).unlink(missing_ok=True)
    return report


def _write_sheet(out: Path, setting: _Setting, positions: Array) -> None:
    """Render the contact sheet, garments of an outfit in their colours; without the extra `render` say so."""
    import numpy as np

    from eslr_jax.pipeline.formats.palette import outfit_colors
    from eslr_jax.pipeline.pictures import contact_sheet, write_png

    rig, poses, stored = setting.actor.rig, setting.actor.poses, setting.stored
    try:
        with progress("rendering", 8) as advance:
            sheet = contact_sheet(
                np.asarray(poses.positions),
                np.asarray(poses.faces),
                np.asarray(positions),
                stored.faces,
                vertex_colors=outfit_colors(list(stored.outfit.values())),
                rest_positions=np.asarray(poses.rest_positions),
                rig=rig,
                timestep=float(poses.timestep),
                on_picture=advance,
            )
    except MissingExtraError as error:
        say(f"no pictures: {error}")
        return
    write_png(out / "sheet.png", sheet)
