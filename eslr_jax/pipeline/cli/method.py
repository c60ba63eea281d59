"""What the options of `eslr simulate` choose: who moves, how a frame is solved, and what that costs."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from eslr_jax.errors import ConfigError
from eslr_jax.pipeline.cli.options import Options, parse_budget, parse_seconds, parse_share, refuse_given

if TYPE_CHECKING:
    from eslr_jax.config import SimConfig
    from eslr_jax.networks.network import Network
    from eslr_jax.types import Body, BodyMotion

FPS = 30.0  # of the simulation
BEHIND_NETWORK = 10  # iterations of the solver after a network
# Of a frame at 1k with a tolerance of 1 %, in the median; as many more for every tenth of it.
_ITERATIONS = 43
# Peak memory of whole runs of 1,920 and 31,200 vertices over 6 and 60 frames, of the solver and smooth-small.
_BASE_GB = 1.7
_VERTEX_BYTES = 1e4
_FRAME_BYTES = 240


class Actor(NamedTuple):
    """A body, and how it moves."""

    rig: Body
    poses: BodyMotion
    motion: str  # its name
    start: float  # time of the first frame in the motion's file [s]


def is_moving_mesh(body: str) -> bool:
    """Tell a mesh in motion from a rigged body; a folder that has the name of a bundled body is none."""
    from eslr_jax.files.parsing import split_name
    from eslr_jax.pipeline.assets import asset_names
    from eslr_jax.pipeline.formats.mesh_sequence import is_mesh_sequence

    path = body if Path(body).exists() else split_name(body)[0]
    return Path(path).exists() and body not in asset_names("body") and is_mesh_sequence(path)


def load_wearer(body: str, *, units: str | None = None, betas: tuple[float, ...] = ()) -> Body:
    """Load a body at rest; a moving mesh rests in its first frame."""
    from eslr_jax.pipeline.assets import load_body
    from eslr_jax.pipeline.formats.mesh_sequence import read_mesh_sequence
    from eslr_jax.pipeline.rigs.sequence import pose_sequence

    if not is_moving_mesh(body):
        return load_body(body, units=units, betas=betas)
    if betas:
        raise ConfigError(f"{body} is a mesh in motion and has no shapes; leave out --betas")
    return pose_sequence(read_mesh_sequence(body), num_frames=1, units=units)[0]


def load_actor(options: Options) -> Actor:
    """Load a body and set it in motion."""
    from eslr_jax.pipeline.assets import load_body, load_motion
    from eslr_jax.pipeline.assets.motions import own_motion, read_joint_map
    from eslr_jax.pipeline.formats.mesh_sequence import read_mesh_sequence
    from eslr_jax.pipeline.rigs.sequence import pose_sequence
    from eslr_jax.pose.motion import pose_body
    from eslr_jax.pose.timing import cut_start, loop_motion

    body = options.body
    if is_moving_mesh(body):
        given = {
            "--motion": options.motion is not None,
            "--start": options.start is not None,
            "--loop": options.loop is not None,
            "--joint-map": options.joint_map is not None,
            "--arm-abduction": options.arm_abduction is not None,
            "--motion-up": options.motion_up != "auto",
            "--betas": bool(options.betas),
        }
        refuse_given(f"{body} is a mesh in motion and follows no other", given)
        sequence = read_mesh_sequence(body, fps=options.body_fps)
        return Actor(*pose_sequence(sequence, num_frames=options.frames, units=options.body_units), body, 0.0)
    if options.body_fps is not None:
        raise ConfigError(f"--body-fps is for bodies that are moving meshes, which {body} is not")
    rig = load_body(body, units=options.body_units, betas=options.betas)
    motion = options.motion or own_motion(body)
    changes = None if options.joint_map is None else read_joint_map(options.joint_map)
    clip = load_motion(motion, body=rig, joint_map=changes, up=options.motion_up)
    if options.start is not None:
        clip = cut_start(clip, parse_seconds(options.start, FPS, option="--start"))
    if options.loop is not None:
        clip = loop_motion(clip, parse_seconds(options.loop, FPS, option="--loop"))
    poses = pose_body(rig, clip, num_frames=options.frames, arm_abduction=options.arm_abduction)
    return Actor(rig, poses, motion, clip.start)


class Method(NamedTuple):
    """How frames are solved, and by when."""

    network: str | None  # its name
    params: Network | None
    config: SimConfig
    budget_ms: float | None = None
    pace: Callable[[int, float], int] | None = None  # of a budget

    @property
    def garment_options(self) -> Mapping[str, Any]:
        """What the network asks of a garment."""
        return {} if self.params is None else self.params.garment_options

    @property
    def tolerance(self) -> float | None:
        """Share of the initial gap at which frames stop, if they do."""
        return self.config.tolerance or None

    @property
    def model(self) -> str | None:
        """The network, and what the solver does after it."""
        if self.network is None or self.config.iterations == 0:
            return self.network
        is_open = self.tolerance is not None or self.budget_ms is not None
        return (
            f"{self.network}, then {'' if is_open else f'{self.config.iterations} iterations of '}the solver"
        )

    def within_budget(self, num_vertices: int, substeps: int) -> Method:
        """Return the method with the iterations that its budget pays for, if it has one.

        Raises:
            ConfigError: The budget is too small.
        """
        from eslr_jax.pipeline.assets.budget import SOLVER, first_iterations, keep_budget, read_calibration

        if self.budget_ms is None:
            return self
        cost = read_calibration().cost(num_vertices, self.network or SOLVER, substeps)
        iterations = first_iterations(cost, self.budget_ms)
        config = dataclasses.replace(self.config, iterations=iterations)
        return self._replace(config=config, pace=keep_budget(cost, self.budget_ms))

    def describe_load(self, num_vertices: int, num_frames: int, substeps: int) -> str:
        """Return the expected time and memory of a simulation, as text."""
        from eslr_jax.pipeline.assets.budget import SOLVER, read_calibration

        iterations = float(self.config.iterations)
        if self.tolerance is not None:
            iterations = _ITERATIONS * max(-math.log10(self.tolerance) - 1.0, 0.5)
        cost = read_calibration().cost(num_vertices, self.network or SOLVER, substeps)
        seconds = 1e-3 * (self.budget_ms or cost.frame_ms(iterations))
        minutes = max(num_frames * seconds / 60, 1)
        memory = _BASE_GB + 1e-9 * num_vertices * (_VERTEX_BYTES + num_frames * _FRAME_BYTES)
        return (
            f"{num_vertices:,} vertices take about {seconds:.1f} s a frame, {minutes:.0f} min for {num_frames} "
            f"frames, and {memory:.1f} GB of memory; --frames and a coarser mesh take less"
        )


def choose_method(options: Options) -> Method:
    """Return how the options ask for frames to be solved.

    Raises:
        ConfigError: Options contradict each other, or a budget or a tolerance can't be read.
        AssetError: There is no such network.
    """
    from eslr_jax.config import SimConfig
    from eslr_jax.pipeline.assets import load_model
    from eslr_jax.pipeline.assets.models import DEFAULT_MODEL

    network, iterations = options.model, options.iterations
    if options.budget is not None and options.tolerance is not None:
        raise ConfigError("give either --budget or --tolerance")
    if iterations is not None and (options.budget or options.tolerance) is not None:
        raise ConfigError("--budget and --tolerance say when the solver ends a frame; leave out --iterations")
    if options.simulator == "physics" and network is not None:
        raise ConfigError(f"--simulator physics has no network; leave out --model {network}")
    if options.simulator == "physics" and iterations == 0:
        raise ConfigError("--iterations 0 needs a network; name --model, or give 1 or more")
    if network is None and (options.simulator == "network" or iterations == 0):
        network = DEFAULT_MODEL
    budget_ms = None if options.budget is None else parse_budget(options.budget)
    stops: dict[str, Any] = {} if options.tolerance is None else {"tolerance": parse_share(options.tolerance)}
    if iterations is None and network is not None and not stops and budget_ms is None:
        iterations = BEHIND_NETWORK
    if iterations is not None:
        stops = {"iterations": iterations, "tolerance": 0.0}
    elif budget_ms is not None:
        stops = {"tolerance": 0.0}
    return Method(network, None if network is None else load_model(network), SimConfig(**stops), budget_ms)
