"""Bending: dihedral angles at interior edges.

A material gives its bending in one of two ways. `bending_stiffness` k [J] is HOOD's: every hinge has an energy of
its own, and the flexural rigidity D [N m] of a sheet depends on its mesh. D is k / 4 for equilateral triangles,
and for a grid that is bent across its rows; for a grid that is bent across its diagonals it is up to 3 k / 4.
Measured on a cantilever, D is .82 times k / 4 for a grid, and .88 to 1.09 times k / 4 for irregular triangles
of 20 to 5 mm. A `plate` has the same, given flexural rigidity on any mesh, see `mesh.plate`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from eslr_jax.errors import ConfigError
from eslr_jax.numerics import Vector3, arctan2, cross3, dot3, gather_corners, gather_values, in_memory, sub3
from eslr_jax.terms.term import Elements, FrameProblem, Term
from eslr_jax.types import Garment, Material, Plate

RIGIDITY_PER_STIFFNESS = 0.25
"""[N m/J] of equilateral triangles: sqrt(3)/2 of the hinges' stiffness by angle, which is k / (2 sqrt(3)) there.

Source: Seung and Nelson 1988, doi 10.1103/PhysRevA.38.1005."""


@struct.dataclass
class Bending(Term):
    """The energy of hinges, or of a plate on the faces."""

    name = "bending"
    on = "hinges"

    def corner_energies(
        self, corners: tuple[Vector3, ...], problem: FrameProblem, data: Any
    ) -> Float[Array, " hinges"]:
        """Return the energy of every hinge [J]; of a plate, that of its nearest isotropic sheet's."""
        return hinge_energies(corners, problem.garment, problem.material)

    def elements(self, x: Vector3, problem: FrameProblem, data: Any) -> tuple[Elements, ...]:
        """Return the energies of the hinges, or of a plate's faces [J]."""
        garment, material = problem.garment, problem.material
        energies = angle_energies(dihedral_angles(x, garment), garment, material)
        return (Elements(energies, garment.hinges if material.plate is None else garment.faces),)

    def remainder(self, problem: FrameProblem) -> Callable[[Vector3, Any], Float[Array, ""]] | None:
        """Return what a plate adds to its hinges: those alone stand in the tangent, where they precondition."""
        if problem.material.plate is None:
            return None

        def beyond_hinges(x: Vector3, data: Any) -> Float[Array, ""]:
            return self.energy(x, problem, data) - jnp.sum(self._assembled(x, problem, data).energies)

        return beyond_hinges


def dihedral_angles(
    position: Float[Array, "vertices 3"] | Vector3, garment: Garment
) -> Float[Array, " hinges"]:
    """Return each hinge's signed angle [rad]; zero is flat.

    theta = atan2(e_hat . (n_a x n_b), n_a . n_b); the two area factors of the unnormalised normals cancel.
    A collapsed hinge has a zero gradient.
    """
    return _corner_angles(*hinge_corners(position, garment))


def hinge_corners(position: Float[Array, "vertices 3"] | Vector3, garment: Garment) -> tuple[Vector3, ...]:
    """Return the positions of the hinges' corners, by components [m], gathered once.

    XLA would repeat the gathers in every one of the twelve components of the gradient.
    """
    return jax.lax.optimization_barrier(gather_corners(position, garment.hinges, garment.hinge_incidence))


@jax.custom_jvp
def _corner_angles(start: Vector3, end: Vector3, left: Vector3, right: Vector3) -> Float[Array, " hinges"]:
    """Return the angle [rad] of every hinge given by its corners."""
    edge = sub3(end, start)
    normal_left = cross3(edge, sub3(left, start))
    normal_right = cross3(sub3(right, start), edge)
    squared_length = dot3(edge, edge)
    is_collapsed = squared_length == 0
    length = jnp.where(is_collapsed, 0.0, jnp.sqrt(jnp.where(is_collapsed, 1.0, squared_length)))
    # e_hat . (n_a x n_b) = -(n_a . (right - start)) |e|: the cross products share the edge.
    sine = -dot3(normal_left, sub3(right, start)) * length
    cosine = dot3(normal_left, normal_right)
    return arctan2(sine, cosine)


