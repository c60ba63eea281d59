"""`eslr simulate`: a garment on a moving body, to files."""

from __future__ import annotations

import dataclasses
import json
import sys
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import tyro

from eslr_jax.cli.actor import Actor, load_actor
from eslr_jax.cli.budget import describe_load
from eslr_jax.cli.console import app, print_report, progress, say, use_compile_cache, waiting
from eslr_jax.cli.interrupt import EXIT_CODE
from eslr_jax.cli.method import Method, choose_method, expected_frame_ms, read_request
from eslr_jax.cli.options import (
    DEFAULT_GARMENT,
    Interrupted,
    Options,
    check_same_scene,
    interrupted_record,
    read_interrupted,
    wanted_self_contact,
)
from eslr_jax.errors import AssetError, ConfigError, EslrError, MissingExtraError

if TYPE_CHECKING:
    from jax import Array

    from eslr_jax.io.garment import GarmentFile
    from eslr_jax.simulation.interrupt import Interruption
    from eslr_jax.simulation.simulate import Simulation
    from eslr_jax.types import BodyMotion, Material, Scene, Trajectory

_LONG = 5.0  # [s]; a longer wait for the compiler is reported
_KEPT = 1.2  # times the budget; a longer mean time per frame counts as a miss


@app.command
def simulate(
    garment: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    motion: str | None = None,
    body: str = "anny",
    simulator: Literal["network", "physics"] | None = None,
    model: str | None = None,
    vertices: Literal["1k", "4k", "10k", "50k", "200k"] = "1k",
    fabric: tuple[str, ...] = (),
    frames: int | None = None,
    iterations: int | None = None,
    budget: str | None = None,
    tolerance: str | None = None,
    joint_map: Path | None = None,
    motion_up: Literal["auto", "y", "z"] = "auto",
    arm_abduction: float | None = None,
    body_fps: float | None = None,
    body_units: str | None = None,
    betas: tuple[float, ...] = (),
    start: str | None = None,
    loop: str | None = None,
    settle: int | None = None,
    integrator: Literal["euler", "bdf2"] | None = None,
    substeps: int = 1,
    self_contact: tyro.conf.FlagCreatePairsOff[bool] = False,
    no_self_contact: tyro.conf.FlagCreatePairsOff[bool] = False,
    ground: Literal["auto", "on", "off"] = "auto",
    wind: tuple[float, float, float] | None = None,
    gust: float = 0.0,
    damping: float | None = None,
    out: Path = Path("out"),
    resume: bool = False,
    pictures: bool = True,
    json_: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> None:
    """Simulate a garment on a moving body; write trajectory, animation, pictures and a report.

    By default the fastest simulator that keeps a tolerance of 1 % is chosen; give a budget, another tolerance or
    a simulator to change this. Ctrl-C keeps the frames that are done, and --resume goes on from them.

    Args:
        garment: Name of a bundled garment (see `eslr assets`), which is transferred to the body, or a mesh file,
            which is fitted to the body; see `eslr fit` if the fit goes wrong. Repeat the option for an outfit,
            the innermost garment first, as in --garment pants --garment tshirt. By default a T-shirt.
        motion: Name of a bundled motion; turn, jump or swing; or a motion file: BVH, AMASS (.npz), HOOD or VTO
            (.pkl), glTF, FILE#CLIP to pick a clip. By default the animation in the body's file, or else
            cmu_016_32.
        body: Name of a bundled body, or a body: a SMPL, SMPL-H or SMPL-X model (.npz, .pkl), a skinned
            character (glTF), or a moving mesh (.npz, or a folder of OBJ or PLY files). FILE#MESH,MESH picks the
            meshes of a character that are its body, without its clothes.
        simulator: physics is the solver alone; network is a trained network, from whose prediction the solver
            starts.
        model: Name of a bundled network or an exported file; the default network if a network is asked for and
            none is named.
        vertices: Resolution of bundled garments; from 50k on it is made at run time.
        fabric: Name of a fabric (see `eslr assets --kind fabric`), or numbers as in
            density=0.2,bending_stiffness=1e-5 or flexural_rigidity=5e-6. PART:FABRIC is the fabric of one part
            or of one garment of an outfit; the rest keeps its own. By default that of the fitted file, or cotton.
        frames: Simulate this many frames, the start included; all if not given.
        iterations: Solver iterations per frame: by default 100, or 10 after a network. With 0 the network
            simulates without the solver.
        budget: Time per frame, such as 20ms: choose the simulator that comes closest to the optimum in this time,
            and adapt its iterations during the run so that frames keep the budget.
        tolerance: Share of the initial gap that a frame may leave, such as 1%: choose the fastest simulator
            that keeps it, and stop each frame there. See `eslr calibrate`.
        joint_map: JSON file of changes to the map of joints that `eslr joints` shows.
        motion_up: Axis that points up in a BVH motion.
        arm_abduction: Degrees by which both arms are lifted; by default 12 for the motion of another body, and 0
            for the body's own motion.
        body_fps: Frames per second of a body that is a moving mesh.
        body_units: Unit of the body's file: m, dm, cm, mm, in, ft, or metres per unit; recognised if not given.
        betas: Shape of the bundled body or of a SMPL body, in standard deviations.
        start: Where to begin in the motion: a frame, such as 375, or a time, such as 12.5s.
        loop: How long to repeat the motion: frames or a time, such as 30s.
        settle: Frames before frame 0 in which the garment settles: the limbs move from the body's rest pose to
            the first pose, which the last 10 frames hold. These frames are not kept. By default 35, or 0 for a
            network alone.
        integrator: How time is stepped. bdf2 keeps swinging cloth in motion. With euler, the paper's integrator,
            swinging cloth loses two thirds of its energy in a second. The default is bdf2, or euler for a
            network alone, which was trained with it.
        substeps: Number of shorter steps per frame; 2 keeps layers apart that swing fast against each other.
            The iterations are those of each substep.
        self_contact: Keep all layers of cloth apart, also within each garment of an outfit. By default layers of
            a garment of one piece are kept apart where they can meet, and pieces and garments from each other.
        no_self_contact: Let layers of cloth pass through each other.
        ground: Model a level ground under the body's lowest point; auto does where cloth could reach it.
        wind: Model air that moves with this velocity in m/s, such as 3 0 0; y points up, and 0 0 0 is still air.
        gust: Strength of gusts, as a share of the wind's speed.
        damping: Internal damping of the fabric in seconds, such as 0.005; it calms fast ripples first.
        out: Folder to write to.
        resume: Go on with the simulation that was interrupted in this folder, with its own options.
        pictures: Render the contact sheet.
        json_: Print the report as JSON.
    """
    given = locals()
    from eslr_jax.simulation.interrupt import Interruption

    options = Options(**{field.name: given[field.name] for field in dataclasses.fields(Options)})
    out = out.expanduser()
    words = "stopping when these frames are written; Ctrl-C again stops at once and loses them"
    with Interruption(lambda: say(words)) as stop:
        report = _simulate(options, out, stop, is_resumed=resume, has_pictures=pictures)
    if json_:
        print(json.dumps(report, indent=2))
    else:
        _print_report(report, out)
    if report["error"] is not None:
        raise EslrError(f"{report['error']}; the frames before are kept in {out}")
    if report["interrupted_at"] is not None:
        say(
            f"stopped at frame {report['interrupted_at']['frame']}; "
            f"go on with: eslr simulate --out {out} --resume"
        )
        sys.exit(EXIT_CODE)


class _Setting(NamedTuple):
    """What is simulated, and how."""

    names: tuple[str, ...]  # of the garments
    garments: list[GarmentFile]  # each of them as the body wears it
    stored: GarmentFile  # all of them together
    actor: Actor
    material: Material
    method: Method
    settle: int  # frames before frame 0
    scene: Scene  # with these frames


def _simulate(
    options: Options, out: Path, stop: Interruption, *, is_resumed: bool, has_pictures: bool
) -> dict[str, Any]:
    """Simulate, write the run's folder, and return the report; from the first frames on, `stop` takes Ctrl-C."""
    from eslr_jax.io.atomic import ensure_output_dir

    use_compile_cache()
    interrupted = read_interrupted(out, options) if is_resumed else None
    options = options if interrupted is None else interrupted.options
    _check_counts(options)
    with waiting("preparing garment, body and motion"):
        setting = _prepare(options, interrupted)
        if interrupted is not None:
            check_same_scene(interrupted.done, setting.scene, out)
            setting = setting._replace(scene=setting.scene.replace(self_contact=interrupted.capacity))
    ensure_output_dir(out)
    _announce(options, setting)
    done = None if interrupted is None else interrupted.done
    simulation = _run(setting, done, stop)
    timing, budget_ms = simulation.timing, setting.method.budget_ms
    if timing.compile_s > _LONG:
        say(f"waited {timing.compile_s:.0f} s for the compiler; the next run of such a scene does not wait")
    if budget_ms is not None and timing.frame_ms > _KEPT * budget_ms:
        say(
            f"missed --budget {options.budget}: a frame took {timing.frame_ms:.1f} ms; eslr info --scene tells "
            "what the scene costs, eslr calibrate what this machine can do"
        )
    report = _write(options, out, setting, simulation)
    stop.end()
    if has_pictures and report["interrupted_at"] is None and not stop.is_wanted:
        _write_sheet(out, setting, simulation.trajectory.positions[setting.settle :])
    return report


def _check_counts(options: Options) -> None:
    """Check the options that are counts."""
    if options.frames is not None and options.frames < 2:
        raise AssetError(f"--frames {options.frames}: a simulation needs two frames or more")
    if options.settle is not None and options.settle < 0:
        raise ConfigError(f"--settle {options.settle}: give a number of frames, 0 or more")
    if options.iterations is not None and options.iterations < 0:
        raise ConfigError(f"--iterations {options.iterations}: give a number, 0 or more")


def _prepare(options: Options, interrupted: Interrupted | None) -> _Setting:
    """Load garments, body and motion, choose how to simulate them, and begin to compile it."""
    import numpy as np

    from eslr_jax.assets import load_garment_file, prepare_stored
    from eslr_jax.assets.garments import check_resolution
    from eslr_jax.body.timing import SETTLE_FRAMES, check_speed, with_settling
    from eslr_jax.contact.nearest import MAX_APPROACH
    from eslr_jax.fabric import garment_material
    from eslr_jax.fit.outfit import wear_together
    from eslr_jax.fit.report import describe_cost
    from eslr_jax.scene.plan import SceneOptions, prepare_scene
    from eslr_jax.simulation.simulate import begin_compiling
    from eslr_jax.terms.air import blowing

    request = read_request(options)
    names = options.garment or (DEFAULT_GARMENT,)
    check_resolution(names, options.vertices)
    actor = load_actor(options)
    garments = [
        load_garment_file(
            name,
            vertices=options.vertices,
            body=actor.rig,
            on_source=lambda source: _say_if_any(describe_cost(len(source.mesh.positions))),
        )
        for name in names
    ]
    stored = wear_together(garments, names)
    choice = None if interrupted is None else interrupted.choice
    method = choose_method(options, request, len(stored.rest_positions), choice)
    cloth = prepare_stored(stored, name="+".join(names), **method.garment_options)
    material = garment_material(options.fabric, cloth, stored)
    has_solver = method.config.iterations > 0
    settle = options.settle
    if settle is None:
        settle = SETTLE_FRAMES if has_solver else 0
    modelled = SceneOptions(
        self_contact=wanted_self_contact(options),
        has_folds=has_solver,
        ground=options.ground,
        has_skin=has_solver,
        integrator=options.integrator or ("bdf2" if has_solver else "euler"),
        substeps=options.substeps,
        air=blowing(options.wind, options.gust),
        damping=options.damping,
    )
    begin = partial(
        begin_compiling, method.params, config=method.config, is_paced=method.budget_ms is not None
    )
    settling = with_settling(actor.poses, settle, actor.rig)
    scene = prepare_scene(cloth, settling, material=material, options=modelled, on_shapes=begin)
    if scene.body is not None:
        vertices = np.asarray(scene.body.surface.vertex_ids)
        check_speed(actor.poses, MAX_APPROACH * options.substeps, vertices=vertices)
    return _Setting(names, garments, stored, actor, material, method, settle, scene)


def _announce(options: Options, setting: _Setting) -> None:
    """Say what a person wants to know before the simulation begins."""
    from eslr_jax.body.timing import begins_at_rest
    from eslr_jax.evaluation.report import start_crossing
    from eslr_jax.evaluation.words import describe_start
    from eslr_jax.fabric import beyond_training
    from eslr_jax.fit.report import LARGE, describe_fit, describe_transfer

    method, stored, scene = setting.method, setting.stored, setting.scene
    # A tolerance is kept by the solver behind a network, whatever the network knows of the fabric.
    if (
        method.model is not None
        and method.tolerance is None
        and (unseen := beyond_training(setting.material))
    ):
        say(f"no network has seen such a fabric ({', '.join(unseen)}): rather use --simulator physics")
    crossing = start_crossing(scene, parts=(stored.face_parts, stored.part_names))
    is_put_on = begins_at_rest(setting.settle, setting.actor.rig)
    _say_if_any(describe_start(crossing, is_put_on=is_put_on))
    for name, worn in zip(setting.names, setting.garments, strict=True):
        if "fit" in worn.metadata:
            say(describe_fit(worn.metadata["fit"]))
        if "transfer" in worn.metadata:
            say(f"{name} carried to {options.body}: {describe_transfer(worn.metadata['transfer'])}")
    num_vertices = len(stored.rest_positions)
    if num_vertices >= LARGE:
        frame_ms = expected_frame_ms(method, num_vertices, scene.substeps)
        say(describe_load(num_vertices, scene.num_frames, frame_ms))


def _write(options: Options, out: Path, setting: _Setting, simulation: Simulation) -> dict[str, Any]:
    """Write the good frames of a simulation, and what --resume needs if some are missing; return the report."""
    from eslr_jax.body.motion import first_poses
    from eslr_jax.fabric import worn_fabrics
    from eslr_jax.io.run import ClothTrack, scene_record, write_run
    from eslr_jax.io.unfinished import NAME, write_unfinished
    from eslr_jax.scene.plan import first_frames
    from eslr_jax.simulation.simulate import Simulation, good_frames, last_frames, raise_for_status

    whole, scene = simulation.trajectory, simulation.scene
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
        record = interrupted_record(options, setting.method.choice, scene.self_contact)
        write_unfinished(out, kept, record)
        poses = first_poses(poses, count)
        scene = first_frames(scene, kept.num_frames)
    trajectory, scene = last_frames(kept, scene, count)
    shown = Simulation(trajectory, simulation.timing, scene)
    with waiting("measuring"):
        last = {"frame": count - 1, "time_s": (count - 1) * float(poses.timestep)}
        report = {
            "garment": "+".join(setting.names),
            "fabric": list(worn_fabrics(options.fabric, stored)) or ["cotton"],
            "motion": motion,
            "motion_start_s": motion_start,
            **scene_record(scene),
            "settle": setting.settle,
            "wind_m_s": options.wind,
            "gust": options.gust,
            "damping_s": options.damping,
            "interrupted_at": last if is_unfinished else None,
            "error": error,
            **_measure(setting.method, shown, poses, stored),
        }
    with waiting("writing files"):
        track = ClothTrack(
            trajectory.positions, trajectory.velocities, trajectory.friction_loads, trajectory.residuals
        )
        write_run(out, track, scene, (rig, poses, stored), report=report)
        (out / "sheet.png").unlink(missing_ok=True)  # of an earlier run
        if not is_unfinished:
            (out / NAME).unlink(missing_ok=True)
    return report


def _run(setting: _Setting, done: Trajectory | None, stop: Interruption) -> Simulation:
    """Compile and simulate with progress; Ctrl-C ends it after the frames in work.

    Args:
        setting: What is simulated, and how.
        done: First frames of the scene, simulated before.
        stop: Takes Ctrl-C over once the first frames are done.
    """
    from eslr_jax.simulation.budget import keep_budget
    from eslr_jax.simulation.simulate import simulate as run

    method, scene, pace = setting.method, setting.scene, None
    if method.choice is not None and method.budget_ms is not None:
        pace = keep_budget(method.choice, method.budget_ms)
    # The first frames compile; the bar counts the time.
    with progress("compiling a frame", scene.num_frames - 1) as advance:

        def on_frames(count: int, total: int) -> None:
            advance(count, total, "simulating")
            stop.begin()  # before the first frames are done there is nothing to keep

        began = time.perf_counter()
        _compile_measures(scene, setting.actor.poses.positions.shape[0])
        waited = time.perf_counter() - began
        simulation = run(
            method.params,
            scene,
            config=method.config,
            pace=pace,
            on_frames=on_frames,
            is_stopping=lambda: stop.is_wanted,
            done=done,
            raises=False,
        )
    timing = simulation.timing
    return simulation._replace(timing=timing._replace(compile_s=waited + timing.compile_s))


def _compile_measures(scene: Scene, num_frames: int) -> None:
    """Compile the measures of a trajectory of so many frames, while its rollout is compiled in a thread."""
    import jax

    from eslr_jax.evaluation.metrics import measure_frames
    from eslr_jax.scene.plan import first_frames

    start = scene.initial_state.position
    positions = jax.ShapeDtypeStruct((num_frames, *start.shape), start.dtype)
    measure_frames.lower(positions, first_frames(scene, num_frames)).compile()


def _measure(
    method: Method, simulation: Simulation, poses: BodyMotion, stored: GarmentFile
) -> dict[str, Any]:
    """Return the part of the report that is measured, and with what."""
    import jax
    import numpy as np

    from eslr_jax.evaluation.report import environment, trajectory_report
    from eslr_jax.evaluation.wear import wear_report
    from eslr_jax.scene.build import skin_garment
    from eslr_jax.simulation.stepper import keeps_tolerance

    trajectory, timing, scene = simulation
    parts = stored.face_parts, stored.part_names
    skinned = jax.jit(skin_garment)(scene.garment, poses.joint_transforms)
    bounds, residuals = np.asarray(trajectory.gap_bounds)[1:], np.asarray(trajectory.residuals)[1:]
    is_kept = keeps_tolerance(bounds, residuals, method.config.tolerance)
    return {
        "simulator": method.simulator,
        "model": method.model,
        **trajectory_report(
            trajectory,
            scene,
            parts=parts,
            poses=poses,
            outfit=stored.outfit,
        ),
        **wear_report(trajectory.positions, scene.garment, skinned, poses, parts=parts),
        "choice": None if method.choice is None else dataclasses.asdict(method.choice),
        "tolerance": method.tolerance,
        "within_tolerance": None if method.tolerance is None else float(np.mean(is_kept)),
        "frame_ms": timing.frame_ms,
        "compile_s": timing.compile_s,
        **environment(),
    }


def _say_if_any(text: str | None) -> None:
    """Print a line on stderr, if there is one."""
    if text:
        say(text)


def _write_sheet(out: Path, setting: _Setting, positions: Array) -> None:
    """Render the contact sheet, garments of an outfit in their colours; without the extra `render` say so."""
    import numpy as np

    from eslr_jax.io.palette import outfit_colors
    from eslr_jax.render import contact_sheet, write_png

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


def _print_report(report: dict[str, Any], out: Path) -> None:
    """Print what a person wants to know, and where the files are."""
    spent = f"{report['frame_ms']:.1f} ms a frame, after {report['compile_s']:.1f} s of compilation"
    files = ", ".join(str(path) for path in sorted(out.iterdir()) if path.is_file())
    print_report(report, {"time": spent, "files": files})
