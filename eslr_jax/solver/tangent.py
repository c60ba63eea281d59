"""The tangent stiffness: the potential's exact Hessian at one position, as an assembled sparse matrix.

Faces, hinges and vertices give small blocks, the automatic derivatives of their energies; a vertex's row holds
one block for each vertex that it shares a face or a hinge with. At 1k vertices a product takes a quarter of the
time of one gradient, and a tenth of a product by automatic differentiation. The blocks on the diagonal
precondition a solver of linear systems with a symmetric matrix, which need not be positive definite.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from eslr_jax.numerics import Vector3, components, product, segment_sum
from eslr_jax.solver.preconditioner import hessian_diagonal, sum_diagonals
from eslr_jax.terms.term import FrameProblem, free_vertices, mesh_corners, pin
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

    _, curved = jax.linearize(jax.grad(energy), corners)
    leaves, tree = jax.tree.flatten(corners)

    def column(unit: Float[Array, " size"]) -> Float[Array, "size items"]:
        move = [jnp.broadcast_to(one, leaf.shape) for one, leaf in zip(unit, leaves, strict=True)]
        return jnp.stack(jax.tree.leaves(curved(jax.tree.unflatten(tree, move))))

    return jax.vmap(column)(jnp.eye(len(leaves), dtype=leaves[0].dtype))


def _as_rows(blocks: Float[Array, "size size items"]) -> Float[Array, "rows 9"]:
    """Return the 3x3 blocks of every couple of corners, couple by couple."""
    parts = [
        blocks[3 * a : 3 * a + 3, 3 * b : 3 * b + 3].reshape(9, -1).T
        for a, b in itertools.product(range(blocks.shape[0] // 3), repeat=2)
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
        for row, column in itertools.product(range(items.shape[1]), repeat=2):
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
    couples = list(itertools.product(range(len(matrix.columns)), range(3)))
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


# --- linear systems ------------------------------------------------------------------------------------------

Operator = Callable[[Float[Array, "*shape"]], Float[Array, "*shape"]]


class LinearSolution(NamedTuple):
    """What became of a linear system H v = b."""

    displacement: Float[Array, "*shape"]  # v [m]
    residual: Float[Array, ""]  # relative to b, in the preconditioner's norm
    iterations: Int[Array, ""]
    is_indefinite: Bool[Array, ""]  # a direction of negative curvature was met


class _State(NamedTuple):
    """A Lanczos process and its QR factorisation; the names are those of the source."""

    x: Array
    r1: Array  # last Lanczos vector but one, without the preconditioner and not normalised
    r2: Array  # last one
    y: Array  # the last one, preconditioned
    w1: Array  # directions that x was moved along
    w2: Array
    beta: Array
    old_beta: Array
    cosine: Array
    sine: Array
    dbar: Array
    epsilon: Array
    phi: Array  # norm of the residual
    pivot: Array  # of the tridiagonal matrix's factorisation: negative where the matrix is not positive
    iterations: Array
    is_indefinite: Array


def solve_symmetric(
    apply: Operator,
    precondition: Operator,
    force: Float[Array, "*shape"],
    *,
    tolerance: float,
    iterations: int,
) -> LinearSolution:
    """Solve H v = force by preconditioned MINRES.

    Its residual never grows, also where H is indefinite. Conjugate gradients divide by curvatures, and in float32
    they stall where one is near zero.

    `apply` is the product with H, symmetric, and `precondition` that with an estimate of H^-1, symmetric and
    positive definite. The tolerance of the residual is relative to the force.

    Source: Paige and Saunders 1975, doi 10.1137/0712047.
    """
    y = precondition(force)
    whole = jnp.sqrt(_inner(force, y))
    zero, zeros = jnp.zeros((), force.dtype), jnp.zeros_like(force)

    def is_running(state: _State) -> Array:
        return (state.phi > tolerance * whole) & (state.iterations < iterations) & (state.beta > 0)

    def iterate(s: _State) -> _State:
        v = s.y / s.beta
        applied = apply(v) - s.beta / jnp.where(s.old_beta > 0, s.old_beta, 1.0) * s.r1
        alpha = _inner(v, applied)
        applied = applied - alpha / s.beta * s.r2
        y = precondition(applied)
        beta = jnp.sqrt(jnp.maximum(_inner(applied, y), 0.0))

        delta = s.cosine * s.dbar + s.sine * alpha
        gbar = s.sine * s.dbar - s.cosine * alpha
        gamma = jnp.hypot(gbar, beta)
        gamma = jnp.where(gamma > 0, gamma, jnp.finfo(v.dtype).tiny)
        cosine, sine = gbar / gamma, beta / gamma
        w = (v - s.epsilon * s.w1 - delta * s.w2) / gamma
        lost = jnp.where(s.pivot == 0, 0.0, s.beta**2 / jnp.where(s.pivot == 0, 1.0, s.pivot))
        pivot = alpha - jnp.where(s.iterations > 0, lost, 0.0)
        return _State(
            x=s.x + cosine * s.phi * w,
            r1=s.r2,
            r2=applied,
            y=y,
            w1=s.w2,
            w2=w,
            beta=beta,
            old_beta=s.beta,
            cosine=cosine,
            sine=sine,
            dbar=-s.cosine * beta,
            epsilon=s.sine * beta,
            phi=sine * s.phi,
            pivot=pivot,
            iterations=s.iterations + 1,
            is_indefinite=s.is_indefinite | (pivot < 0),
        )

    start = _State(
        x=zeros,
        r1=zeros,
        r2=force,
        y=y,
        w1=zeros,
        w2=zeros,
        beta=whole,
        old_beta=zero,
        cosine=-jnp.ones_like(zero),
        sine=zero,
        dbar=zero,
        epsilon=zero,
        phi=whole,
        pivot=zero,
        iterations=jnp.int32(0),
        is_indefinite=jnp.zeros((), bool),
    )
    end = jax.lax.while_loop(is_running, iterate, start)
    # The recursion's own residual goes on falling where rounding has stopped the true one.
    left = force - apply(end.x)
    residual = jnp.sqrt(_inner(left, precondition(left))) / jnp.where(whole > 0, whole, 1.0)
    return LinearSolution(end.x, residual, end.iterations, end.is_indefinite)


def _inner(left: Float[Array, "*shape"], right: Float[Array, "*shape"]) -> Float[Array, ""]:
    return product(left.ravel(), right.ravel())
