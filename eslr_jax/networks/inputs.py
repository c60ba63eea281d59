"""What a frame's graph is built from."""

from __future__ import annotations

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from eslr_jax.types import Contacts


@struct.dataclass
class GraphInputs:
    """State of a garment and of the body beside it, at a frame or at one refinement step of a frame.

    Lengths are in metres. Velocities are in metres per frame, the unit of HOOD's features. Pinned vertices
    already have their next target as `position`, and their way to it as `velocity`.

    `contacts` and `body_velocity` are None in a scene without a body. Only features of the kind "gradient" read
    the fields from `inertial_guess` on. `correction` and `previous_gradient` are None or zero at the first
    refinement step of a frame.
    """

    position: Float[Array, "vertices 3"]  # [m]
    velocity: Float[Array, "vertices 3"]  # [m per frame]
    timestep: Float[Array, ""]  # [s]
    contacts: Contacts | None = None
    body_velocity: Float[Array, "vertices 3"] | None = None  # of the nearest body points [m per frame]
    inertial_guess: Float[Array, "vertices 3"] | None = None  # where inertia alone leads [m]
    guess: Float[Array, "vertices 3"] | None = None  # what the step corrects [m]
    gradient: Float[Array, "vertices 3"] | None = None  # of the potential at `guess` [N]
    step: Float[Array, "vertices 3"] | None = None  # preconditioned step down that gradient [m]
    weight: Float[Array, " vertices"] | None = None  # m g [N]
    correction: Float[Array, "vertices 3"] | None = None  # that led to `guess` [m]
    previous_gradient: Float[Array, "vertices 3"] | None = None  # before that correction [N]


def required(inputs: GraphInputs, name: str) -> Array:
    """Return a field of `inputs` that a kind of features cannot do without.

    Raises:
        ValueError: The field is None.
    """
    value = getattr(inputs, name)
    if value is None:
        raise ValueError(f"GraphInputs.{name} is None, but the features of this model need it; set it")
    return value


def next_refinement(inputs: GraphInputs, guess: Float[Array, "vertices 3"]) -> GraphInputs:
    """Return the inputs of the next refinement step of the same frame, but for the gradient at its guess.

    Args:
        inputs: Inputs of the step just done.
        guess: Positions that this step predicted [m], shape [vertices, 3].
    """
    return inputs.replace(
        guess=guess,
        correction=jnp.subtract(guess, required(inputs, "guess")),
        previous_gradient=required(inputs, "gradient"),
    )
