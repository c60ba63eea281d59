"""Frozen configurations. Defaults are the paper's where it states them; each value names its source."""

from __future__ import annotations

import dataclasses
import difflib
import importlib
import tomllib
from collections.abc import Collection
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from eslr_jax.errors import ConfigError

Criterion = Literal["postcvpr", "cvpr", "metric"]
"""Readings of HOOD's losses, see `terms.hood`."""

Control = Literal["untrained", "no_decoder", "no_embedding", "random_embedding"]
"""What a network may be deprived of, see `pipeline.report.evaluate`."""

_MAY_BE_ZERO = (
    "iterations", "tolerance", "warmup", "final_learning_rate", "still_probability", "turn_probability",
    "noise", "girth", "shape_range", "material_probability", "max_skipped", "seed",
)  # fmt: skip
MOST_ITERATIONS = 500  # of a frame with a tolerance; a dress on a fast clip takes 140 on average for 1 %


@dataclasses.dataclass(frozen=True)
class SimConfig:
    """How a frame is solved; static, so a change compiles anew.

    Without a network the solver starts from its own guess. With one, it starts from the network's prediction, or
    from the point that the prediction corrects if that has less energy; `iterations=0` ends the frame there.

    By default a frame ends at a tolerance of 1 %, after 500 iterations at most. With `iterations` alone it takes
    exactly so many. Two programs that round differently, such as a rollout inside and outside of `jax.jit`, may
    end up to this tolerance apart: vertices of a T-shirt by 1.6 mm in their first frame.
    """

    iterations: int = None  # type: ignore[assignment]: of L-BFGS per frame, at most; 500 if not given
    # A frame's iterations stop where its optimality gap is estimated to be below this share of the initial gap;
    # 0.01 is kept on 99 % of frames. If not given, 0.01, or 0 where `iterations` is given.
    tolerance: float = None  # type: ignore[assignment]
    memory: int = 8  # pairs that L-BFGS keeps

    def __post_init__(self) -> None:
        """Reject impossible values.

        Raises:
            ValueError: Names the field.
        """
        if self.tolerance is None:
            object.__setattr__(self, "tolerance", 0.01 if self.iterations is None else 0.0)
        if self.iterations is None:
            object.__setattr__(self, "iterations", MOST_ITERATIONS)
        check_numbers(self, may_be_zero=_MAY_BE_ZERO)


