"""The options of `eslr simulate` that decide what is simulated, and how texts on a command line are read."""

from __future__ import annotations

import dataclasses
import math
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from eslr_jax.errors import AssetError, ConfigError

if TYPE_CHECKING:
    from eslr_jax.terms import Term

DEFAULT_GARMENT = "tshirt"


@dataclasses.dataclass(frozen=True)
class Options:
    """What is simulated: `eslr simulate` takes these options, and keeps them for --resume."""

    # Name of a bundled garment (see `eslr assets`), which is transferred to the body, or a mesh file, which
    # is fitted to the body; see `eslr fit` if the fit goes wrong. A sewing pattern (.json) is sewn, as by
    # `eslr sew`. Repeat the option for an outfit, the
    # innermost garment first, as in --garment pants --garment tshirt. By default a T-shirt.
    garment: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    # Name of a bundled motion; turn, jump or swing; or a motion file: BVH, AMASS (.npz), HOOD or VTO (.pkl),
    # glTF, FILE#CLIP to pick a clip. By default the animation in the body's file, or else cmu_016_32.
    motion: str | None = None
    # Name of a bundled body, or a body: a SMPL, SMPL-H or SMPL-X model (.npz, .pkl), a skinned character
    # (glTF), or a moving mesh (.npz, .abc, or a folder of OBJ or PLY files; a single one stands still).
    # FILE#MESH,MESH picks the meshes of a character that are its body, without its clothes.
    body: str = "anny"
    # physics is the solver alone; network is a trained network, from whose prediction the solver starts.
    simulator: Literal["network", "physics"] | None = None
    # Name of a bundled network or an exported file; the default network if a network is asked for and none is
    # named.
    model: str | None = None
    # Resolution of bundled garments and of sewing patterns; from 50k on it is made at run time.
    vertices: Literal["1k", "4k", "10k", "50k", "200k"] = "1k"
    # Name of a fabric (see `eslr assets --kind fabric`), or numbers as in density=0.2,bending_stiffness=1e-5
    # or flexural_rigidity=5e-6. PART:FABRIC is the fabric of one part or of one garment of an outfit; the
    # rest keeps its own. Seams of a sewn garment are the part `seams`, whose bending alone counts. By default
    # that of the fitted file, or cotton.
    fabric: tuple[str, ...] = ()
    # Simulate this many frames, the start included; all if not given.
    frames: int | None = None
    # Solver iterations per frame, which replace the tolerance: by default 10 after a network, and else as many
    # as the tolerance takes, at most 500. With 0 the network simulates without the solver.
    iterations: int | None = None
    # Time per frame, such as 20ms: adapt the iterations during the run so that frames keep the budget. See
    # `eslr calibrate`.
    budget: str | None = None
    # Share of the initial optimality gap that a frame may leave, such as 0.1%: the solver ends the frame there.
    # By default 1%.
    tolerance: str | None = None
    # JSON file of changes to the map of joints that `eslr joints` shows.
    joint_map: Path | None = None
    # Axis that points up in a motion of BVH or SMPL.
    motion_up: Literal["auto", "y", "z"] = "auto"
    # Degrees by which both arms are lifted; by default 12 for the motion of another body, and 0 for the
    # body's own motion.
    arm_abduction: float | None = None
    # Frames per second of a body that is a moving mesh.
    body_fps: float | None = None
    # Unit of the body's file: m, dm, cm, mm, in, ft, or metres per unit; recognised if not given.
    body_units: str | None = None
    # Shape of the bundled body or of a SMPL body, in standard deviations.
    betas: tuple[float, ...] = ()
    # Where to begin in the motion: a frame, such as 375, or a time, such as 12.5s.
    start: str | None = None
    # How long to repeat the motion: frames or a time, such as 30s.
    loop: str | None = None
    # Frames before frame 0 in which the garment settles: the limbs move from the body's rest pose to the
    # first pose, which the last 10 frames hold. These frames are not kept. By default 35, or 0 for a network
    # alone.
    settle: int | None = None
    # How time is stepped. bdf2 keeps swinging cloth in motion. With euler, the paper's integrator, swinging
    # cloth loses two thirds of its energy in a second. The default is bdf2, or euler for a network alone,
    # which was trained with it.
    integrator: Literal["euler", "bdf2"] | None = None
    # Number of shorter steps per frame; with 4, limbs that move fast take less cloth along. Frames that tear
    # cloth are simulated in 4 in any case. The iterations are those of each substep.
    substeps: int = 1
    # How contact is kept. With strict nothing passes through cloth, neither the body nor other cloth. With fast,
    # in half the time, vertices of the cloth keep off the body; skin may show between them, and layers of
    # cloth pass through each other.
    contact: Literal["strict", "fast"] = "strict"
    # Model a level ground under the body's lowest point; auto does where cloth could reach it.
    ground: Literal["auto", "on", "off"] = "auto"
    # Model air that moves with this velocity in m/s, such as 3 0 0; y points up, and 0 0 0 is still air.
    wind: tuple[float, float, float] | None = None
    # Strength of gusts, as a share of the wind's speed.
    gust: float = 0.0
    # Internal damping of the fabric in seconds, such as 0.005; it calms fast ripples first.
    damping: float | None = None
    # An energy of your own, or one in the place of its kind: MODULE:CLASS, then its constants, as in
    # mywind:Push,pressure=2. Repeat the option for more.
    term: tyro.conf.UseAppendAction[tuple[str, ...]] = ()

    @property
    def garments(self) -> tuple[str, ...]:
        """The garments, the innermost first."""
        return self.garment or (DEFAULT_GARMENT,)

    def check(self) -> None:
        """Check what needs no file.

        Raises:
            ConfigError: A count is impossible, or two options exclude each other.
        """
        if self.frames is not None and self.frames < 2:
            raise ConfigError(f"--frames {self.frames}: a simulation needs two frames or more")
        for name in ("settle", "iterations"):
            value = getattr(self, name)
            if value is not None and value < 0:
                raise ConfigError(f"--{name} {value}: give a number, 0 or more")

    def terms(self) -> tuple[Term, ...]:
        """Return what is modelled where it is needed."""
        from eslr_jax.terms import Contact, Damping, Ground, scene_terms
        from eslr_jax.terms.air import blowing

        changed: list[Term] = [Ground(is_always=self.ground == "on")]
        if (air := blowing(self.wind, self.gust)) is not None:
            changed.append(air)
        if self.damping is not None:
            changed.append(Damping(self.damping))
        changed += map(read_term, self.term)
        left_out = (Ground,) * (self.ground == "off") + (Contact,) * (self.contact == "fast")
        return scene_terms(*changed, without=left_out)

    def record(self) -> dict[str, Any]:
        """Return the options as plain values, by name."""
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(Options)}
        return {name: str(value) if isinstance(value, Path) else value for name, value in values.items()}


