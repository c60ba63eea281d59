"""A network: its weights and its static description in one pytree; and the registry of systems.

A system is a class in one file, marked by `@network(name)`: its fields are the options of `[model]` in a recipe
of `eslr train`. Files of weights name it, so that `eslr simulate --model` finds it again.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeVar

import jax
from flax import struct
from jaxtyping import Array, Float

from eslr_jax.config import import_own
from eslr_jax.errors import ConfigError
from eslr_jax.solver.guess import Start
from eslr_jax.solver.potential import Point
from eslr_jax.terms.term import FrameProblem, pin
from eslr_jax.types import ClothState, Normalizer

Statistics = dict[str, Normalizer]
Example = Callable[[], tuple[FrameProblem, ClothState]]


class Prediction(NamedTuple):
    """What a network makes of a frame."""

    positions: Float[Array, "steps vertices 3"]  # at t + 1, after every refinement step [m]
    guess: Start | None = None  # that was refined; None for one acceleration
    previous: Point | None = None  # the lowest point that a refinement step began from

    @property
    def position(self) -> Float[Array, "vertices 3"]:
        """Positions after the last step [m]."""
        return self.positions[-1]


class System:
    """Static description of a network: frozen and hashable, as a Flax module or a frozen dataclass is.

    One of one's own has `apply(params, problem, state)`, which returns positions at t + 1 [m], shape
    [vertices, 3]; pinned vertices are put in place afterwards. To be trained it has `init(key, problem, state)`
    too, which returns weights. These are Flax's methods: `class Own(nn.Module, System)` inherits both. It may
    have `garment_options`, arguments of `assets.load_garment` for a garment that it reads.
    """

    apply: Callable[..., Any]
    init: Callable[..., Any]
    refinement_steps = 1  # predictions a frame, each from the one before
    form: Any = "positions"  # what it predicts, in words

    def new_network(self, seed: int, example: Example) -> Network:
        """Return a network with new weights; `example` returns a frame's problem and state, for their shapes."""
        return Network(self.init(jax.random.key(seed), *example()), self)

    def predict(
        self, network: Network, problem: FrameProblem, state: ClothState, *, detach: bool
    ) -> Prediction:
        """Return the prediction for a frame; see `Network.predict`."""
        return Prediction(pin(problem, self.apply(network.params, problem, state))[None])

    def check(self, network: Network) -> None:
        """Raise a CheckpointError where weights do not fit."""


@struct.dataclass
class Network:
    """A network: `rollout`, `simulate` and `step` take it as `params`."""

    params: Any  # weights that are trained, in the form that `config.apply` takes
    config: Any = struct.field(pytree_node=False)  # a `System`; static
    statistics: Statistics = struct.field(default_factory=dict)  # normalisers of features and output
    constants: dict[str, Any] = struct.field(default_factory=dict)  # random directions of the attention

    def predict(self, problem: FrameProblem, state: ClothState, *, detach: bool = False) -> Prediction:
        """Return the prediction for a frame, with the cloth at t.

        With `detach` refinement steps hand on no gradients: each is trained to do its best from where it begins.
        """
        return self.config.predict(self, problem, state, detach=detach)

    @property
    def garment_options(self) -> Mapping[str, Any]:
        """Arguments of `assets.load_garment` for a garment that the network reads."""
        return getattr(self.config, "garment_options", {})

    @property
    def parts(self) -> dict[str, Any]:
        """All arrays, as files hold them."""
        return {"params": self.params, "constants": self.constants, "statistics": self.statistics}

    @property
    def num_parameters(self) -> int:
        """Number of trained weights."""
        return sum(leaf.size for leaf in jax.tree.leaves(self.params))


def check_network(network: Any) -> None:
    """Raise a ConfigError where `params` is no network of a `System`, a CheckpointError where it doesn't fit."""
    if network is None:
        return
    if not isinstance(network, Network):
        raise ConfigError(
            f"params is {type(network).__name__}, not a Network; take one of load_model, or make one of weights "
            "and their module: Network(weights, module)"
        )
    if not isinstance(network.config, System):
        name = type(network.config).__name__
        raise ConfigError(f"the network's {name} is no System; declare it as class {name}(..., System)")
    network.config.check(network)


# --- the registry -------------------------------------------------------------------------------------------

_systems: dict[str, type[System]] = {}
_System = TypeVar("_System", bound=System)
_PACKAGE = __package__ or ""


def network(name: str) -> Callable[[type[_System]], type[_System]]:
    """Register a system, so that recipes and files of weights may name it.

    Outside of this package its name is MODULE:NAME, and MODULE is imported when it is asked for.
    """

    def register(system: type[_System]) -> type[_System]:
        is_own = not system.__module__.startswith(_PACKAGE)
        _systems[f"{system.__module__}:{name}" if is_own else name] = system
        return system

    return register


def find_system(name: str) -> type[System] | None:
    """Return the system of a name, or None; a ConfigError where the module of MODULE:NAME can't be imported."""
    module = name.partition(":")[0]
    if name not in _systems and module != name:
        import_own(module, f"model {name}")
    return _systems.get(name)


def describe_system(system: Any) -> dict[str, Any]:
    """Return a registered system as plain values, for `registry.read_system`; a ConfigError for others."""
    names = [name for name, known in _systems.items() if known is type(system)]
    if not names:
        raise ConfigError(f'{type(system).__name__} has no name; mark the class by @network("NAME")')
    options = [field.name for field in dataclasses.fields(system)]
    of_flax = ("parent", "name")  # which Flax adds to its modules' fields
    return {"base": names[0]} | {name: getattr(system, name) for name in options if name not in of_flax}
