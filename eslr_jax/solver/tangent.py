"""The tangent stiffness: the potential's exact Hessian at one position, as an assembled sparse matrix.

Faces, hinges and vertices give small blocks, the automatic derivatives of their energies; a vertex's row holds
one block for each vertex that it shares a face or a hinge with. At 1k vertices a product takes a quarter of the
time of one gradient, and a tenth of a product by automatic differentiation. The blocks on the diagonal
precondition a solver.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from eslr_jax.numerics import Vector3, components, segment_sum
from eslr_jax.solver.preconditioner import free_vertices, hessian_diagonal, sum_diagonals
from eslr_jax.terms.problem import FrameProblem, pin
from eslr_jax.terms.term import mesh_corners
from eslr_jax.types import Garment

_LEFT, _RIGHT = 2, 3  # the corners of a hinge that no edge joins


class Tangent(NamedTuple):
    """The Hessian of a frame's potential; for vertices that don't move it is the identity."""

    columns: Int[Array, "slots vertices"]  # vertex of every block in a vertex's row; its own comes first
    blocks: Float[Array, "slots 3 3 vertices"]  # [N/m]; zero where a slot is not used
    # Products with what no block holds: energies whose elements are no faces, hinges or vertices.
    others: Callable[[Float[Array, "vertices 3"]], Float[Array, "vertices 3"]] | None
    is_free: Bool[Array, "1 vertices"]


def tangent(problem: FrameProblem, position: Float[Array, "vertices 3"]) -> Tangent:
    """Return the potential's Hessian at positions [m]."""
    garment = problem.garment
    position = pin(problem, position)
    x = components(position)
    faces, hinges, vertices = (_element_blocks(on, x, problem) for on in ("faces", "hinges", "vertices"))
    rest = [
        (remainder, data)
        for term, data in problem.parts
        if (remainder := term.remainder(problem)) is not None
    ]
    others = None
    if rest:

        def remaining(x: Float[Array, "vertices 3"]) -> Float[Array, ""]:
            return sum(remainder(components(x), data) for remainder, data in rest)  # type: ignore[return-value]

        _, others = jax.linearize(jax.grad(remaining), position)
    columns, slots = _pattern(garment)
    values = jnp.concatenate([_as_rows(faces), _as_rows(hinges)])
    num_slots, num_vertices = columns.shape
    rows = segment_sum(values, slots, num_slots * num_vertices)
    blocks = rows.reshape(num_vertices, num_slots, 3, 3).transpose(1, 2, 3, 0)
    return Tangent(columns, blocks.at[0].add(vertices), others, free_vertices(problem)[None])


def _element_blocks(on: str, x: Vector3, problem: FrameProblem) -> Float[Array, "size size items"]:
    """Return the Hessian [N/m], by their corners, of the energies of all faces, hinges or vertices."""
    corners, _ = mesh_corners(on, x, problem.garment)

    def energy(corners: tuple[Vector3, ...]) -> Float[Array, ""]:
        energies = (
            jnp.sum(term.corner_energies(corners, problem, data))
            for term, data in problem.parts
            if term.on == on
        )
        return sum(energies, jnp.zeros((), x[0].dtype))

    _, product = jax.linearize(jax.grad(energy), corners)
    leaves, tree = jax.tree.flatten(corners)

    def column(unit: Float[Array, " size"]) -> Float[Array, "size items"]:
        move = [jnp.broadcast_to(one, leaf.shape) for one, leaf in zip(unit, leaves, strict=True)]
        return jnp.stack(jax.tree.leaves(product(jax.tree.unflatten(tree, move))))

    return jax.vmap(column)(jnp.eye(len(leaves), dtype=leaves[0].dtype))


def _couples(corners: int) -> list[tuple[int, int]]:
    """Return the ordered pairs of an item's corners."""
    return [(row, column) for row in range(corners) for column in range(corners)]


