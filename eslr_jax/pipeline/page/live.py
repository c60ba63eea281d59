"""A page on which cloth moves while it is simulated, and follows what one changes."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from eslr_jax.errors import EslrError, Status
from eslr_jax.pipeline.assets import load_body, load_garment_file, load_motion, prepare_stored
from eslr_jax.pipeline.assets.garments import warn_of_fit
from eslr_jax.pipeline.dressing.outfit import wear_together
from eslr_jax.pipeline.extras import require
from eslr_jax.pipeline.formats.garment import GarmentFile
from eslr_jax.pipeline.formats.palette import byte_color
from eslr_jax.pipeline.page.live_controls import (
    Choice,
    add_controls,
    describe_fabric,
    read_choice,
    read_fabric,
    read_wind,
)
from eslr_jax.pipeline.page.stage import (
    MOST_ITERATIONS,
    Stage,
    advance,
    changed,
    enlarged,
    grasp,
    nearest_vertex,
    no_hand,
    set_stage,
)
from eslr_jax.pipeline.report.report import describe_model
from eslr_jax.pipeline.report.run import ClothTrack, write_run
from eslr_jax.pipeline.rigs.clothing import Piece, body_pieces, garment_pieces
from eslr_jax.pose.motion import lowest_point, pose_body, there_and_back
from eslr_jax.pose.timing import SETTLE_FRAMES, with_settling
from eslr_jax.simulation.scene import slice_tracks
from eslr_jax.simulation.stepper import FrameReport, keeps_tolerance
from eslr_jax.types import Body, BodyMotion, ClothState, Material

MOST_RECORDED = 1800  # frames: a minute
_FEWEST = 15  # iterations: fewer save little time, and cloth lags behind the body
_SHOWN = 10  # frames over which times are averaged
_PAGE = 0.003  # [s] of a frame that the page's own thread gets; without it the page falls behind
_PATIENCE = 0.4  # [s] for which a choice must stand before it is loaded: a slider passes many


@dataclasses.dataclass(frozen=True)
class Cast:
    """What a choice loads."""

    choice: Choice
    rig: Body
    stored: GarmentFile
    poses: BodyMotion
    spots: np.ndarray  # under the body, on the ground, in every frame [m]
    stage: Stage
    drawn: list[tuple[Piece, Any]]  # of the garments, with their meshes on the page
    drawn_body: list[tuple[Piece, Any]]

    def frames(self, step: int) -> tuple[int, int]:
        """Return the two frames of the motion that a step goes from and to; the garment is put on once."""
        return there_and_back(step, self.stage.scene.num_frames, SETTLE_FRAMES)


class Recorded(NamedTuple):
    """A frame of a recording; NumPy arrays."""

    frame: int  # of the body's motion
    state: ClothState
    residual: np.ndarray  # see `Trajectory`
    is_held: bool  # a hand pulled at the cloth


@dataclasses.dataclass
class Live:
    """A page and the simulation behind it; one thread steps it, and the controls are read every frame."""

    server: Any  # viser.ViserServer
    controls: dict[str, Any]
    body: str  # name or file
    out: Path  # folder of recordings, which have a numbered folder each
    cast: Cast | None = None
    wanted: tuple[Choice | None, float] = (None, 0.0)  # the last choice that was seen, and since when [s]
    refused: Choice | None = None  # what did not load
    state: ClothState | None = None
    step: int = 0  # since the cloth was put on
    iterations: int = MOST_ITERATIONS  # at most, of the next frame
    times: list[float] = dataclasses.field(default_factory=list)  # of the last frames [s]
    is_compiled: bool = False
    held: int | None = None  # vertex in the hand
    recorded: list[Recorded] = dataclasses.field(default_factory=list)
    setting: tuple[Material, tuple[float, float, float]] | None = None  # fabric, wind [m/s] of the recording
    asked: threading.Event = dataclasses.field(default_factory=threading.Event)  # for one step
    anew: threading.Event = dataclasses.field(default_factory=threading.Event)  # for a new start

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://localhost:{self.server.get_port()}"


def open_live(choice: Choice, *, out: Path, host: str = "127.0.0.1", port: int = 8080) -> Live:
    """Serve a page on which cloth moves while it is simulated; `run_live` simulates.

    A choice is on stage first. Recordings are written to `out`, in the folders 1, 2, and so on. By default only
    this machine sees the page, at a port or the next free one.

    Raises:
        AssetError: There is no such body.
        ConfigError: It has fewer shapes than `choice` gives.
        MissingExtraError: The extra `view` is not installed.
    """
    viser = require("viser", extra="view")
    num_shapes = load_body(choice.body, betas=choice.betas).shape_directions.shape[-1]
    server = viser.ViserServer(host=host, port=port, verbose=False)
    server.gui.configure_theme(show_logo=False, show_share_button=False, control_layout="fixed")
    server.gui.set_panel_label("eslr play")
    controls = add_controls(server.gui, choice, num_shapes)
    server.scene.set_up_direction("+y")
    server.scene.add_grid("/floor", width=4.0, height=4.0, plane="xz", cell_size=0.25)
    server.initial_camera.position = (1.2, 1.3, 3.6)
    server.initial_camera.look_at = (0.0, 0.9, 0.0)
    server.initial_camera.fov = np.deg2rad(40.0)
    server.initial_camera.up = (0.0, 1.0, 0.0)
    live = Live(server, controls, choice.body, Path(out).expanduser())

    @controls["playing"].on_update
    def offer_single_frames(_: Any) -> None:
        controls["single"].visible = not controls["playing"].value

    controls["single"].on_click(lambda _: live.asked.set())
    controls["restart"].on_click(lambda _: restart(live))
    controls["let_go"].on_click(lambda _: let_go(live))
    return live


def run_live(
    live: Live, *, until: threading.Event | None = None, on_frame: Callable[[], None] = lambda: None
) -> None:
    """Simulate and show frame after frame, and follow the controls; return when `until` is set."""
    until = until or threading.Event()
    due = time.perf_counter()
    try:
        while not until.is_set():
            choice = read_choice(live.controls, live.body)
            try:
                is_moved = _one_frame(live, choice)
            except EslrError as error:
                live.refused = choice  # not what the controls say by now
                live.controls["status"].content = f"**{error}**"
                is_moved = False
            if is_moved:
                on_frame()
            timestep = 1 / 30 if live.cast is None else float(live.cast.poses.timestep)
            # Due a timestep after the last frame was, not after it began: waits that last too long would add up.
            now = time.perf_counter()
            due = max(due + timestep, now)
            until.wait(max(due - now, 0.5 * _PAGE))
    finally:
        if live.recorded:  # Ctrl-C ends a recording, and does not lose it
            _save(live)


def _one_frame(live: Live, choice: Choice) -> bool:
    """Follow the controls and, if the simulation plays, simulate and show a frame; return whether it did."""
    if choice != live.refused:
        live.refused = None  # chosen once more, it is tried and told once more
    is_due, is_anew = _is_due(live, choice), live.anew.is_set()
    setting = fabric, wind = read_fabric(live.controls), read_wind(live.controls)
    if live.recorded:
        is_over = not live.controls["record"].value or len(live.recorded) >= MOST_RECORDED
        # A run has one garment, body, motion, fabric and wind, and puts the garment on once.
        is_another = is_due or jax.tree.leaves(setting) != jax.tree.leaves(live.setting)
        if is_over or is_another or is_anew:
            live.controls["record"].value = False
            _save(live)
    if is_due:
        _load(live, choice)
    cast, is_asked = live.cast, live.controls["playing"].value or live.asked.is_set()
    if cast is None or choice == live.refused or not is_asked:
        return False
    live.asked.clear()
    if live.state is None or is_anew:
        live.anew.clear()
        live.state, live.step = cast.stage.scene.initial_state, 0
        live.times, live.iterations = [], MOST_ITERATIONS
    began = time.perf_counter()
    before, frame = cast.frames(live.step)
    compiling = _busy(live, "compiling, which is kept for the next time")
    with contextlib.nullcontext() if live.is_compiled else compiling:
        handle, held, hand = live.controls.get("hand"), live.held, no_hand()
        if handle is not None and held is not None:
            hand = grasp(held, np.asarray(handle.position) + cast.spots[frame])
        stage = changed(cast.stage, fabric, wind, hand)
        tolerance = 0.01 * float(live.controls["tolerance"].value)  # of the gap that a frame begins with
        stepped = advance(stage, live.state, (before, frame), live.iterations, tolerance)
        state, report = jax.block_until_ready(stepped)
    if (larger := enlarged(cast.stage, report)) is not None:  # the same frame once more
        live.cast, live.is_compiled = dataclasses.replace(cast, stage=larger), False
        return False
    status = Status(int(state.status))
    if status != Status.OK:
        restart(live)
        live.controls["status"].content = f"put on anew: {status.describe()}"
        return False
    live.state, live.step = state, live.step + 1
    if live.controls["record"].value:
        kept = jax.tree.map(np.asarray, (state, report.residual))
        live.recorded.append(Recorded(frame, *kept, is_held="hand" in live.controls))
        live.setting = setting
    # The body walks on the spot.
    body = np.asarray(cast.poses.positions[frame]) - cast.spots[frame]
    cloth = np.asarray(state.position) - cast.spots[frame]
    with live.server.atomic():
        for piece, mesh in cast.drawn_body:
            mesh.vertices = piece.place(body)
        for piece, mesh in cast.drawn:
            mesh.vertices = piece.place(cloth)
    if live.is_compiled:
        live.times = [*live.times[-_SHOWN + 1 :], time.perf_counter() - began]
    live.is_compiled = True
    live.controls["constants"].content = describe_fabric(fabric)
    if live.times:
        _tell(live, cast, report, tolerance)
    return True


def _is_due(live: Live, choice: Choice) -> bool:
    """Return whether a choice is to be loaded: it is new, and has stood for a while."""
    if choice == live.refused or (live.cast is not None and live.cast.choice == choice):
        live.wanted = (None, 0.0)
        return False
    if live.cast is None:
        return True
    if live.wanted[0] != choice:
        live.wanted = (choice, time.monotonic())
    return time.monotonic() - live.wanted[1] > _PATIENCE


@contextlib.contextmanager
def _busy(live: Live, text: str) -> Iterator[None]:
    """Say on the page what is done, and for how many seconds already."""
    end, began = threading.Event(), time.monotonic()

    def tick() -> None:
        while not end.wait(0.5):
            live.controls["status"].content = f"{text}: {time.monotonic() - began:.0f} s"

    live.controls["status"].content = text
    thread = threading.Thread(target=tick, daemon=True)
    thread.start()
    try:
        yield
    finally:
        end.set()
        thread.join()


def _load(live: Live, choice: Choice) -> None:
    live.refused = choice  # until it is there
    with _busy(live, f"preparing {' and '.join(choice.garments)} on {choice.motion}"):
        rig = load_body(choice.body, betas=choice.betas)
        poses = with_settling(pose_body(rig, load_motion(choice.motion, body=rig)), SETTLE_FRAMES, rig)
        spots, drawn_body = np.array(poses.positions).mean(axis=1), []
        spots[:, 1] = lowest_point(poses)
        body = body_pieces(np.asarray(poses.rest_positions), np.asarray(poses.faces), rig)
        standing = np.asarray(poses.positions[0]) - spots[0]
        if live.cast is None:  # there is something to see while the rest loads
            drawn_body = _draw(live, "/body", body, standing)
        # A shape of the body is tried once: its garments are not kept on disk.
        garments = [
            load_garment_file(name, vertices=choice.vertices, body=rig, cache=not choice.betas)  # type: ignore[arg-type]
            for name in choice.garments
        ]
        for name, worn in zip(choice.garments, garments, strict=True):
            warn_of_fit(name, worn)
        stored = wear_together(garments, choice.garments)
        cloth = prepare_stored(stored, name="+".join(Path(name).name for name in choice.garments))
        stage = set_stage(cloth, poses, read_fabric(live.controls))
    let_go(live)
    if live.cast is not None:
        for _, mesh in (*live.cast.drawn, *live.cast.drawn_body):
            mesh.remove()
        drawn_body = _draw(live, "/body", body, standing)
    pieces = garment_pieces(np.asarray(cloth.faces), stored.outfit)
    drawn = _draw(live, "/garments", pieces, np.asarray(stage.scene.initial_state.position) - spots[0])
    for _, mesh in drawn:
        mesh.on_click(lambda event: take_hold(live, event.ray_origin, event.ray_direction))
    live.is_compiled, live.refused, live.state = False, None, None
    live.cast = Cast(choice, rig, stored, poses, spots, stage, drawn, drawn_body)


def _draw(live: Live, folder: str, pieces: list[Piece], positions: np.ndarray) -> list[tuple[Piece, Any]]:
    """Draw the pieces of a garment or a body, given where the whole is [m]; return them with their meshes."""
    drawn = []
    for number, piece in enumerate(pieces):
        name, color = f"{folder}/{number}", byte_color(piece.color)
        place = piece.place(positions)
        mesh = live.server.scene.add_mesh_simple(name, place, piece.faces, color=color, side="double")
        drawn.append((piece, mesh))
    return drawn


def restart(live: Live) -> None:
    """Let the next frame put the garment on again at the motion's first frame."""
    live.anew.set()


