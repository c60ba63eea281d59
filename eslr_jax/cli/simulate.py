"""`eslr simulate`: a garment on a moving body, to files."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import tyro
from rich.console import Console
from rich.table import Table

from eslr_jax.cli.budget import parse_request
from eslr_jax.cli.console import app, progress, stderr, use_compile_cache
from eslr_jax.errors import AssetError, ConfigError, MissingExtraError

_ITERATIONS = 100  # of the solver alone: 0.002 % above the optimum in the median, 1k
_BEHIND_NETWORK = 10  # likewise behind a network
_FPS = 30.0  # of the simulation
_KEPT = 1.2  # times a budget, from which on it counts as missed


@app.command
def simulate(
    garment: str = "tshirt",
    motion: str | None = None,
    body: str = "anny",
    simulator: Literal["network", "physics"] | None = None,
    model: str | None = None,
    vertices: Literal["1k", "4k", "10k"] = "1k",
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
    settle: int = 0,
    self_contact: bool = False,
    out: Path = Path("out"),
    pictures: bool = True,
    json_: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> None:
    """Simulate a garment on a moving body; write trajectory, animation, pictures and a report.

    The fastest within a tolerance of 1 % is chosen, unless a budget, another tolerance or a simulator is given.

    Args:
        garment: Name of a bundled garment (see `eslr assets`), or a mesh file, which is fitted to the body first;
            see `eslr fit` where recognition fails.
        motion: Name of a bundled motion; turn, jump or swing; or a motion file: BVH, AMASS (.npz), HOOD or VTO
            (.pkl), glTF, FILE#CLIP to pick a clip. By default the animation in the body's file, or else
            cmu_016_32.
        body: Name of a bundled body, or a body: a SMPL, SMPL-H or SMPL-X model (.npz, .pkl), a skinned
            character (glTF), or a moving mesh (.npz, or a folder of OBJ or PLY files).
        simulator: The solver alone (physics), or with a trained network in front (network).
        model: Name of a bundled network or an exported file; the default network if a network is asked for and
            none is named.
        vertices: Resolution of a bundled garment.
        fabric: Name of a fabric (see `eslr assets --kind fabric`), or numbers as in
            density=0.2,bending_stiffness=1e-5; behind PART: for one part of the garment. Cotton if not given.
        frames: Simulate this many frames, the start included; all if not given.
        iterations: Iterations of the solver per frame. By default 100, or 10 behind a network; 0 leaves the
            network alone.
        budget: Time per frame, such as 20ms: choose the simulator that comes closest to the optimum within it,
            and keep to it while it runs.
        tolerance: Optimality gap relative to what a frame gains, such as 1%: choose the fastest
            simulator that keeps it, and let it stop each frame there. See `eslr calibrate`.
        joint_map: JSON file of changes to the map of joints that `eslr joints` shows.
        motion_up: Axis that points up in a BVH motion.
        arm_abduction: Degrees by which both arms are lifted from the motion's; by default 12 for motions of
            another body and 0 for the body's own.
        body_fps: Frames per second of a body that is a moving mesh.
        body_units: Unit of the body's file: m, cm, mm, in or ft; recognised if not given.
        betas: Shape of a SMPL body, in standard deviations.
        start: Where to begin in the motion: a frame, such as 375, or a time, such as 12.5s.
        loop: How long to repeat the motion: frames or a time, such as 30s.
        settle: Frames in which the garment settles on the first pose before frame 0; they are not kept.
        self_contact: Keep layers of cloth apart.
        out: Folder to write to.
        pictures: Render the contact sheet.
        json_: Print the report as JSON.
    """
    from eslr_jax.io.atomic import atomic_write, ensure_output_dir

    use_compile_cache()
    if frames is not None and frames < 2:
        raise AssetError(f"--frames {frames}: a simulation needs two frames or more")

    import numpy as np

    from eslr_jax.assets import load_garment_file, load_model, prepare_stored
    from eslr_jax.assets.load import default_model
    from eslr_jax.body.timing import check_speed, with_settling
    from eslr_jax.config import SimConfig
    from eslr_jax.contact.nearest import MAX_APPROACH
    from eslr_jax.evaluation.report import environment, trajectory_report
    from eslr_jax.fabric import beyond_training, garment_material
    from eslr_jax.fit.report import describe_fit
    from eslr_jax.io.garment import write_garment_npz
    from eslr_jax.scene.plan import SceneOptions, prepare_scene
    from eslr_jax.simulation.budget import SOLVER, choose, keep_budget, read_calibration
    from eslr_jax.simulation.simulate import last_frames
    from eslr_jax.simulation.simulate import simulate as run_simulation

    is_chosen = simulator is None and model is None and iterations is None
    budget_ms, share = parse_request(budget, tolerance, is_chosen=is_chosen)
    if simulator == "physics" and model is not None:
        raise ConfigError(f"--simulator physics has no network; leave out --model {model}")
    if settle < 0:
        raise ConfigError(f"--settle {settle}: give a number of frames, 0 or more")
    actor = _Actor(
        body, motion, frames, joint_map, motion_up, arm_abduction, body_fps, body_units, betas, start, loop
    )
    with stderr.status("loading garment, body and motion"):
        rig, poses, motion = _load_actor(actor)
        stored = load_garment_file(garment, vertices=vertices, body=rig)
        choice = None
        if budget_ms is not None or share is not None:
            choice = choose(
                read_calibration(), len(stored.rest_positions), budget_ms=budget_ms, tolerance=share
            )
            simulator = "physics" if choice.method == SOLVER else "network"
            model = None if choice.method == SOLVER else choice.method
            iterations = choice.iterations
        simulator = simulator or ("physics" if iterations is not None and model is None else "network")
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
        # A tolerance is kept by the solver behind a network, whatever the network knows of the fabric.
        unseen = beyond_training(material) if simulator == "network" and share is None else ()
        _check_skin(garment, cloth, rig, body)
        settling = with_settling(poses, settle)
        scene = prepare_scene(
            cloth, settling, material=material, options=SceneOptions(self_contact=self_contact)
        )
        if scene.body is not None:
            check_speed(poses, MAX_APPROACH, vertices=np.asarray(scene.body.surface.vertex_ids))
    out = ensure_output_dir(out)
    if unseen:
        text = f"no network has seen such a fabric ({', '.join(unseen)}): rather use --simulator physics"
        stderr.print(text, markup=False, highlight=False, soft_wrap=True)
    if "fit" in stored.metadata:
        stderr.print(describe_fit(stored.metadata["fit"]), markup=False, highlight=False, soft_wrap=True)
    usual = _ITERATIONS if architecture is None else _BEHIND_NETWORK
    config = SimConfig(
        model=architecture,
        iterations=usual if iterations is None else iterations,
        tolerance=0.0 if choice is None else choice.tolerance,
    )
    pace = None if choice is None or budget_ms is None else keep_budget(choice, budget_ms)
    with progress("simulating", scene.num_frames - 1) as advance:
        trajectory, timing, scene = run_simulation(params, scene, config=config, pace=pace, on_frames=advance)
    trajectory, scene = last_frames(trajectory, scene, poses.positions.shape[0])
    if budget_ms is not None and timing.frame_ms > _KEPT * budget_ms:
        text = (
            f"missed --budget {budget}: a frame took {timing.frame_ms:.1f} ms; eslr info --scene tells what the "
            "scene costs, eslr calibrate what this machine can do"
        )
        stderr.print(text, markup=False, highlight=False, soft_wrap=True)
    with stderr.status("measuring"):
        report = {
            "garment": garment,
            "fabric": list(fabric or stored.metadata.get("fabrics", ())) or ["cotton"],
            "motion": motion,
            "simulator": simulator,
            "model": model,
            "self_contact": self_contact,
            **trajectory_report(trajectory, scene),
            "choice": None if choice is None else dataclasses.asdict(choice),
            "frame_ms": timing.frame_ms,
            "compile_s": timing.compile_s,
            **environment(),
        }
    with stderr.status("writing files"):
        with atomic_write(out / "report.json") as temporary:
            temporary.write_text(json.dumps(report, indent=2))
        write_garment_npz(out / "garment.npz", stored)
        _write_motion(out, trajectory, scene, rig, poses, stored)
    if pictures:
        _write_sheet(out, np.asarray(trajectory.positions), cloth, poses)
    if json_:
        print(json.dumps(report, indent=2))
    else:
        _print_report(report, out)


class _Actor(NamedTuple):
    """What the command line says of body and motion."""

    body: str
    motion: str | None
    frames: int | None
    joint_map: Path | None
    up: Literal["auto", "y", "z"]
    arm_abduction: float | None
    fps: float | None
    units: str | None
    betas: tuple[float, ...]
    start: str | None
    loop: str | None


def _load_actor(actor: _Actor) -> tuple[Any, Any, str]:
    """Load a body and set it in motion; return both, and the name of the motion."""
    from eslr_jax.assets import load_body, load_motion
    from eslr_jax.assets.load import own_motion
    from eslr_jax.body.joints import read_joint_map
    from eslr_jax.body.motion import pose_body
    from eslr_jax.body.sequence import pose_sequence
    from eslr_jax.body.timing import cut_start, loop_motion
    from eslr_jax.cli.moment import parse_seconds
    from eslr_jax.io.mesh_sequence import is_mesh_sequence, read_mesh_sequence

    body = actor.body
    if Path(body).exists() and is_mesh_sequence(body):
        given = {"--motion": actor.motion, "--start": actor.start, "--loop": actor.loop}
        for option, value in given.items():
            if value is not None:
                raise ConfigError(f"{body} is a mesh in motion and follows no other; leave out {option}")
        sequence = read_mesh_sequence(body, fps=actor.fps)
        return *pose_sequence(sequence, num_frames=actor.frames, units=actor.units), body
    if actor.fps is not None:
        raise ConfigError(f"--body-fps is for bodies that are moving meshes, which {body} is not")
    rig = load_body(body, units=actor.units, betas=actor.betas)
    motion = actor.motion or own_motion(body)
    changes = None if actor.joint_map is None else read_joint_map(actor.joint_map)
    clip = load_motion(motion, body=rig, joint_map=changes, up=actor.up)
    if actor.start is not None:
        clip = cut_start(clip, parse_seconds(actor.start, _FPS, option="--start"))
    if actor.loop is not None:
        clip = loop_motion(clip, parse_seconds(actor.loop, _FPS, option="--loop"))
    return rig, pose_body(rig, clip, num_frames=actor.frames, arm_abduction=actor.arm_abduction), motion


def _check_skin(garment: str, cloth, rig, body: str) -> None:
    """Refuse a garment that hangs on the joints of another body."""
    import numpy as np

    from eslr_jax.assets import asset_names, load_body

    is_bundled = garment in asset_names("garment") or f"{garment}_1k" in asset_names("garment")
    if is_bundled and rig.joint_names != load_body().joint_names:
        raise ConfigError(
            f"garment {garment} hangs on the bundled body; for {body} give a mesh file (obj, ply, stl, glb), "
            "which is fitted to it"
        )
    if int(np.asarray(cloth.skin_indices).max()) >= len(rig.joint_names):
        raise ConfigError(f"{garment} was fitted to another body; give the mesh it was fitted from")


def _write_motion(out: Path, trajectory, scene, rig, poses, stored) -> None:
    """Write the trajectory and the animated GLB."""
    import jax
    import numpy as np

    from eslr_jax.io.export import export_trajectory
    from eslr_jax.io.skin import Skin
    from eslr_jax.io.trajectory import BodyTrack, TrajectoryFile, write_trajectory

    contact_faces, contact_boundary = np.empty((0, 3), np.int32), np.empty(0, np.int32)
    if scene.body is not None:
        surface = scene.body.surface
        vertex_ids = np.asarray(surface.vertex_ids)
        contact_faces = vertex_ids[np.asarray(surface.faces)]
        contact_boundary = vertex_ids[np.asarray(surface.is_boundary)]
    skin = Skin(
        skin_weights=np.asarray(rig.skin_weights),
        skin_indices=np.asarray(rig.skin_indices),
        joint_transforms=np.asarray(poses.joint_transforms),
        joint_rest_positions=np.asarray(rig.joint_rest_positions),
        parents=rig.parents,
        joint_names=rig.joint_names,
    )
    body = BodyTrack(
        positions=np.asarray(poses.positions),
        faces=np.asarray(poses.faces),
        rest_positions=np.asarray(poses.rest_positions),
        contact_faces=contact_faces,
        contact_boundary=contact_boundary,
        skin=skin,
    )
    file = TrajectoryFile(
        positions=np.asarray(trajectory.positions),
        velocities=np.asarray(trajectory.velocities),
        faces=np.asarray(scene.garment.faces),
        timestep=float(poses.timestep),
        body=body,
        friction_loads=np.asarray(trajectory.friction_loads),
        material=jax.tree.map(lambda leaf: np.asarray(leaf, np.float32), scene.material),
    )
    write_trajectory(out / "trajectory.npz", file)
    export_trajectory(file, out / "animation.glb", garment=stored)


def _write_sheet(out: Path, positions, cloth, poses) -> None:
    """Render the contact sheet; without the extra `render` say so and go on."""
    import numpy as np

    from eslr_jax.render import contact_sheet, write_png

    try:
        with progress("rendering", 8) as advance:
            sheet = contact_sheet(
                np.asarray(poses.positions),
                np.asarray(poses.faces),
                positions,
                np.asarray(cloth.faces),
                rest_positions=np.asarray(poses.rest_positions),
                timestep=float(poses.timestep),
                on_picture=advance,
            )
    except MissingExtraError as error:
        stderr.print(f"no pictures: {error}", markup=False, highlight=False, soft_wrap=True)
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
