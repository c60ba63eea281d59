"""What a term of the potential is, one energy, and the problem of a frame, which is the sum of its terms."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from eslr_jax.config import import_own
from eslr_jax.errors import ConfigError, Status
from eslr_jax.numerics import Vector3, gather_corners, safe_norm, segment_sum
from eslr_jax.ranges import Range, check_number
from eslr_jax.types import BodyMotion, BodySurface, Contacts, Garment, Material, Obstacle

if TYPE_CHECKING:
    from eslr_jax.terms.worn import Worn

_LIMB_RADIUS = 0.05  # [m], of an upper arm or a shoulder: the sharpest that cloth rests on
# [J/m^5] per cloth area: HOOD's weight of 5e3 J/m^3 a vertex on its 4424-vertex, 0.628 m^2 T-shirt. A stiffer
# fabric than HOOD's has stiffer contacts, see `stretch.contact_excess`.
CONTACT_STIFFNESS = 3.5e7
CONTACT_THICKNESS = 2e-3  # [m] (HOOD)
STIFFNESS_RANGE = Range(0.0, 1e12, "J/m^5")  # of contact
THICKNESS_RANGE = Range(0.0, 5e-2, "m")
_GRAVITY = 9.81  # [m/s^2], of the unit of residuals where a scene has no gravity


class Elements(NamedTuple):
    """The summands of an energy, and the vertices that each of them depends on."""

    energies: Float[Array, " elements"]  # [J]
    vertices: Int[Array, "elements corners"]


class Term:
    """One energy of a frame's potential.

    A subclass is a frozen pytree (`flax.struct.dataclass`). Its fields are its constants, which are traced, and
    its choices, which are static. It has `corner_energies` if its elements are the faces, hinges or vertices of
    the mesh, else `elements`. All else has a default. `scene.terms` holds the terms that a scene models:
    potential, gradient, tangent, preconditioner, start, report and colours walk it.
    """

    name: ClassVar[str]  # in reports, colours and `Trajectory.energies`; terms of one name are added up
    on: ClassVar[Literal["faces", "hinges", "vertices"] | None] = None  # its elements; None: of its own
    is_elastic: ClassVar[bool] = False  # its curvature acts between neighbours, and not against a fixed place
    reads_body: ClassVar[bool] = False  # it reads `FrameProblem.body`
    unless_needed: ClassVar[str] = "not asked for"  # why a scene may lack it
    ranges: ClassVar[Mapping[str, Range]] = MappingProxyType({})  # of its constants, each one number

    def check(self) -> None:
        """Raise a ConfigError where one of its constants is not finite or out of its range (host)."""
        for field, accepted in self.ranges.items():
            check_number(f"{self.name} {field}", getattr(self, field), accepted)

    def plan(self, worn: Worn, others: Sequence[Term]) -> Term | None:
        """Return the term as a scene holds it, or None where the scene does not need it (host).

        It depends on the worn garment, and on the terms that stand before it, planned.
        """
        return self

    def clear_body(self, poses: BodyMotion) -> BodyMotion:
        """Return the motion of the body as the term can take it (host)."""
        return poses

    def alike(self, worn: Worn, planned: Sequence[Any]) -> Term:
        """Return the term for one scene of a batch, in the shape that all of them share (host).

        `planned` is the term as those scenes of the batch hold it that need it.
        """
        return planned[0]

    def start(
        self, position: Float[Array, "vertices 3"], garment: Garment, body: Obstacle | None
    ) -> Float[Array, "vertices 3"]:
        """Return the positions of frame 0 [m], moved out of what the term forbids."""
        return position

    def prepare(self, problem: FrameProblem) -> Any:
        """Return what is computed once a frame, from its state; `data` of the other methods.

        `problem` holds the terms that stand before this one, with their data.
        """
        return None

    def push_out(
        self, position: Float[Array, "vertices 3"], problem: FrameProblem, data: Any
    ) -> Float[Array, "vertices 3"]:
        """Return positions at t + 1 [m] with vertices moved out of an obstacle: where a frame starts."""
        return position

    def correct(
        self, position: Float[Array, "vertices 3"], problem: FrameProblem, data: Any
    ) -> tuple[Float[Array, "vertices 3"], Any]:
        """Return positions at t + 1 [m] as the frame ends with, in the place of those found, and its data."""
        return position, data

    def is_far(self, data: Any) -> Bool[Array, ""] | bool:
        """Return whether `correct` moved cloth so far that the frame is solved once more, from there on."""
        return False

    def touched(self, problem: FrameProblem, data: Any) -> tuple[Contacts, Float[Array, " vertices"]] | None:
        """Return the points that vertices rub on, and the normal forces at t [N]; None: nothing rubs."""
        return None

    def load(
        self, position: Float[Array, "vertices 3"], problem: FrameProblem, data: Any
    ) -> Float[Array, " vertices"] | float:
        """Return the normal force at t + 1 [N] that the next frame's `FrameProblem.friction_load` holds."""
        return 0.0

    def status(self, problem: FrameProblem, data: Any) -> Int[Array, ""]:
        """Return bits of `errors.Status`: what went wrong in `prepare`."""
        return jnp.int32(Status.OK)

    def is_passed(self, data: Any) -> Bool[Array, ""] | None:
        """Return whether something may have passed through the cloth; None where the term does not watch that."""
        return None

    def demand(self, data: Any) -> Int[Array, ""] | None:
        """Return the rows that a frame asks its buffer for; None without a buffer."""
        return None

    def enlarged(self, demand: int) -> Term | None:
        """Return the term with a buffer for so many rows; None where they have room (host)."""
        return None

    def corner_energies(
        self, corners: tuple[Vector3, ...], problem: FrameProblem, data: Any
    ) -> Float[Array, " elements"]:
        """Return the energy of every face, hinge or vertex [J], by components of its corners at t + 1 [m]."""
        raise TypeError(f"{type(self).__name__} needs `corner_energies` or `elements`")

    def elements(self, x: Vector3, problem: FrameProblem, data: Any) -> tuple[Elements, ...]:
        """Return the energies [J] of all elements at positions x at t + 1, by components [m]."""
        return (self._assembled(x, problem, data),)

    def _assembled(self, x: Vector3, problem: FrameProblem, data: Any) -> Elements:
        corners, vertices = mesh_corners(self.on, x, problem.garment)
        return Elements(self.corner_energies(corners, problem, data), vertices)

    def energy(self, x: Vector3, problem: FrameProblem, data: Any) -> Float[Array, ""]:
        """Return the energy [J] at positions x at t + 1, by components [m]."""
        parts = self.elements(x, problem, data)
        return sum((jnp.sum(part.energies) for part in parts), jnp.zeros((), x[0].dtype))

    def remainder(self, problem: FrameProblem) -> Callable[[Vector3, Any], Float[Array, ""]] | None:
        """Return the part of the energy that the blocks of `corner_energies` leave out; None where nothing is."""
        if self.on is not None:
            return None
        return lambda x, data: self.energy(x, problem, data)

    def diagonal(self, x: Vector3, problem: FrameProblem, data: Any) -> Float[Array, " vertices"] | float:
        """Return an estimate of the energy's curvature per vertex [N/m], along a direction in the mean."""
        return 0.0

    def describe(self, garment: Garment) -> str:
        """Return a few words on what it models (host)."""
        sizes = {
            "faces": garment.rest_areas,
            "hinges": garment.hinge_rest_areas,
            "vertices": garment.vertex_mask,
        }
        return "" if self.on is None else f"{int(np.sum(np.asarray(sizes[self.on]) > 0))} {self.on}"