def next_iterations(iterations: int, took: float, timestep: float) -> int:
    """Return how many iterations the next frame gets at most, to keep up with real time.

    The frames before had `iterations` at most, and took [s] of the timestep [s].
    """
    share = (timestep - _PAGE) / took
    wanted = 0.9 * share * iterations if share < 1.0 else 1.1 * iterations + 1.0
    return int(np.clip(wanted, _FEWEST, MOST_ITERATIONS))


def _tell(live: Live, cast: Cast, report: FrameReport, tolerance: float) -> None:
    """Say how fast it goes and how exact it is, and fit the iterations to the time that there is."""
    iterations, bound = int(report.iterations), float(report.gap_bound)
    took, timestep = float(np.median(live.times)), float(cast.poses.timestep)
    keeps_up = live.controls["keep_up"].value
    live.iterations = next_iterations(live.iterations, took, timestep) if keeps_up else MOST_ITERATIONS
    exact = (
        f"within a gap of {100 * tolerance:.3g} %"
        if keeps_tolerance(report.gap_bound, report.residual, tolerance)
        else "stopped before the tolerance"
    )
    speed = "in real time" if took <= timestep else f"at {timestep / took:.2f} of real time"
    figures = f"{1e3 * took:.0f} ms a frame, {iterations} iterations, gap below {100 * bound:.2g} %: {exact}"
    live.controls["status"].content = f"**{speed}**\n\n{figures}"


