"""How `eslr simulate` solves a frame: which simulator, which network, how many iterations."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

from eslr_jax.cli.budget import parse_request
from eslr_jax.errors import ConfigError

if TYPE_CHECKING:
    from eslr_jax.cli.options import Options
    from eslr_jax.config import SimConfig
    from eslr_jax.simulation.budget import Choice

ITERATIONS = 100  # of the solver alone: at 1k they leave a median gap of 0.002 %
BEHIND_NETWORK = 10  # of the solver after a network


class Method(NamedTuple):
    """How a scene is simulated: the options with their defaults filled in."""

    simulator: str  # "physics" or "network"
    model: str | None
    params: Any  # weights; None without a network
    config: SimConfig
    choice: Choice | None  # what a budget or a tolerance led to
    budget_ms: float | None
    tolerance: float | None

    @property
    def garment_options(self) -> dict[str, Any]:
        """What the network asks of a garment."""
        return getattr(self.config.model, "garment_options", {})


def read_request(options: Options) -> tuple[float | None, float | None]:
    """Return the budget [ms] and the tolerance that the options ask for."""
    is_chosen = options.simulator is None and options.model is None and options.iterations is None
    if options.simulator == "physics" and options.model is not None:
        raise ConfigError(f"--simulator physics has no network; leave out --model {options.model}")
    return parse_request(options.budget, options.tolerance, is_chosen=is_chosen)


def choose_method(
    options: Options, request: tuple[float | None, float | None], num_vertices: int, choice: Choice | None
) -> Method:
    """Return how to simulate a garment of this size; `choice` is that of an interrupted run.

    Raises:
        ConfigError: The solver alone is asked for, with no iterations.
    """
    from eslr_jax.assets import load_model
    from eslr_jax.assets.models import DEFAULT_MODEL
    from eslr_jax.config import SimConfig
    from eslr_jax.simulation.budget import SOLVER, choose, read_calibration

    simulator, model, iterations = options.simulator, options.model, options.iterations
    budget_ms, tolerance = request
    if choice is None and (budget_ms is not None or tolerance is not None):
        choice = choose(
            read_calibration(),
            num_vertices,
            budget_ms=budget_ms,
            tolerance=tolerance,
            substeps=options.substeps,
        )
    if choice is not None:
        simulator = "physics" if choice.method == SOLVER else "network"
        model = None if choice.method == SOLVER else choice.method
        iterations = choice.iterations
    simulator = simulator or ("physics" if iterations and model is None else "network")
    params, architecture = None, None
    if simulator == "network":
        model = model or DEFAULT_MODEL
        params, architecture = load_model(model)
    elif iterations == 0:
        raise ConfigError("--iterations 0 needs a network; name --model, or give 1 or more")
    usual = ITERATIONS if architecture is None else BEHIND_NETWORK
    config = SimConfig(
        model=architecture,
        iterations=usual if iterations is None else iterations,
        tolerance=0.0 if choice is None else choice.tolerance,
    )
    return Method(simulator, model, params, config, choice, budget_ms, tolerance)


def expected_frame_ms(method: Method, num_vertices: int, substeps: int) -> float:
    """Return what a frame is expected to take on this machine [ms]."""
    from eslr_jax.simulation.budget import SOLVER, expected_ms, read_calibration

    if method.choice is not None:
        return method.choice.expected_ms
    name, iterations = method.model or SOLVER, method.config.iterations
    return expected_ms(read_calibration(), num_vertices, name, iterations, substeps)