def _as_rows(blocks: Float[Array, "size size items"]) -> Float[Array, "rows 9"]:
    """Return the 3x3 blocks of every couple of corners, couple by couple."""
    parts = [
        blocks[3 * a : 3 * a + 3, 3 * b : 3 * b + 3].reshape(9, -1).T
        for a, b in _couples(blocks.shape[0] // 3)
    ]
    return jnp.concatenate(parts)


def _pattern(garment: Garment) -> tuple[Int[Array, "slots vertices"], Int[Array, " rows"]]:
    """Return the matrix's columns, and where in it (vertex, slot) every block of faces and hinges goes.

    A row has a slot for its own vertex, one for each neighbour, and one for each hinge that it is an outer corner
    of, whose other outer corner no edge joins to it.
    """
    num_vertices, degree = garment.neighbors.shape
    own = jnp.arange(num_vertices, dtype=garment.neighbors.dtype)[:, None]
    columns = jnp.concatenate([own, garment.neighbors], axis=1)
    num_hinges = garment.hinges.shape[0]
    if num_hinges:
        corner, hinge = garment.hinge_incidence // num_hinges, garment.hinge_incidence % num_hinges
        is_outer = (corner == _LEFT) | (corner == _RIGHT)
        across = garment.hinges[hinge, jnp.where(is_outer, _LEFT + _RIGHT - corner, 0)]
        # A vertex is an outer corner of at most as many hinges as it has faces: those come first.
        first = jnp.argsort(~is_outer, axis=1)[:, : garment.face_incidence.shape[1]]
        across = jnp.take_along_axis(jnp.where(is_outer, across, own), first, axis=1)
        places = jnp.take_along_axis(garment.hinge_incidence, first, axis=1)
        columns = jnp.concatenate([columns, across], axis=1)

    slots = []
    for items in (garment.faces, garment.hinges) if num_hinges else (garment.faces,):
        for row, column in _couples(items.shape[1]):
            vertex = items[:, row]
            if row == column:
                slot = jnp.zeros_like(vertex)
            elif {row, column} == {_LEFT, _RIGHT}:
                place = row * num_hinges + jnp.arange(num_hinges, dtype=vertex.dtype)
                slot = 1 + degree + _find(places[vertex], place)
            else:
                slot = 1 + _find(garment.neighbors[vertex], items[:, column])
            slots.append(vertex * columns.shape[1] + slot)
    return columns.T, jnp.concatenate(slots)


def _find(rows: Int[Array, "items width"], values: Int[Array, " items"]) -> Int[Array, " items"]:
    """Return where in its row every value is."""
    return sum(jnp.where(rows[:, place] == values, place, 0) for place in range(rows.shape[1]))  # type: ignore[return-value]


def apply(matrix: Tangent, move: Float[Array, "3 vertices"]) -> Float[Array, "3 vertices"]:
    """Return the forces [N] that a displacement [m] raises, both by components."""
    free = jnp.where(matrix.is_free, move, 0.0)
    # Gathered at once, and the sum written out: a loop over the slots takes four times as long on a CPU.
    others = jax.lax.optimization_barrier(free.T[matrix.columns])
    couples = [(slot, column) for slot in range(len(matrix.columns)) for column in range(3)]
    rows = [
        sum(matrix.blocks[slot, row, column] * others[slot, :, column] for slot, column in couples)
        for row in range(3)
    ]
    force = jnp.stack(rows)  # type: ignore[arg-type]
    if matrix.others is not None:
        force = force + matrix.others(free.T).T
    return jnp.where(matrix.is_free, force, move)


def precondition(inverse: Float[Array, "3 3 vertices"], force: Float[Array, "3 vertices"]) -> Array:
    """Return displacements [m] from inverse blocks and forces [N], both by components."""
    # Written out: XLA does not vectorise the sum over an axis in front on a CPU.
    return jnp.stack([sum(inverse[row, column] * force[column] for column in range(3)) for row in range(3)])


def inverse_diagonal(
    matrix: Tangent, problem: FrameProblem, position: Float[Array, "vertices 3"]
) -> Float[Array, "3 3 vertices"]:
    """Return the inverses of the blocks on the diagonal [m/N]; of an estimate where one is indefinite."""
    unit = jnp.eye(3, dtype=position.dtype)[:, :, None]
    beyond = sum_diagonals(problem, position, lambda term: term.remainder(problem) is not None)
    blocks = matrix.blocks[0] + unit * beyond[None, None]
    a, b, c, d, e, f = (blocks[i, j] for i in range(3) for j in range(i, 3))
    cofactors = (d * f - e * e, c * e - b * f, b * e - c * d, a * f - c * c, b * c - a * e, a * d - b * b)
    determinant = a * cofactors[0] + b * cofactors[1] + c * cofactors[2]
    is_free = matrix.is_free[0]
    is_positive = (a > 0) & (cofactors[5] > 0) & (determinant > 0) & is_free
    order = jnp.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
    inverse = jnp.stack(cofactors)[order] / jnp.where(is_positive, determinant, 1.0)[None, None]
    estimate = jnp.where(is_free, 1.0 / hessian_diagonal(problem, position), 1.0)
    return jnp.where(is_positive, inverse, unit * estimate[None, None])
