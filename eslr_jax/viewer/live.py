"""A page on which cloth moves while it is simulated, and follows what one changes."""

from __future__ import annotations

import dataclasses
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from eslr_jax.assets import asset_names, load_body, load_garment_file, load_motion, prepare_stored
from eslr_jax.body.motion import pose_body
from eslr_jax.errors import EslrError, Status
from eslr_jax.extras import require
from eslr_jax.io.garment import GarmentFile
from eslr_jax.io.run import ClothTrack, write_run
from eslr_jax.physics.materials import fabric_material, fabric_names
from eslr_jax.render.pictures import BODY_COLOR, GARMENT_COLOR
from eslr_jax.scene.plan import ground_height
from eslr_jax.simulation.live import (
    MOST_ITERATIONS,
    TOLERANCE,
    Hand,
    Stage,
    advance,
    changed,
    grasp,
    nearest_vertex,
    no_hand,
    set_stage,
    there_and_back,
)
from eslr_jax.types import Body, BodyMotion, ClothState, Material
from eslr_jax.viewer.page import byte_color

FACTORS = (0.1, 10.0)  # of a fabric's constants
_FEWEST = 5  # iterations, with which cloth holds together
_SHOWN = 10  # frames over which times are averaged
_STRONGEST = 12.0  # [m/s], of the wind


@dataclasses.dataclass(frozen=True)
class Choice:
    """What is on stage."""

    garment: str
    vertices: str
    motion: str


@dataclasses.dataclass(frozen=True)
class Cast:
    """What a choice loads."""

    choice: Choice
    rig: Body
    stored: GarmentFile
    poses: BodyMotion
    ground: float  # height of the lowest point of the moving body [m]
    stage: Stage


@dataclasses.dataclass
class Live:
    """A page and the simulation behind it; one thread steps it, and the controls are read every frame."""

    server: Any  # viser.ViserServer
    controls: dict[str, Any]
    out: Path  # folder of recordings
    cast: Cast | None = None
    state: ClothState | None = None
    step: int = 0  # since the cloth was put on
    iterations: int = MOST_ITERATIONS  # at most, of the next frame
    times: list[float] = dataclasses.field(default_factory=list)  # of the last frames [s]
    held: int | None = None  # vertex in the hand
    recorded: list[tuple[int, ClothState]] = dataclasses.field(default_factory=list)
    asked: threading.Event = dataclasses.field(default_factory=threading.Event)  # for one step

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://localhost:{self.server.get_port()}"


def open_live(choice: Choice, *, out: Path, host: str = "127.0.0.1", port: int = 8080) -> Live:
    """Serve a page on which cloth moves while it is simulated; `run_live` simulates.

    Args:
        choice: What is on stage first.
        out: Folder that recordings are written to.
        host: Address to listen on; only this machine by default.
        port: Port, or the next free one.

    Raises:
        MissingExtraError: The extra `view` is not installed.
    """
    viser = require("viser", extra="view")
    server = viser.ViserServer(host=host, port=port, verbose=False)
    gui = server.gui
    garments = sorted({name.rpartition("_")[0] for name in asset_names("garment")})
    controls: dict[str, Any] = {"status": gui.add_markdown("loading")}
    with gui.add_folder("scene"):
        controls |= {
            "garment": gui.add_dropdown(
                "garment", _with(garments, choice.garment), initial_value=choice.garment
            ),
            "vertices": gui.add_dropdown("vertices", ("1k", "4k", "10k"), initial_value=choice.vertices),
            "motion": gui.add_dropdown(
                "motion", _with(sorted(asset_names("motion")), choice.motion), initial_value=choice.motion
            ),
        }
    with gui.add_folder("fabric"):
        controls["fabric"] = gui.add_dropdown("fabric", fabric_names(), initial_value="cotton")
        for name in ("density", "stretch", "bending"):  # powers of ten
            controls[name] = gui.add_slider(f"{name}, 10^", *np.log10(FACTORS).tolist(), 0.05, 0.0)
    with gui.add_folder("wind"):
        controls["wind"] = gui.add_slider("speed [m/s]", 0.0, _STRONGEST, 0.1, 0.0)
        controls["direction"] = gui.add_slider("direction [degrees]", -180.0, 180.0, 5.0, 0.0)
    with gui.add_folder("time"):
        controls |= {
            "playing": gui.add_checkbox("play", True),
            "keep_up": gui.add_checkbox("keep up with real time", True),
            "single": gui.add_button("one frame"),
            "restart": gui.add_button("restart"),
            "let_go": gui.add_button("let go", visible=False),
            "record": gui.add_checkbox("record", False),
        }
    server.scene.set_up_direction("+y")
    server.scene.add_grid("/floor", width=4.0, height=4.0, plane="xz", cell_size=0.25)
    server.initial_camera.position = (0.0, 1.3, 3.2)
    server.initial_camera.look_at = (0.0, 0.95, 0.0)
    server.initial_camera.up = (0.0, 1.0, 0.0)
    live = Live(server, controls, Path(out))
    controls["single"].on_click(lambda _: live.asked.set())
    controls["restart"].on_click(lambda _: _restart(live))
    controls["let_go"].on_click(lambda _: _let_go(live))
    return live