@dataclasses.dataclass(frozen=True)
class EvaluationOptions:
    """What to evaluate a network on, and how densely."""

    # train, validation, test or unseen_motion.
    split: str = "test"
    # Resolution of the garments.
    vertices: Literal["1k", "4k", "10k"] = "1k"
    # Only these; the training garments if not given.
    garments: tuple[str, ...] = ()
    # Only these; all of the split if not given.
    clips: tuple[str, ...] = ()
    # Number of frames of each clip in which the gap is measured. 0 skips the gap, which takes most of the time.
    gap_frames: int = 40
    # Measure only every n-th of these frames.
    every: int = 4
    # Length of the free rollouts; clips are played back and forth.
    rollout_frames: int = 300
    # Take something away, to see what it does: weights that were never trained, a decoder of zeros, geodesic
    # coordinates that are zero, or random ones.
    control: Control | None = None

    def __post_init__(self) -> None:
        """Reject lengths that leave nothing to measure.

        Raises:
            ConfigError: Names the field and the least value.
        """
        for name, least in (("gap_frames", 3), ("every", 1), ("rollout_frames", 4)):
            if getattr(self, name) < least and (name, getattr(self, name)) != ("gap_frames", 0):
                raise ConfigError(
                    f"{name} = {getattr(self, name)} leaves nothing to measure; give {least} or more"
                )


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """A training run; the defaults are the recipe that measured best on two CPU cores."""

    # A `networks.network.System`; in a recipe its name, or a table with that as `base` and values that differ.
    model: Any
    garments: tuple[str, ...] = ("tshirt", "tank", "longsleeve", "shorts", "pants", "dress")  # bundled ones
    vertices: tuple[str, ...] = ("1k",)  # resolutions, mixed step by step
    split: str = "train"  # clips of this split
    steps: int = 20_000  # of the optimiser
    energy_set: Literal["consistent", "hood"] = "consistent"  # of the loss
    # With energy_set "hood": which of the three variants of HOOD's losses, see terms.hood. "metric" has the
    # constants of HOOD's tables.
    criterion: Criterion = "postcvpr"
    schedule: Literal["cosine", "hood"] = "cosine"  # of the learning rate; "hood" also of the horizon
    learning_rate: float = 1e-3  # peak; 3e-4 measured worse
    final_learning_rate: float = 1e-5  # end of the cosine
    warmup: int = 100  # steps of linear warm-up
    clip_norm: float = 1.0  # of the global gradient (HOOD)
    # Above 0: train a network that gives the solver its start. This many L-BFGS iterations after the network
    # find the optimum of a frame. The loss measures gap and distance to it, and the trajectory goes on from it.
    # 0: train a network that works without the solver.
    iterations: int = 0
    batch_size: int = 1  # trajectories per step, spread over the devices (HOOD: 1)
    vmap_size: int = 1  # of these that a device computes side by side; one is fastest on a CPU, all on a GPU
    frames: int = 1  # of a trajectory per step, each with its loss; a scan in the compiled step (HOOD: 1)
    through_time: int = 1  # frames that a gradient goes back through, a divisor of `frames` (HOOD: 1)
    slots_per_garment: int = 4  # trajectories kept alive per garment; more where a batch needs them
    horizon: int = 60  # longest trajectory [frames]
    horizon_growth: int = 60  # frames trained until it grows by a frame; with schedule "hood", trajectories
    still_probability: float = 0.0  # share of trajectories on a body that stands still
    turn_probability: float = 0.0  # share of windows of frames at which the clip turns round, at full speed
    noise: float = 1e-3  # [m] on the start state; HOOD's 3 mm measured worse
    girth: float = 0.0  # [m] by which a trajectory's body may be thicker or thinner than the bundled one
    shape_range: float = 0.0  # [standard deviations], bound of a body's uniform shape coefficients (HOOD: 3)
    reset_stretch: float = 2.5  # a trajectory starts anew if its principal stretch exceeds this
    reset_displacement: float = 0.3  # [m] along an axis in one frame, beyond which a trajectory starts anew
    material_probability: float = 0.25  # share of trajectories with a random fabric (HOOD's ranges)
    collision_stiffness: float = 3.5e7  # [J/m^5], of the set "consistent"; "hood" has its own ramp
    # Refinement steps in the loss: all alike, or each by the share of the gap that it leaves.
    refinement_weights: Literal["equal", "contraction"] = "equal"
    max_skipped: int = 100  # non-finite updates skipped in a row before training stops
    log_every: int = 100  # steps between lines of metrics.jsonl
    checkpoint_every: int = 1000  # steps
    seed: int = 0  # of weights, clips and fabrics
    seeds: int = 1  # trained at once, from `seed` on; a GPU takes hardly longer for some

    def __post_init__(self) -> None:
        """Reject impossible values.

        Raises:
            ValueError: Names the field.
        """
        check_numbers(self, may_be_zero=_MAY_BE_ZERO)
        if self.frames % self.through_time:
            raise ValueError(
                f"frames = {self.frames} must be a multiple of through_time = {self.through_time}"
            )
        if self.iterations and self.energy_set == "hood":
            raise ValueError(f'iterations = {self.iterations} needs energy_set = "consistent"')
        if self.criterion != "postcvpr" and self.energy_set != "hood":
            raise ValueError(f'criterion = "{self.criterion}" needs energy_set = "hood"')
        if self.refinement_weights != "equal" and self.iterations:
            raise ValueError(f'refinement_weights = "{self.refinement_weights}" needs iterations = 0')
        if self.refinement_weights == "contraction" and self.model.refinement_steps == 1:
            raise ValueError('refinement_weights = "contraction" needs a model with refinement_steps > 1')
        for name in ("warmup", "final_learning_rate"):
            if self.schedule == "hood" and getattr(self, name) != getattr(TrainConfig, name):
                raise ValueError(f'{name} needs schedule = "cosine": HOOD\'s rate has no warm-up and no end')
        is_hood = self.energy_set == "hood" and not getattr(self.model, "reads_gradient", True)
        if is_hood and self.collision_stiffness != TrainConfig.collision_stiffness:
            raise ValueError(
                'collision_stiffness needs energy_set = "consistent": HOOD has a ramp of its own'
            )
        for name in ("material_probability", "still_probability", "turn_probability"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} must be between 0 and 1, got {getattr(self, name)}")
        if not self.garments or not self.vertices:
            raise ValueError("garments and vertices must name at least one each")