def find_term(name: str) -> type[Term]:
    """Return the term of MODULE:CLASS; a ConfigError where there is no such module or term (host)."""
    module, _, kind = name.partition(":")
    found = getattr(import_own(module, f"term {name}"), kind, None) if module and kind else None
    if not (isinstance(found, type) and issubclass(found, Term)):
        raise ConfigError(
            f"term {name}: no class of this name derives from eslr_jax.terms.Term; write it as MODULE:CLASS"
        )
    return found


def mesh_corners(
    on: str | None, x: Vector3, garment: Garment
) -> tuple[tuple[Vector3, ...], Int[Array, "elements corners"]]:
    """Return the positions of the corners of faces, hinges or vertices, and the vertices that these are."""
    if on == "faces":
        return gather_corners(x, garment.faces, garment.face_incidence), garment.faces
    if on == "hinges":
        return gather_corners(x, garment.hinges, garment.hinge_incidence), garment.hinges
    return (x,), jnp.arange(x[0].shape[0], dtype=jnp.int32)[:, None]


def vertex_shares(parts: tuple[Elements, ...], num_vertices: int) -> Float[Array, " vertices"]:
    """Return energies [J] shared out over the vertices, those of an element evenly over its corners."""
    return sum(
        segment_sum(
            jnp.broadcast_to((energies / vertices.shape[1])[:, None], vertices.shape).ravel(),
            vertices.ravel(),
            num_vertices,
        )
        for energies, vertices in parts
    )  # type: ignore[return-value]


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