def run_live(
    live: Live, *, until: threading.Event | None = None, on_frame: Callable[[], None] = lambda: None
) -> None:
    """Simulate and show frame after frame, and follow the controls; return when `until` is set.

    Args:
        live: Of `open_live`.
        until: Ends it.
        on_frame: Called after every frame.
    """
    until = until or threading.Event()
    while not until.is_set():
        began = time.perf_counter()
        try:
            is_moved = one_frame(live)
        except EslrError as error:
            live.controls["playing"].value = False
            live.controls["status"].content = f"**{error}**"
            is_moved = False
        if is_moved:
            on_frame()
        timestep = 1 / 30 if live.cast is None else float(live.cast.poses.timestep)
        until.wait(max(timestep - (time.perf_counter() - began), 0.002))


def one_frame(live: Live) -> bool:
    """Follow the controls and, if the simulation plays, simulate and show a frame; return whether it did.

    Raises:
        EslrError: What is chosen does not load, or the body is too fast.
    """
    choice = Choice(*(live.controls[name].value for name in ("garment", "vertices", "motion")))
    if live.cast is None or live.cast.choice != choice:
        _load(live, choice)
    cast = live.cast
    assert cast is not None
    if not live.controls["record"].value and live.recorded:
        _save(live, cast)
    if not (live.controls["playing"].value or live.asked.is_set()):
        return False
    live.asked.clear()
    if live.state is None:
        live.state, live.step = cast.stage.scene.initial_state, 0
        live.controls["status"].content = f"compiling {choice.garment} of {choice.vertices} vertices"
    began = time.perf_counter()
    frames = there_and_back(live.step, cast.stage.scene.num_frames)
    stage = changed(cast.stage, _fabric(live), _wind(live), _hand(live))
    step = jax.block_until_ready(advance(stage, live.state, frames, live.iterations))
    took = time.perf_counter() - began
    status = Status(int(step.state.status))
    if status != Status.OK:
        _restart(live)
        live.controls["status"].content = f"put on anew: {status.describe()}"
        return False
    live.state, live.step = step.state, live.step + 1
    live.times = [*live.times[-_SHOWN + 1 :], took]
    if live.controls["record"].value:
        live.recorded.append((frames[1], jax.tree.map(np.asarray, step.state)))
    _show(live, cast, frames[1])
    _tell(live, cast, int(step.report.iterations))
    return True


def _load(live: Live, choice: Choice) -> None:
    """Put what is chosen on stage."""
    live.controls["status"].content = f"loading {choice.garment} and {choice.motion}"
    rig = load_body()
    poses = pose_body(rig, load_motion(choice.motion, body=rig))
    stored = load_garment_file(choice.garment, vertices=choice.vertices, body=rig)  # type: ignore[arg-type]
    cloth = prepare_stored(stored, name=Path(choice.garment).name)
    _let_go(live)
    ground = float(ground_height(poses))
    live.cast = Cast(choice, rig, stored, poses, ground, set_stage(cloth, poses, _fabric(live)))
    live.recorded = []
    _restart(live)
    scene, first = live.server.scene, np.asarray(live.cast.stage.scene.initial_state.position)
    scene.add_mesh_simple(
        "/body", np.asarray(poses.positions[0]), np.asarray(poses.faces), color=byte_color(BODY_COLOR)
    )
    garment = scene.add_mesh_simple(
        "/garment", first, np.asarray(cloth.faces), color=byte_color(GARMENT_COLOR), side="double"
    )
    garment.on_click(lambda event: _take_hold(live, event.ray_origin, event.ray_direction))
    live.controls["meshes"] = (scene.get_handle_by_name("/body"), garment)


def _restart(live: Live) -> None:
    """Put the garment on again at the motion's first frame."""
    live.state, live.times, live.iterations = None, [], MOST_ITERATIONS


def _show(live: Live, cast: Cast, frame: int) -> None:
    """Show the cloth, and the body at a frame, which walks on the spot."""
    body = np.asarray(cast.poses.positions[frame])
    assert live.state is not None
    place = _place(cast, frame)
    shown, garment = live.controls["meshes"]
    with live.server.atomic():
        shown.vertices = (body - place).astype(np.float32)
        garment.vertices = (np.asarray(live.state.position) - place).astype(np.float32)


