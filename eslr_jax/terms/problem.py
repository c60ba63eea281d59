"""The minimisation problem of one frame: all that its potential reads, constant while the cloth moves."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from eslr_jax.numerics import safe_norm
from eslr_jax.ranges import Range
from eslr_jax.terms.term import Term
from eslr_jax.types import BodySurface, Garment, Material

_LIMB_RADIUS = 0.05  # [m], of an upper arm or a shoulder: the sharpest that cloth rests on
# [J/m^5] per cloth area: HOOD's weight of 5e3 J/m^3 a vertex on its 4424-vertex, 0.628 m^2 T-shirt. A stiffer
# fabric than HOOD's has stiffer contacts, see `stretch.contact_excess`.
CONTACT_STIFFNESS = 3.5e7
CONTACT_THICKNESS = 2e-3  # [m] (HOOD)
STIFFNESS_RANGE = Range(0.0, 1e12, "J/m^5")  # of contact
THICKNESS_RANGE = Range(0.0, 5e-2, "m")
_GRAVITY = 9.81  # [m/s^2], of the unit of residuals where a scene has no gravity


@struct.dataclass
class MovingBody:
    """The part of the body that cloth can reach, at both ends of a frame."""

    surface: BodySurface
    start: Float[Array, "surface_vertices 3"]  # at t [m]
    end: Float[Array, "surface_vertices 3"]  # at t + 1 [m]


class SecondOrder(NamedTuple):
    """What BDF2 puts in the place of a frame's first positions and timestep, see `simulation.frame`."""

    origin: Float[Array, "vertices 3"]  # [m]
    timestep: Float[Array, ""]  # [s]


@struct.dataclass
class FrameProblem:
    """One step of implicit Euler, or of BDF2, as a minimisation. A part that is None is not modelled."""

    garment: Garment
    material: Material
    timestep: Float[Array, ""]  # [s]
    position: Float[Array, "vertices 3"]  # at t [m]
    # Where inertia alone takes the cloth [m], see `simulation.frame`.
    inertial_guess: Float[Array, "vertices 3"]
    time: Float[Array, ""] | float = 0.0  # at t + 1, since the scene's first frame [s]
    body: MovingBody | None = None
    friction_load: Float[Array, " vertices"] | float = 0.0  # normal force on the body at t [N]
    pin_targets: Float[Array, "vertices 3"] | None = None  # positions of pinned vertices at t + 1 [m]
    bdf2: SecondOrder | None = None  # None: implicit Euler
    terms: tuple[Term, ...] = ()  # whose sum is the potential
    data: tuple[Any, ...] = ()  # what each of them has prepared, see `with_terms`

    @property
    def inertial_timestep(self) -> Any:  # NumPy in float64 references
        """Time for which a frame's acceleration acts [s]."""
        return self.timestep if self.bdf2 is None else self.bdf2.timestep

    @property
    def origin(self) -> Float[Array, "vertices 3"]:
        """Positions from which a frame's velocity counts [m]: those at t, or what BDF2 puts in their place."""
        return self.position if self.bdf2 is None else self.bdf2.origin

    @property
    def parts(self) -> tuple[tuple[Term, Any], ...]:
        """Its terms, each with what it has prepared."""
        return tuple(zip(self.terms, self.data, strict=True))

    def data_of(self, kind: type[Term]) -> Any:
        """Return what the first term of a kind has prepared; None without one."""
        return next((data for term, data in self.parts if isinstance(term, kind)), None)

    @property
    def gravity(self) -> Any:
        """Acceleration of gravity [m/s^2]."""
        return next((term.acceleration for term in self.terms if term.name == "gravity"), 0.0)  # type: ignore[attr-defined]

    @property
    def masses(self) -> Float[Array, " vertices"]:
        """Lumped masses [kg], shape [vertices]; zero where padded."""
        return vertex_masses(self.garment, self.material)


def vertex_masses(garment: Garment, material: Material) -> Float[Array, " vertices"]:
    """Return lumped masses [kg]; zero for padded vertices."""
    return material.density * garment.vertex_areas


def with_terms(problem: FrameProblem, terms: tuple[Term, ...]) -> FrameProblem:
    """Return a problem whose potential is the sum of some terms, each prepared for the frame."""
    problem = problem.replace(terms=(), data=())
    for term in terms:
        data = term.prepare(problem)
        problem = problem.replace(terms=(*problem.terms, term), data=(*problem.data, data))
    return problem


def contact_thickness(garment: Garment, thickness: Float[Array, ""] | float) -> Float[Array, ""]:
    """Return the distance that vertices keep from the body or other layers [m]; a smooth sheet keeps `thickness`.

    Only vertices collide. Between two of them a straight edge of length l dips l^2 / (8 r) towards a limb of
    radius r, so that much is added: at 27 mm spacing (1k vertices) 1.8 mm, at 13 mm 0.4 mm.
    """
    squared_edge = 2.0 / jnp.sqrt(3.0) * garment.mean_vertex_area  # of equilateral triangles, two per vertex
    return thickness + squared_edge / (8.0 * _LIMB_RADIUS)


def free_vertices(problem: FrameProblem) -> Bool[Array, " vertices"]:
    """Return which vertices the solver moves: neither padding nor pinned."""
    garment = problem.garment
    return garment.vertex_mask if problem.pin_targets is None else garment.vertex_mask & ~garment.is_pinned


def weight_norm(problem: FrameProblem) -> Float[Array, ""]:
    """Return the norm of the vertices' weights [N], the unit of residuals."""
    is_weightless = all(term.name != "gravity" for term in problem.terms)
    return (_GRAVITY if is_weightless else problem.gravity) * safe_norm(problem.masses)


def pin(problem: FrameProblem, position: Float[Array, "vertices 3"]) -> Float[Array, "vertices 3"]:
    """Return positions [m], shape [vertices, 3], with pinned vertices where the body carries them."""
    if problem.pin_targets is None:
        return position
    return jnp.where(problem.garment.is_pinned[:, None], problem.pin_targets, position)
