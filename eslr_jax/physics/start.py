"""Where the solver and the network start a frame."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from eslr_jax.numerics import scatter_corners
from eslr_jax.physics.potential import potential
from eslr_jax.physics.problem import FrameProblem, pin, start_guess
from eslr_jax.types import Garment, Material

_COLLAPSED = 1e-6  # of a face's rest area, below which its normal means nothing
_OFFSET = 1e-6  # [m] by which the corners of collapsed faces are spread


def solver_start(problem: FrameProblem, garment: Garment, material: Material) -> Float[Array, "vertices 3"]:
    """Return the better of two guesses, with collapsed faces opened a little.

    The inertial guess is best for cloth that rests or hangs, the ballistic one for cloth that falls: there it
    is the answer, which L-BFGS misses by millimetres a second, since its first steps bend what only has to
    move. The potential decides.

    Args:
        problem: The frame's problem.
        garment: Rest mesh.
        material: Fabric.
    """
    inertial = start_guess(problem, garment)
    fall = problem.parameters.gravity * problem.timestep * problem.timestep
    falling = problem.inertial_guess - jnp.array([[0.0, 1.0, 0.0]], inertial.dtype) * fall
    ballistic = start_guess(problem.replace(inertial_guess=falling), garment)
    guesses = jnp.stack([inertial, ballistic])
    values = jax.lax.map(lambda guess: potential(guess, problem, garment, material), guesses)
    return spread_collapsed(jnp.where(values[1] < values[0], ballistic, inertial), problem, garment)


def spread_collapsed(
    position: Float[Array, "vertices 3"], problem: FrameProblem, garment: Garment
) -> Float[Array, "vertices 3"]:
    """Move vertices whose faces have all collapsed by a micrometre, each its own way.

    The angle at a hinge without area is zero by convention, and jumps as soon as it has any: from cloth
    pressed flat onto a line every step is uphill, and a line search would stay there for ever.
    """
    corners = position[garment.faces]
    normal = jnp.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    squared = jnp.sum(normal * normal, axis=-1)  # four times the area, squared
    is_open = squared > jnp.square(2.0 * _COLLAPSED * garment.rest_areas)
    is_real = garment.rest_areas > 0
    open_faces = scatter_corners(
        jnp.broadcast_to((is_open & is_real)[:, None], garment.faces.shape).astype(position.dtype),
        garment.face_incidence,
    )
    row = jnp.arange(position.shape[0], dtype=position.dtype)
    # The golden angle and its like: offsets without a pattern along the mesh's numbering.
    offset = jnp.stack(
        [jnp.sin(2.399963 * row), jnp.sin(3.883222 * row + 1.0), jnp.cos(5.083204 * row)], axis=-1
    )
    is_collapsed = (open_faces == 0) & garment.vertex_mask
    return pin(problem, garment, jnp.where(is_collapsed[:, None], position + _OFFSET * offset, position))