def take_hold(live: Live, origin: Any, direction: Any) -> None:
    """Take the vertex nearest to a ray of the page, with a handle to drag it by."""
    if live.cast is None or live.state is None:
        return
    _, frame = live.cast.frames(live.step - 1)
    positions = np.asarray(live.state.position) - live.cast.spots[frame]
    live.held = nearest_vertex(positions, origin, direction)
    handle = live.server.scene.add_transform_controls(
        "/hand", scale=0.15, disable_rotations=True, position=positions[live.held]
    )
    live.controls["hand"] = handle
    live.controls["let_go"].visible = True


def let_go(live: Live) -> None:
    """Let go of the cloth."""
    live.held = None
    live.controls["let_go"].visible = False
    handle = live.controls.pop("hand", None)
    if handle is not None:
        handle.remove()


def _save(live: Live) -> None:
    """Write what was recorded as a run in a folder of its own, and hand its animation to whoever watches."""
    assert live.cast is not None
    assert live.setting is not None
    cast, (fabric, wind) = live.cast, live.setting
    recorded, live.recorded = live.recorded, []
    if len(recorded) < 2:
        return
    frames = np.array([one.frame for one in recorded])
    folders = (live.out / str(number) for number in itertools.count(1))
    folder = next(folder for folder in folders if not folder.exists())
    live.controls["status"].content = f"writing {len(frames)} frames to {folder}"
    poses = cast.poses.replace(
        positions=cast.poses.positions[frames], joint_transforms=cast.poses.joint_transforms[frames]
    )
    states, residuals = jax.tree.map(
        lambda *leaves: np.stack(leaves), *((one.state, one.residual) for one in recorded)
    )
    track = ClothTrack(states.position, states.velocity, states.friction_load, residuals)
    constant = changed(cast.stage, fabric, wind, no_hand()).constant
    tracks = slice_tracks(cast.stage.scene, jnp.asarray(frames))
    scene = constant.replace(
        body=tracks.body,
        pin_targets=tracks.pin_targets,
        initial_state=recorded[0].state,
        num_frames=len(frames),
        terms=constant.terms[:-1],  # without the hand
    )
    is_held = any(one.is_held for one in recorded)
    report = {
        "garment": "+".join(cast.choice.garments),
        "motion": cast.choice.motion,
        **describe_model(scene),
        "wind_m_s": wind,
    }
    try:
        # No scene has a hand that moves.
        write_run(folder, track, None if is_held else scene, (cast.rig, poses, cast.stored), report=report)
    except EslrError as error:  # the cloth goes on
        for client in live.server.get_clients().values():
            client.add_notification("The recording was not written", str(error))
        return
    data = (folder / "animation.glb").read_bytes()
    for client in live.server.get_clients().values():
        client.add_notification("Recorded", f"{len(frames)} frames are in {folder}")
        client.send_file_download("animation.glb", data, save_immediately=True)
