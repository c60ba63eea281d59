"""Projected Newton on the host, in float64: the reference minimum of one frame's potential.

The energy and its gradient are the package's own, evaluated in float64; the matrix is the sum of element
Hessians made positive semi-definite in closed form, factorised by a banded Cholesky after reverse
Cuthill-McKee ordering.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
import scipy.linalg
import scipy.sparse
from jaxtyping import Float
from scipy.sparse.csgraph import reverse_cuthill_mckee

from eslr_jax.physics import hessian
from eslr_jax.physics.guess import pushed_out_guess
from eslr_jax.physics.potential import potential
from eslr_jax.terms.problem import FrameProblem
from eslr_jax.types import tree_cast

_ARMIJO = 1e-4  # sufficient decrease (Nocedal and Wright 2006, section 3.1)
_MAX_HALVINGS = 40


class NewtonMinimum(NamedTuple):
    """Where projected Newton stopped."""

    position: Float[np.ndarray, "vertices 3"]  # [m]
    value: float  # [J]
    residual: float  # force norm over weight
    iterations: int
    is_converged: bool  # the residual is below the tolerance


class _Bands(NamedTuple):
    """Where the entries of element blocks go in the lower bands of the ordered matrix."""

    order: np.ndarray  # free degree of freedom at each row of the matrix, as an index into positions.ravel()
    entries: np.ndarray  # flat positions in all blocks, raveled one after the other, that are kept
    targets: np.ndarray  # flat position in the bands of every kept entry
    places: np.ndarray  # row of the matrix of every degree of freedom, -1 where fixed
    shape: tuple[int, int]  # bands, rows


def minimize_newton(
    problem: FrameProblem,
    start: Float[np.ndarray, "vertices 3"] | None = None,
    *,
    tolerance: float = 1e-6,
    max_iterations: int = 300,
) -> NewtonMinimum:
    """Minimise one frame's potential by projected Newton with an Armijo line search.

    Args:
        problem: The frame's problem.
        start: Initial positions [m], shape [vertices, 3]; the pushed-out inertial guess by default.
        tolerance: Stop when the force norm falls below this share of the vertex weights' norm.
        max_iterations: Upper bound of factorisations.

    Source: Teran et al. 2005, doi 10.1145/1073368.1073394 (projected Newton).
    """
    problem = to_float64(problem)
    evaluate = _evaluator(problem)
    bands = _find_bands(problem)
    weight = float(problem.constants.gravity) * np.linalg.norm(hessian.float64_masses(problem))

    if start is None:
        with jax.enable_x64(True):
            start = np.asarray(_guess(problem))
    x = np.array(start, np.float64)
    if problem.pin_targets is not None:
        x = np.where(np.asarray(problem.garment.is_pinned)[:, None], problem.pin_targets, x)
    value, gradient = evaluate(x)
    iterations = 0
    while np.linalg.norm(gradient) > tolerance * weight and iterations < max_iterations:
        direction = _newton_direction(x, gradient, problem, bands)
        found = _line_search(evaluate, x, value, gradient, direction)
        iterations += 1
        if found is None:
            break
        x, value, gradient = found
    residual = float(np.linalg.norm(gradient) / weight)
    return NewtonMinimum(x, value, residual, iterations, residual <= tolerance)


def potential_float64(position: Float[Any, "vertices 3"], problem: FrameProblem) -> float:
    """Return the potential at positions [m], shape [vertices, 3], in float64 [J]."""
    return _evaluator(to_float64(problem))(np.asarray(position, np.float64))[0]


def to_float64(tree: Any) -> Any:
    """Return a pytree with NumPy leaves, the floating ones in float64."""
    with jax.enable_x64(True):
        return tree_cast(jax.tree.map(np.asarray, tree), np.float64)


_value_and_gradient = jax.jit(jax.value_and_grad(potential))
_guess = jax.jit(pushed_out_guess)


def _evaluator(problem: FrameProblem) -> Callable:
    """Return a function from positions to the potential [J] and its gradient [N] in float64."""
    with jax.enable_x64(True):
        constant = jax.device_put(problem)

    def evaluate(position: np.ndarray) -> tuple[float, np.ndarray]:
        with jax.enable_x64(True):
            value, gradient = _value_and_gradient(position, constant)
            return float(value), np.asarray(gradient)

    return evaluate


def _free_vertices(problem: FrameProblem) -> np.ndarray:
    """Return which vertices may move, shape [vertices]: real ones that no pin holds."""
    is_free = np.array(problem.garment.vertex_mask, bool)
    if problem.pin_targets is not None:
        is_free &= ~np.asarray(problem.garment.is_pinned)
    return is_free


def _find_bands(problem: FrameProblem) -> _Bands:
    """Order the free vertices so that the matrix has a narrow band, and map the blocks' entries to it."""
    is_free = _free_vertices(problem)
    count = len(is_free)
    tables = (
        np.asarray(problem.garment.faces),
        np.asarray(problem.garment.hinges),
        hessian.pair_table(None if problem.layers is None else problem.layers.pairs, 4),
        hessian.pair_table(None if problem.body is None else problem.body.tips, 3),
        np.arange(count)[:, None],
    )
    coupled = _plate_couples(problem)
    rows, columns = (np.concatenate(part) for part in zip(*map(_couples, tables), coupled, strict=True))
    links = scipy.sparse.csr_matrix((np.ones(len(rows), bool), (rows, columns)), shape=(count, count))
    ordered = reverse_cuthill_mckee(links, symmetric_mode=True)
    ordered = ordered[is_free[ordered]]
    place = np.full(count, -1)
    place[ordered] = np.arange(len(ordered))

    couples = [_dof_couples(place[table]) for table in tables]
    row, column = (np.concatenate(part) for part in zip(*couples, strict=True))
    entries = np.flatnonzero((row >= column) & (column >= 0))
    row, column = row[entries], column[entries]
    width = int(np.max(row - column, initial=0)) + 1
    is_moved = (place[coupled[0]] >= 0) & (place[coupled[1]] >= 0)
    reach = np.abs(place[coupled[0]] - place[coupled[1]])[is_moved]
    shape = (max(width, 3 * int(np.max(reach, initial=0)) + 3), 3 * len(ordered))
    order = (3 * ordered[:, None] + np.arange(3)).ravel()
    places = np.full(3 * count, -1)
    places[order] = np.arange(len(order))
    return _Bands(order, entries, (row - column) * shape[1] + column, places, shape)