def check_numbers(config: Any, *, may_be_zero: Collection[str]) -> None:
    """Check that the numbers of a configuration are positive, whole ones at least 1, or 0 or more.

    Raises:
        ValueError: Names the field.
    """
    for field in dataclasses.fields(config):
        name, value = field.name, getattr(config, field.name)
        if not isinstance(value, int | float) or isinstance(value, bool):
            continue
        if name in may_be_zero and not value >= 0:
            raise ValueError(f"{name} must not be negative, got {value}")
        if name not in may_be_zero and not value > 0:
            least = "at least 1" if isinstance(value, int) else "positive"
            raise ValueError(f"{name} must be {least}, got {value}")


Config = TypeVar("Config")


def from_dict(cls: type[Config], values: dict[str, Any], *, where: str = "") -> Config:
    """Build a frozen config from plain values.

    Args:
        cls: A frozen dataclass.
        values: Field values; nested tables become nested configs.
        where: Prefix of field names in messages.

    Raises:
        ConfigError: A field is unknown (the closest name is suggested) or has the wrong type.
    """
    fields = {field.name: field for field in dataclasses.fields(cls)}  # type: ignore[arg-type]
    hints = get_type_hints(cls)
    resolved: dict[str, Any] = {}
    for key, value in values.items():
        if key not in fields:
            close = difflib.get_close_matches(key, fields, n=1)
            hint = f"; did you mean {where}{close[0]}?" if close else f"; known: {', '.join(fields)}"
            raise ConfigError(f"unknown option {where}{key}{hint}")
        resolved[key] = _convert(hints[key], value, f"{where}{key}")
    try:
        return cls(**resolved)
    except TypeError as error:
        raise ConfigError(f"{where}an option is missing: {error}") from error
    except ValueError as error:
        raise ConfigError(str(error)) from error


def _convert(hint: Any, value: Any, name: str) -> Any:
    """Check `value` against a field's annotation and convert nested tables, lists and whole floats."""
    if hint is Any:
        return value
    options = get_args(hint) if get_origin(hint) is not None else ()
    if get_origin(hint) is Literal:
        if value not in options:
            raise ConfigError(f"{name} = {value!r} is not one of {', '.join(map(repr, options))}")
        return value
    candidates = options if options and get_origin(hint) is not tuple else (hint,)
    for candidate in candidates:
        origin = get_origin(candidate) or candidate
        if dataclasses.is_dataclass(candidate) and isinstance(value, dict):
            return from_dict(candidate, value, where=f"{name}.")  # type: ignore[arg-type]
        if origin is float and isinstance(value, int | float) and not isinstance(value, bool):
            return float(value)
        if origin is tuple and isinstance(value, list | tuple):
            return tuple(_convert(get_args(candidate)[0], entry, name) for entry in value)
        if origin is int and isinstance(value, bool):
            continue
        if origin is Path and isinstance(value, str):
            return Path(value)
        if isinstance(origin, type) and isinstance(value, origin):
            return value
    raise ConfigError(f"{name} = {value!r} has the wrong type; expected {hint}")


def import_own(module: str, user: str) -> ModuleType:
    """Return a module of the user's own; `user` is what messages call that which needs it (host).

    Raises:
        ConfigError: It can't be imported.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ConfigError(
            f"{user}: {error}; run the command where {module}.py is, or put its folder on PYTHONPATH"
        ) from error


def apply_overrides(values: dict[str, Any], overrides: dict[str, Any]) -> None:
    """Set dotted keys in nested tables.

    Raises:
        ConfigError: A key leads through something that is no table.
    """
    for dotted, value in overrides.items():
        *tables, key = dotted.split(".")
        target: Any = values
        for table in tables:
            target = target.setdefault(table, {})
            if not isinstance(target, dict):
                raise ConfigError(f"--set {dotted}: {table} is not a table")
        target[key] = value


def parse_override(text: str) -> tuple[str, Any]:
    """Split `key=value`; the value is read as TOML, or taken as a word.

    Raises:
        ConfigError: There is no equals sign.
    """
    key, separator, value = text.partition("=")
    if not separator or not key:
        raise ConfigError(f"--set {text}: write key=value")
    try:
        return key, tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return key, value