def read_term(text: str) -> Term:
    """Return the term of MODULE:CLASS,constant=value; values are read as TOML.

    Raises:
        ConfigError: There is no such term, or it does not take these constants.
    """
    import numpy as np

    from eslr_jax.terms.term import find_term

    name, _, constants = text.partition(",")
    kind = find_term(name)
    try:
        values = tomllib.loads(f"constants = {{{constants}}}")["constants"]
        for field in dataclasses.fields(kind):  # type: ignore[arg-type]: as a term is a dataclass
            if field.name in values and field.metadata.get("pytree_node", True):  # else a choice
                values[field.name] = np.asarray(values[field.name], np.float32)
        return kind(**values)
    except (tomllib.TOMLDecodeError, TypeError, ValueError) as error:
        raise ConfigError(
            f"--term {text}: {error}; write all its constants, as in {name},first=2,second=[0, 1, 0]"
        ) from error


def refuse_given(reason: str, options: dict[str, bool]) -> None:
    """Raise a ConfigError if an option is given that would do nothing, for a reason."""
    if given := [option for option, is_given in options.items() if is_given]:
        raise ConfigError(f"{reason}; leave out {', '.join(given)}")


def check_npz(out: Path, what: str) -> None:
    """Raise an AssetError unless a file to write has the suffix that it needs."""
    if out.suffix != ".npz":
        raise AssetError(f"--out {out}: {what} is an npz file; name it such as {out.stem}.npz")


def parse_seconds(text: str, fps: float, *, option: str) -> float:
    """Return a moment's time [s], given as a frame, such as 375, or as a time with its unit, such as 12.5s.

    Raises:
        ConfigError: The text is neither; the message names the option.
    """
    try:
        seconds = float(text[:-1]) if text.endswith("s") else int(text) / fps
    except ValueError:
        seconds = math.nan
    if not (math.isfinite(seconds) and seconds >= 0):
        raise ConfigError(f"{option} {text}: give a frame, such as 375, or a time, such as 12.5s")
    return seconds


def parse_budget(text: str) -> float:
    """Return a time per frame in milliseconds.

    Raises:
        ConfigError: It is not a positive time.
    """
    unit, scale = ("ms", 1.0) if text.endswith("ms") else ("s", 1e3)
    try:
        value = float(text.removesuffix(unit)) * scale if text.endswith(unit) else math.nan
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise ConfigError(f"--budget {text}: write a time per frame, such as 20ms or 0.1s")
    return value


def parse_share(text: str) -> float:
    """Return a share, written as 1% or 0.01.

    Raises:
        ConfigError: It is not between 0 and 1.
    """
    try:
        value = float(text.removesuffix("%")) / (100 if text.endswith("%") else 1)
    except ValueError:
        value = math.nan
    if not 0 < value < 1:
        raise ConfigError(f"--tolerance {text}: write a share of the initial gap, such as 1% or 0.01")
    return value