def _plate_couples(problem: FrameProblem) -> tuple[np.ndarray, np.ndarray]:
    """Return the pairs of vertices that the bending of a plate couples."""
    garment, material = problem.garment, problem.material
    if material.plate is None:
        return np.zeros(0, int), np.zeros(0, int)
    hinges = np.asarray(material.plate.hinges)
    # Where a face has no neighbour the table holds the first hinge, with rows of zeros.
    face, slot = np.nonzero(np.any(np.asarray(material.plate.rows) != 0, axis=0).T)
    corners = np.asarray(garment.hinges)[hinges[face, slot]]
    near = scipy.sparse.csr_array(
        (np.ones(corners.size), (np.repeat(face, corners.shape[1]), corners.ravel())),
        shape=(len(hinges), len(garment.vertex_mask)),
    )
    return (near.T @ near).nonzero()


def _couples(table: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return all ordered pairs of the columns of a table, as rows and columns of a matrix."""
    corners = table.shape[1]
    return np.repeat(table, corners, axis=1).ravel(), np.tile(table, (1, corners)).ravel()


def _dof_couples(places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return matrix rows and columns of all entries of the elements' blocks; -1 for fixed vertices."""
    dofs = np.where(places[:, :, None] >= 0, 3 * places[:, :, None] + np.arange(3), -1)
    return _couples(dofs.reshape(len(places), 3 * places.shape[1]))


def _newton_direction(
    x: np.ndarray, gradient: np.ndarray, problem: FrameProblem, bands: _Bands
) -> np.ndarray:
    """Return minus the inverse of the projected Hessian times the gradient [m]; zero where fixed."""
    blocks = (
        hessian.stretch_blocks(x, problem.garment, problem.material),
        hessian.bending_blocks(x, problem.garment, problem.material),
        hessian.layer_blocks(x, problem),
        hessian.tip_blocks(x, problem),
        hessian.vertex_blocks(x, problem),
    )
    values = np.concatenate([block.ravel() for block in blocks])[bands.entries]
    size = bands.shape[0] * bands.shape[1]
    matrix = np.bincount(bands.targets, values, minlength=size)
    plate = hessian.plate_matrix(x, problem.garment, problem.material).tocoo()
    row, column = bands.places[plate.row], bands.places[plate.col]
    is_kept = (row >= column) & (column >= 0)
    row, column = row[is_kept], column[is_kept]
    matrix += np.bincount((row - column) * bands.shape[1] + column, plate.data[is_kept], minlength=size)
    matrix = matrix.reshape(bands.shape)
    solution = scipy.linalg.solveh_banded(
        matrix, gradient.ravel()[bands.order], overwrite_ab=True, lower=True, check_finite=False
    )
    direction = np.zeros(gradient.size)
    direction[bands.order] = -solution
    return direction.reshape(gradient.shape)


def _line_search(
    evaluate: Callable, x: np.ndarray, value: float, gradient: np.ndarray, direction: np.ndarray
) -> tuple[np.ndarray, float, np.ndarray] | None:
    """Halve the step until the energy falls enough; None if it never does."""
    slope = float(np.sum(gradient * direction))
    slack = 4 * np.finfo(np.float64).eps * abs(value)
    for halvings in range(_MAX_HALVINGS):
        size = 0.5**halvings
        candidate = x + size * direction
        new_value, new_gradient = evaluate(candidate)
        if new_value <= value + _ARMIJO * size * slope + slack:
            return candidate, new_value, new_gradient
    return None