def _place(cast: Cast, frame: int) -> np.ndarray:
    """Return the place under the body on the ground [m]; on the page it is the origin."""
    middle = np.asarray(cast.poses.positions[frame]).mean(axis=0)
    return np.array([middle[0], cast.ground, middle[2]])


def _tell(live: Live, cast: Cast, iterations: int) -> None:
    """Say how fast it goes and how exact it is, and fit the iterations to the time that there is."""
    took, timestep = float(np.median(live.times)), float(cast.poses.timestep)
    if live.controls["keep_up"].value:
        share = timestep / took
        wanted = 0.9 * share * live.iterations if share < 1.0 else 1.1 * live.iterations + 1.0
        live.iterations = int(np.clip(wanted, _FEWEST, MOST_ITERATIONS))
    else:
        live.iterations = MOST_ITERATIONS
    is_exact = iterations < live.iterations
    exact = f"within {100 * TOLERANCE:g} % of the optimum" if is_exact else "stopped before the tolerance"
    speed = "in real time" if took <= timestep else f"at {timestep / took:.2f} of real time"
    live.controls[
        "status"
    ].content = f"{1e3 * took:.0f} ms a frame, {speed}; {iterations} iterations, {exact}"


def _fabric(live: Live) -> Material:
    """Return the fabric that the controls ask for."""
    fabric = fabric_material(live.controls["fabric"].value)
    density, stretch, bending = (
        10.0 ** live.controls[name].value for name in ("density", "stretch", "bending")
    )
    return fabric.replace(
        density=np.float32(fabric.density * density),
        lame_mu=np.float32(fabric.lame_mu * stretch),
        lame_lambda=np.float32(fabric.lame_lambda * stretch),
        bending_stiffness=np.float32(fabric.bending_stiffness * bending),
        thickness=np.float32(fabric.thickness),
    )


def _wind(live: Live) -> tuple[float, float, float]:
    """Return the wind that the controls ask for [m/s]; at zero degrees it blows along z."""
    angle, speed = np.deg2rad(live.controls["direction"].value), live.controls["wind"].value
    return float(speed * np.sin(angle)), 0.0, float(speed * np.cos(angle))


def _take_hold(live: Live, origin: Any, direction: Any) -> None:
    """Take the vertex that was clicked on, with a handle to drag it by."""
    if live.cast is None or live.state is None:
        return
    _, frame = there_and_back(live.step - 1, live.cast.stage.scene.num_frames)
    positions = np.asarray(live.state.position) - _place(live.cast, frame)
    live.held = nearest_vertex(positions, origin, direction)
    handle = live.server.scene.add_transform_controls(
        "/hand", scale=0.15, disable_rotations=True, position=positions[live.held]
    )
    live.controls["hand"] = handle
    live.controls["let_go"].visible = True


def _let_go(live: Live) -> None:
    """Let go of the cloth."""
    live.held = None
    live.controls["let_go"].visible = False
    handle = live.controls.pop("hand", None)
    if handle is not None:
        handle.remove()


def _hand(live: Live) -> Hand:
    """Return what holds the cloth."""
    handle, held, cast = live.controls.get("hand"), live.held, live.cast
    if handle is None or held is None or cast is None:
        return no_hand()
    _, frame = there_and_back(live.step, cast.stage.scene.num_frames)
    return grasp(held, np.asarray(handle.position) + _place(cast, frame))


def _save(live: Live, cast: Cast) -> None:
    """Write what was recorded as a run, and hand its animation to whoever watches."""
    frames = np.array([frame for frame, _ in live.recorded])
    states = [state for _, state in live.recorded]
    live.recorded = []
    if len(frames) < 2:
        return
    live.controls["status"].content = f"writing {len(frames)} frames to {live.out}"
    poses = cast.poses.replace(
        positions=cast.poses.positions[frames], joint_transforms=cast.poses.joint_transforms[frames]
    )
    track = ClothTrack(
        *(
            np.stack([getattr(state, name) for state in states])
            for name in ("position", "velocity", "friction_load")
        )
    )
    scene = cast.stage.scene.replace(material=_fabric(live))
    report = {
        "garment": cast.choice.garment,
        "motion": cast.choice.motion,
        "integrator": "bdf2",
        "skin_contacts": True,
        "wind_m_s": _wind(live),
    }
    write_run(live.out, track, scene, (cast.rig, poses, cast.stored), report=report)
    data = (live.out / "animation.glb").read_bytes()
    for client in live.server.get_clients().values():
        client.send_file_download("animation.glb", data, save_immediately=True)


def _with(names: list[str], name: str) -> tuple[str, ...]:
    """Return names with one more in front, such as a file's, if it is not among them."""
    return tuple(names) if name in names else (name, *names)
