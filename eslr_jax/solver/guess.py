"""Where the minimisation of a frame begins when no network predicts it."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from eslr_jax.numerics import scatter_corners
from eslr_jax.solver.potential import Point, potential
from eslr_jax.terms.term import FrameProblem, pin

_COLLAPSED = 1e-6  # of a face's rest area, below which its normal means nothing
_OFFSET = 1e-6  # [m] by which the corners of collapsed faces are spread


class Start(NamedTuple):
    """Where the solver and the networks begin a frame."""

    position: Float[Array, "vertices 3"]  # [m]
    inertial_energy: Float[Array, ""]  # [J], of the pushed-out inertial guess: the initial gap counts from it
    previous: Point | None = None  # from which a network came to `position`; None for the solver's own guess


def initial_guess(problem: FrameProblem) -> Start:
    """Return the lower of two guesses, with collapsed faces opened a little.

    The inertial guess suits cloth that rests or hangs. The ballistic guess, free fall, suits cloth that falls,
    and is its optimum. From the inertial guess L-BFGS misses this optimum by millimetres a second, since its
    first steps bend cloth that only has to move. The guess with the lower potential is taken.
    """
    fall = problem.gravity * jnp.square(problem.inertial_timestep)
    down = jnp.array([[0.0, 1.0, 0.0]], problem.position.dtype) * fall

    def try_guess(moved: Float[Array, "vertices 3"]) -> tuple[Array, Array]:
        guess = pushed_out_guess(problem.replace(inertial_guess=moved))
        return guess, potential(guess, problem)

    # In a loop, so that pushing out and the potential are compiled once for both.
    guesses, values = jax.lax.map(
        try_guess, jnp.stack([problem.inertial_guess, problem.inertial_guess - down])
    )
    lower = jnp.where(values[1] < values[0], guesses[1], guesses[0])
    return Start(spread_collapsed(lower, problem), values[0])


def push_out(problem: FrameProblem, position: Float[Array, "vertices 3"]) -> Float[Array, "vertices 3"]:
    """Return positions [m], shape [vertices, 3], with vertices moved out of obstacles, see `Term.push_out`."""
    position = pin(problem, position)
    for term, data in problem.parts:
        position = term.push_out(position, problem, data)
    return pin(problem, position)


def pushed_out_guess(problem: FrameProblem) -> Float[Array, "vertices 3"]:
    """Return the inertial guess [m], pushed out of the body, shape [vertices, 3].

    The initial gap of a frame counts from its energy.
    """
    return push_out(problem, problem.inertial_guess)


def spread_collapsed(
    position: Float[Array, "vertices 3"], problem: FrameProblem
) -> Float[Array, "vertices 3"]:
    """Return positions [m], shape [vertices, 3], with vertices of collapsed faces moved by a micrometre.

    The angle at a hinge without area is zero by convention, and jumps as soon as the hinge has an area. So every
    step from cloth that is collapsed onto a line goes uphill, and a line search never leaves that state.
    """
    garment = problem.garment
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
    return pin(problem, jnp.where(is_collapsed[:, None], position + _OFFSET * offset, position))