@_corner_angles.defjvp
def _corner_angles_jvp(primals, tangents):
    """Move every corner along its gradient: -|e| n / |n|^2 opposite the edge, levers of these at its ends.

    Closed form is up to seven times faster than what automatic differentiation leaves to XLA.

    Source: Tamstorf and Grinspun 2013, doi 10.1016/j.gmod.2013.07.001, section 4.
    """
    start, end, left, right = primals
    edge, to_left, to_right = sub3(end, start), sub3(left, start), sub3(right, start)
    normal_left, normal_right = cross3(edge, to_left), cross3(to_right, edge)
    squared_length, squared_left, squared_right = (dot3(v, v) for v in (edge, normal_left, normal_right))
    is_real = (squared_length > 0) & (squared_left > 0) & (squared_right > 0)
    squared_length, squared_left, squared_right = (
        jnp.where(is_real, squared, 1.0) for squared in (squared_length, squared_left, squared_right)
    )
    length = jnp.where(is_real, jnp.sqrt(squared_length), 0.0)
    levers = (
        -length / squared_left,
        -length / squared_right,
        dot3(to_left, edge) / squared_length,  # foot of the height along the edge, 0 at its start
        dot3(to_right, edge) / squared_length,
    )
    by_left, by_right, foot_left, foot_right = in_memory(*levers)
    to_start = tangents[0]
    to_end = sub3(tangents[1], to_start)
    change = jnp.zeros_like(by_left)
    for lever, foot, normal, corner in (
        (by_left, foot_left, normal_left, tangents[2]),
        (by_right, foot_right, normal_right, tangents[3]),
    ):
        apart = sub3(corner, to_start)
        lifted = (apart[0] - foot * to_end[0], apart[1] - foot * to_end[1], apart[2] - foot * to_end[2])
        change = change + lever * dot3(normal, lifted)
    # Its transpose stores the moment, which XLA would compute for every corner anew.
    (change,) = in_memory(change)
    return _corner_angles(*primals), change


def bending_energy(
    position: Float[Array, "vertices 3"] | Vector3, garment: Garment, material: Material
) -> Float[Array, ""]:
    """Return the bending energy [J], the sum of `angle_energies` at positions [m], shape [vertices, 3]."""
    return jnp.sum(angle_energies(dihedral_angles(position, garment), garment, material))


def hinge_energies(
    corners: tuple[Vector3, ...],
    garment: Garment,
    material: Material,
    *,
    use_current_length: bool = False,
) -> Float[Array, " hinges"]:
    """Return the bending energy of every hinge [J].

    E_h = k_b l^2 / (4 (A_a + A_b)) theta^2 / 2, with the bending stiffness k_b [J] and the areas at rest: fabric
    is flat at rest. `corners` are those of `hinge_corners`. `use_current_length` takes the edge's length l from
    them, as HOOD does, instead of from the rest mesh.

    Source: HOOD (arXiv 2212.07242); Grinspun et al. 2003, doi 10.2312/SCA03/062-067.
    """
    angle, edge = _corner_angles(*corners), sub3(corners[1], corners[0])
    stiffness = hinge_stiffnesses(garment, material, dot3(edge, edge) if use_current_length else None)
    return stiffness * angle * angle


def angle_energies(
    angle: Float[Array, " hinges"], garment: Garment, material: Material
) -> Float[Array, " hinges"] | Float[Array, " faces"]:
    """Return the energies [J] of hinges by their angles [rad], or of the faces of the material's plate.

    Raises:
        ConfigError: The material has a plate, and the garment is not of the shape that it was made for.
    """
    if material.plate is not None and garment.is_recut:
        raise ConfigError(
            "bending in N m does not follow a rest shape of with_rest_positions; give bending_stiffness instead, "
            "or prepare_garment with the new shape and describe the fabric for that"
        )
    if material.plate is None:
        return hinge_stiffnesses(garment, material) * angle * angle
    moments = plate_curvatures(angle, material.plate)
    return 0.5 * dot3(moments, moments)


def plate_curvatures(angle: Float[Array, " hinges"], plate: Plate) -> Vector3:
    """Return the curvatures of every face, along warp, along weft and mixed, by the angles of the hinges [rad].

    They are weighted, so that half the sum of their squares is the energy [J].
    """
    # In memory: XLA would compute the angles anew for every one of the nine places that read them.
    around = gather_values(*in_memory(angle), plate.hinges, plate.incidence)
    along, across, mixed = (sum(row[k] * around[k] for k in range(len(around))) for row in plate.rows)
    return along, across, mixed  # type: ignore[return-value]


def hinge_stiffnesses(
    garment: Garment, material: Material, squared_length: Float[Array, " hinges"] | None = None
) -> Float[Array, " hinges"]:
    """Return the energy of every hinge [J] by its squared angle; zero where padded.

    `squared_length` is that of the hinges' edges [m^2]; None takes it at rest.
    """
    if squared_length is None:
        squared_length = jnp.square(garment.hinge_rest_lengths)
    areas = garment.hinge_rest_areas
    is_real = areas > 0
    scale = jnp.where(is_real, squared_length / (4.0 * jnp.where(is_real, areas, 1.0)), 0.0)
    (stiffness,) = in_memory(0.5 * material.bending_stiffness * scale)
    return stiffness
