"""The options of `eslr simulate` that define a simulation, and how `--resume` restores them."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from eslr_jax.errors import AssetError, ConfigError

if TYPE_CHECKING:
    from eslr_jax.simulation.budget import Choice
    from eslr_jax.types import PairCapacity, Scene, Trajectory

DEFAULT_GARMENT = "tshirt"
_SAME = 1e-4  # [m] by which the beginning of the same scene may differ between machines


@dataclasses.dataclass(frozen=True)
class Options:
    """The options that decide what is simulated; see `eslr simulate --help`."""

    garment: tuple[str, ...]  # of an outfit the innermost first; empty for the default
    motion: str | None
    body: str
    simulator: Literal["network", "physics"] | None
    model: str | None
    vertices: Literal["1k", "4k", "10k", "50k", "200k"]
    fabric: tuple[str, ...]
    frames: int | None
    iterations: int | None
    budget: str | None
    tolerance: str | None
    joint_map: Path | None
    motion_up: Literal["auto", "y", "z"]
    arm_abduction: float | None
    body_fps: float | None
    body_units: str | None
    betas: tuple[float, ...]
    start: str | None
    loop: str | None
    settle: int | None
    self_contact: bool
    no_self_contact: bool = False
    ground: Literal["auto", "on", "off"] = "auto"
    integrator: Literal["euler", "bdf2"] | None = "euler"  # of runs that an older version began
    substeps: int = 1
    wind: tuple[float, float, float] | None = None
    gust: float = 0.0
    damping: float | None = None


def refuse_given(reason: str, options: dict[str, bool]) -> None:
    """Raise a ConfigError if an option is given that would do nothing.

    Args:
        reason: Why it would do nothing.
        options: Whether each of them is given.
    """
    if given := [option for option, is_given in options.items() if is_given]:
        raise ConfigError(f"{reason}; leave out {', '.join(given)}")


def wanted_self_contact(options: Options) -> bool | None:
    """Return whether self-contact is asked for, or None where the scene decides.

    Raises:
        ConfigError: It is asked for both ways.
    """
    if options.self_contact and options.no_self_contact:
        raise ConfigError("--self-contact and --no-self-contact exclude each other; give one of them")
    if options.no_self_contact:
        return False
    return True if options.self_contact else None


def interrupted_record(
    options: Options, choice: Choice | None, capacity: PairCapacity | None
) -> dict[str, Any]:
    """Return what an interrupted simulation goes on with, as values of JSON.

    Args:
        options: Its options.
        choice: The simulator that was chosen, if a budget or a tolerance did.
        capacity: Buffers of self-contact that sufficed.
    """
    values = {name: _plain(value) for name, value in vars(options).items()}
    return {
        "options": values,
        "choice": None if choice is None else dataclasses.asdict(choice),
        "capacity": None if capacity is None else dataclasses.asdict(capacity),
    }


class Interrupted(NamedTuple):
    """What an interrupted simulation goes on with."""

    done: Trajectory  # the first frames
    options: Options
    choice: Choice | None  # what a budget or a tolerance led to
    capacity: PairCapacity | None  # buffers of self-contact that sufficed


def read_interrupted(out: Path, given: Options) -> Interrupted:
    """Read an interrupted simulation with its own options; a given option must agree with them.

    Args:
        out: Its folder.
        given: The options of this command.

    Raises:
        AssetError: The folder holds no interrupted simulation.
        ConfigError: An option is given that is not the simulation's own.
    """
    import inspect

    from eslr_jax.cli.simulate import simulate
    from eslr_jax.io.unfinished import read_unfinished
    from eslr_jax.simulation.budget import Choice
    from eslr_jax.types import PairCapacity

    done, record = read_unfinished(out)
    try:
        values, choice, capacity = record["options"], record["choice"], record["capacity"]
        typed = {name: tuple(values[name]) for name in ("garment", "fabric", "betas")}
        typed["joint_map"] = None if values["joint_map"] is None else Path(values["joint_map"])
        options = Options(**values | typed)
        choice = None if choice is None else Choice(**choice)
        capacity = None if capacity is None else PairCapacity(**capacity)
    except (KeyError, TypeError) as error:
        raise AssetError(
            f"{out} was simulated by another version; start without --resume in another folder"
        ) from error
    usual = inspect.signature(simulate).parameters
    for name, value in vars(given).items():
        if value != usual[name].default and _plain(value) != values.get(name):
            own = values.get(name)
            raise ConfigError(
                f"{out} was simulated with {name.replace('_', '-')} = {_text(own)}, not {_text(_plain(value))}; "
                "leave out all options but --out to go on, or start in another folder without --resume"
            )
    return Interrupted(done, options, choice, capacity)


def check_same_scene(done: Trajectory, scene: Scene, out: Path) -> None:
    """Check that the frames that are done begin as the scene does.

    Args:
        done: Frames of an interrupted simulation.
        scene: The scene of the same options.
        out: Folder of the simulation.

    Raises:
        ConfigError: A file has changed since.
    """
    import numpy as np

    first, again = np.asarray(done.positions[0]), np.asarray(scene.initial_state.position)
    if (
        first.shape != again.shape
        or np.abs(first - again).max() > _SAME
        or done.num_frames >= scene.num_frames
    ):
        raise ConfigError(
            f"{out} was simulated with another garment, body or motion: their files have changed since; "
            "start in another folder without --resume"
        )


def _plain(value: Any) -> Any:
    """Return an option's value as one of JSON."""
    if isinstance(value, tuple):
        return list(value)
    return str(value) if isinstance(value, Path) else value


def _text(value: Any) -> str:
    """Return an option's value as it is typed."""
    if value is None or value == []:
        return "none"
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)
