"""What a frame's graph is built from."""

from __future__ import annotations

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from eslr_jax.types import Contacts


@struct.dataclass
class GraphInputs:
    """State of a garment and of the body beside it, at one frame or at one pass within a frame.

    Lengths are in metres and velocities in metres per frame, the unit of HOOD's features. Pinned vertices
    carry their next target in `position` and the way to it in `velocity`.

    `contacts` and `body_velocity` are None in a scene without a body. The fields from `guess` on are read only
    where `ModelConfig.features` is "gradient"; `correction` and `previous_gradient` are None, or zero, on the
    first pass of a frame.
    """

    position: Float[Array, "vertices 3"]  # [m]
    velocity: Float[Array, "vertices 3"]  # [m per frame]
    timestep: Float[Array, ""]  # [s]
    contacts: Contacts | None = None
    body_velocity: Float[Array, "vertices 3"] | None = None  # of the nearest body points [m per frame]
    inertial_guess: Float[Array, "vertices 3"] | None = None  # where inertia alone leads [m]
    guess: Float[Array, "vertices 3"] | None = (
        None  # current answer: pushed-out inertial guess, or last pass [m]
    )
    gradient: Float[Array, "vertices 3"] | None = None  # of the potential at `guess` [N]
    step: Float[Array, "vertices 3"] | None = None  # preconditioned step down that gradient [m]
    weight: Float[Array, " vertices"] | None = None  # m g [N]
    correction: Float[Array, "vertices 3"] | None = None  # that led to `guess` [m]
    previous_gradient: Float[Array, "vertices 3"] | None = None  # before that correction [N]


def next_refinement(
    inputs: GraphInputs, guess: Float[Array, "vertices 3"], gradient: Float[Array, "vertices 3"]
) -> GraphInputs:
    """Return the inputs of the next pass over the same frame.

    Args:
        inputs: The pass just done.
        guess: Its answer [m], shape [vertices, 3].
        gradient: Gradient of the potential there [N], shape [vertices, 3].
    """
    return inputs.replace(
        guess=guess,
        gradient=gradient,
        correction=jnp.subtract(guess, inputs.guess),
        previous_gradient=inputs.gradient,
    )
