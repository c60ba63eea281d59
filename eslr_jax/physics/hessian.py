"""Positive semi-definite Hessians of single elements, in closed form and float64 NumPy (host).

Every function returns one small dense block per face, hinge or vertex; `newton` sums them into a matrix.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Float, Int

from eslr_jax.terms.bending import hinge_stiffnesses
from eslr_jax.terms.problem import FrameProblem
from eslr_jax.terms.repulsion import Pairs
from eslr_jax.terms.stretch import STIFFENING
from eslr_jax.types import Contacts, Garment, Material, Threads


def project_symmetric_2x2(
    a: Float[np.ndarray, " blocks"], b: Float[np.ndarray, " blocks"], c: Float[np.ndarray, " blocks"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the entries of [[a, b], [b, c]] with its negative eigenvalues set to zero.

    With mean m = (a + c) / 2, half difference d = (a - c) / 2 and r = sqrt(d^2 + b^2) the eigenvalues are
    m + r and m - r, and the projector onto the first is (I + [[d, b], [b, -d]] / r) / 2.
    """
    mean, half = 0.5 * (a + c), 0.5 * (a - c)
    radius = np.hypot(half, b)
    larger, smaller = np.maximum(mean + radius, 0.0), np.maximum(mean - radius, 0.0)
    middle = 0.5 * (larger + smaller)
    slope = 0.5 * (larger - smaller) / np.where(radius > 0, radius, 1.0)
    return middle + slope * half, slope * b, middle - slope * half


def stretch_blocks(
    position: Float[np.ndarray, "vertices 3"], garment: Garment, material: Material
) -> Float[np.ndarray, "faces 9 9"]:
    """Return the projected Hessian of the membrane energy per face [N/m], rows by corner, then axis.

    In the frame of the singular vectors, F = U diag(s_1, s_2) V^T, the 6x6 Hessian with respect to F falls
    into two 2x2 blocks (stretch; shear and spin) and the two stresses that act out of the plane.

    Args:
        position: Vertex positions [m].
        garment: Rest areas and frames; NumPy leaves.
        material: Thickness [m] and Lame parameters [Pa].

    Source: Kim and Eberle 2022, Dynamic Deformables, section 7 (analytic eigensystems), for a 3x2 F.
    """
    corners = position[garment.faces]
    inverse = np.asarray(garment.inverse_rest_frames, np.float64)
    weights = np.stack([inverse[:, 0], inverse[:, 1], -inverse[:, 0] - inverse[:, 1]], axis=1)  # dF / dx_c
    gradient = np.einsum("fca,fcj->faj", corners, weights)
    if material.threads is not None:
        return _thread_blocks(gradient, weights, garment, material.threads)
    left, stretch, right = np.linalg.svd(gradient, full_matrices=True)
    s1, s2 = stretch[:, 0], stretch[:, 1]
    mu, lame_lambda = np.asarray(material.lame_mu, np.float64), np.asarray(material.lame_lambda, np.float64)
    g1, g2 = 0.5 * (s1 * s1 - 1.0), 0.5 * (s2 * s2 - 1.0)
    stress1 = 2.0 * mu * g1 + lame_lambda * (g1 + g2)
    stress2 = 2.0 * mu * g2 + lame_lambda * (g1 + g2)

    modulus = 2.0 * mu + lame_lambda
    block = np.zeros((len(corners), 3, 2, 3, 2))
    a, b, c = project_symmetric_2x2(
        stress1 + modulus * s1 * s1, lame_lambda * s1 * s2, stress2 + modulus * s2 * s2
    )
    block[:, 0, 0, 0, 0], block[:, 1, 1, 1, 1] = a, c
    block[:, 0, 0, 1, 1] = block[:, 1, 1, 0, 0] = b
    a, b, c = project_symmetric_2x2(stress2 + mu * s1 * s1, mu * s1 * s2, stress1 + mu * s2 * s2)
    block[:, 0, 1, 0, 1], block[:, 1, 0, 1, 0] = a, c  # F_12 feels the stress along 2
    block[:, 0, 1, 1, 0] = block[:, 1, 0, 0, 1] = b
    block[:, 2, 0, 2, 0], block[:, 2, 1, 2, 1] = np.maximum(stress1, 0.0), np.maximum(stress2, 0.0)

    rotated = np.einsum("fcj,fkj->fck", weights, right)  # right holds V^T
    jacobian = np.einsum("fai,fcj->fijca", left, rotated).reshape(-1, 6, 9)
    scale = np.asarray(garment.rest_areas, np.float64) * np.asarray(material.thickness, np.float64)
    block = block.reshape(-1, 6, 6) * scale[:, None, None]
    return jacobian.transpose(0, 2, 1) @ block @ jacobian


def _thread_blocks(
    gradient: Float[np.ndarray, "faces 3 2"],
    weights: Float[np.ndarray, "faces 3 2"],
    garment: Garment,
    threads: Threads,
) -> Float[np.ndarray, "faces 9 9"]:
    """Return the Hessian of the membrane energy of threads per face [N/m], without the part of compression.

    Two terms: the stiffness by the strain's derivative on both sides, and the stress, projected, on dF twice.

    Args:
        gradient: Deformation gradient F.
        weights: Its derivative by the corners, dF / dx_c [1/m].
        garment: Rest areas.
        threads: Their directions and stiffness.
    """
    warp = np.asarray(threads.warp, np.float64)
    turn = np.stack([warp, np.stack([-warp[:, 1], warp[:, 0]], axis=1)], axis=2)
    gradient, weights = gradient @ turn, weights @ turn
    strain = 0.5 * (np.einsum("fai,faj->fij", gradient, gradient) - np.eye(2))
    along, across, coupling, shear = np.asarray(threads.stiffness, np.float64)
    on_warp = along * strain[:, 0, 0] + coupling * strain[:, 1, 1]
    on_weft = across * strain[:, 1, 1] + coupling * strain[:, 0, 0]
    if threads.limits is not None:
        limits = np.asarray(threads.limits, np.float64)
        beyond = [np.maximum(strain[:, k, k] - limits[k], 0.0) / STIFFENING for k in range(2)]
        on_warp = on_warp + 0.5 * along * STIFFENING * beyond[0] ** 2
        on_weft = on_weft + 0.5 * across * STIFFENING * beyond[1] ** 2
        along, across = along * (1.0 + beyond[0]), across * (1.0 + beyond[1])
    a, b, c = project_symmetric_2x2(on_warp, 2.0 * shear * strain[:, 0, 1], on_weft)
    stress = np.stack([np.stack([a, b], axis=1), np.stack([b, c], axis=1)], axis=1)
    # d(G_ij) by corner and axis, for warp, weft and mixed.
    rows = [
        np.einsum("fa,fc->fca", gradient[:, :, i], weights[:, :, j])
        + np.einsum("fa,fc->fca", gradient[:, :, j], weights[:, :, i])
        for i, j in ((0, 0), (1, 1), (0, 1))
    ]
    rows = 0.5 * np.stack(rows, axis=1).reshape(-1, 3, 9)
    zero = np.zeros_like(along)
    moduli = [[along, coupling, zero], [coupling, across, zero], [zero, zero, 4.0 * shear]]
    block = np.einsum("fri,rsf,fsj->fij", rows, np.array(moduli), rows)
    geometric = np.einsum("fci,fij,fdj->fcd", weights, stress, weights)
    block = block + np.einsum("fcd,ab->fcadb", geometric, np.eye(3)).reshape(-1, 9, 9)
    return block * np.asarray(garment.rest_areas, np.float64)[:, None, None]


def dihedral_gradients(
    position: Float[np.ndarray, "vertices 3"], garment: Garment
) -> Float[np.ndarray, "hinges 4 3"]:
    """Return the derivative of every hinge's angle by its four vertices [1/m]; zero where it is collapsed.

    Source: Tamstorf and Grinspun 2013, doi 10.1016/j.gmod.2013.07.001, section 4.
    """
    start, end, left, right = np.swapaxes(position[garment.hinges], 0, 1)
    edge = end - start
    normal_left, normal_right = np.cross(edge, left - start), np.cross(right - start, edge)
    squared_left, squared_right = np.sum(normal_left**2, axis=1), np.sum(normal_right**2, axis=1)
    squared_edge = np.sum(edge**2, axis=1)
    is_real = (squared_left > 0) & (squared_right > 0) & (squared_edge > 0)
    squared_edge = np.where(is_real, squared_edge, 1.0)
    length = np.where(is_real, np.sqrt(squared_edge), 0.0)
    by_left = -(length / np.where(is_real, squared_left, 1.0))[:, None] * normal_left
    by_right = -(length / np.where(is_real, squared_right, 1.0))[:, None] * normal_right
    foot_left = (np.sum((left - start) * edge, axis=1) / squared_edge)[:, None]
    foot_right = (np.sum((right - start) * edge, axis=1) / squared_edge)[:, None]
    by_start = -(1.0 - foot_left) * by_left - (1.0 - foot_right) * by_right
    by_end = -foot_left * by_left - foot_right * by_right
    return np.stack([by_start, by_end, by_left, by_right], axis=1)


def bending_blocks(
    position: Float[np.ndarray, "vertices 3"], garment: Garment, material: Material
) -> Float[np.ndarray, "hinges 12 12"]:
    """Return the Gauss-Newton Hessian of the bending energy per hinge [N/m]: stiffness times g g^T.

    Zero for a plate, whose hinges are not apart: see `plate_matrix`.
    """
    if material.plate is not None:
        return np.zeros((len(garment.hinges), 12, 12))
    gradient = dihedral_gradients(position, garment).reshape(-1, 12)
    with jax.enable_x64(True):
        stiffness = 2.0 * np.asarray(hinge_stiffnesses(*jax.tree.map(jnp.asarray, (garment, material))))
    return stiffness[:, None, None] * gradient[:, :, None] * gradient[:, None, :]


def plate_matrix(
    position: Float[np.ndarray, "vertices 3"], garment: Garment, material: Material
) -> scipy.sparse.csr_array:
    """Return the Gauss-Newton Hessian of a plate's bending [N/m], by positions.ravel(); None has no entries."""
    count, plate = position.size, material.plate
    if plate is None:
        return scipy.sparse.csr_array((count, count))
    gradient = dihedral_gradients(position, garment).reshape(-1, 12)
    places = (3 * np.asarray(garment.hinges)[:, :, None] + np.arange(3)).reshape(-1, 12)
    angles = _sparse_rows(gradient, places, count)
    rows = np.asarray(plate.rows, np.float64)
    table = np.broadcast_to(np.asarray(plate.hinges), (len(rows), *plate.hinges.shape))
    weights = rows.transpose(0, 2, 1)
    curvatures = _sparse_rows(
        weights.reshape(-1, table.shape[2]), table.reshape(-1, table.shape[2]), len(gradient)
    )
    curvatures.eliminate_zeros()  # of hinges that are none, which stand as the first
    by_position = curvatures @ angles
    return scipy.sparse.csr_array(by_position.T @ by_position)


def _sparse_rows(values: np.ndarray, columns: np.ndarray, width: int) -> scipy.sparse.csr_array:
    """Return a matrix whose rows hold values at columns, both of shape [rows, entries]."""
    rows = np.repeat(np.arange(len(values)), values.shape[1])
    return scipy.sparse.csr_array((values.ravel(), (rows, columns.ravel())), shape=(len(values), width))


def vertex_blocks(
    position: Float[np.ndarray, "vertices 3"], problem: FrameProblem
) -> Float[np.ndarray, "vertices 3 3"]:
    """Return the Hessian of inertia, collision and friction per vertex [N/m]; all positive semi-definite."""
    with jax.enable_x64(True):
        timestep = float(jax.tree.map(jnp.asarray, problem).inertial_timestep)
    blocks = (float64_masses(problem) / timestep**2)[:, None, None] * np.eye(3)
    if problem.body is not None:
        for contacts in (problem.body.nearest, problem.body.opposing):
            blocks = blocks + _collision_blocks(position, contacts, problem.body.thickness, problem)
        blocks = blocks + _friction_blocks(
            position, problem.body.nearest, problem.body.friction_load, problem
        )
    if problem.ground is not None:
        contacts = problem.ground.contacts
        blocks = blocks + _collision_blocks(position, contacts, problem.ground.thickness, problem)
        blocks = blocks + _friction_blocks(position, contacts, problem.ground.friction_load, problem)
    return blocks


def float64_masses(problem: FrameProblem) -> Float[np.ndarray, " vertices"]:
    """Return the vertices' masses [kg], of a problem in float64."""
    with jax.enable_x64(True):
        return np.asarray(jax.tree.map(jnp.asarray, problem).masses)


def _collision_blocks(
    position: np.ndarray, contacts: Contacts, thickness: Any, problem: FrameProblem
) -> Float[np.ndarray, "vertices 3 3"]:
    """Return 6 k a depth n n^T per vertex."""
    normal = np.asarray(contacts.next_normals, np.float64)
    height = np.sum((position - contacts.next_points) * normal, axis=1)
    depth = np.where(contacts.is_near, np.maximum(float(thickness) - height, 0.0), 0.0)
    areas = np.asarray(problem.garment.vertex_areas)
    stiffness = 6.0 * float(problem.constants.collision_stiffness) * areas * depth
    return stiffness[:, None, None] * normal[:, :, None] * normal[:, None, :]


def _friction_blocks(
    position: np.ndarray, contacts: Contacts, loads: Any, problem: FrameProblem
) -> Float[np.ndarray, "vertices 3 3"]:
    """Return mu N (I - n n^T - u u^T / l^2) / l per vertex, with l = sqrt(|u|^2 + s^2)."""
    constants = problem.constants
    normal = np.asarray(contacts.next_normals, np.float64)
    motion = (position - problem.position) - (contacts.next_points - contacts.points)
    tangential = motion - np.sum(motion * normal, axis=1, keepdims=True) * normal
    slip = float(constants.friction_speed) * float(problem.timestep)
    length = np.sqrt(np.sum(tangential**2, axis=1) + slip**2)
    direction = tangential / length[:, None]
    # Unit normals are so up to float32 rounding, or zero off the body: I - n n^T is semi-definite.
    outer = [vector[:, :, None] * vector[:, None, :] for vector in (normal, direction)]
    curvature = np.eye(3) - outer[0] - outer[1]
    load = float(constants.friction_coefficient) * np.asarray(loads, np.float64)
    return (load / length)[:, None, None] * curvature


def layer_blocks(
    position: Float[np.ndarray, "vertices 3"], problem: FrameProblem
) -> Float[np.ndarray, "pairs 12 12"]:
    """Return the Hessian of the repulsion between layers per pair in use [N/m]; see `tip_blocks`."""
    if problem.layers is None:
        return np.zeros((0, 12, 12))
    pairs, stiffness = problem.layers.pairs, float(problem.constants.repulsion_stiffness)
    is_used = np.asarray(pairs.side) != 0
    weights, is_edge = np.asarray(pairs.weights, np.float64)[is_used], np.asarray(pairs.is_edge)[is_used]
    corners = position[np.asarray(pairs.corners)[is_used]]
    offset = np.einsum("pk,pka->pa", weights, corners)
    # From which corner to which the two edges go that the normal is across; see `layer_heights`.
    ends = np.where(is_edge[:, None], [0, 1, 2, 3], [1, 2, 1, 3])
    rows = np.arange(len(ends))
    start, end, other_start, other_end = (corners[rows, ends[:, k]] for k in range(4))
    sides = end - start, other_end - other_start
    height, normal, first, second = _turning_height(offset, *sides, np.asarray(pairs.side)[is_used])
    gradient = weights[:, :, None] * normal[:, None]
    for corner, turn in zip(ends.T, (-first, first, -second, second), strict=True):
        gradient[rows, corner] += turn
    overlap = np.maximum(np.asarray(problem.layers.thickness, np.float64)[is_used] - height, 0.0)
    overlap[overlap > float(problem.layers.limit)] = 0.0  # there the energy is linear
    return _barrier_blocks(gradient, overlap, pairs, stiffness)


def tip_blocks(
    position: Float[np.ndarray, "vertices 3"], problem: FrameProblem
) -> Float[np.ndarray, "pairs 9 9"]:
    """Return the Gauss-Newton Hessian of the contact with tips of the body per pair in use [N/m].

    That is 6 k a depth g g^T, with g = dd / dx.
    """
    if problem.body is None or problem.body.tips is None:
        return np.zeros((0, 9, 9))
    tips, constants = problem.body.tips, problem.constants
    is_used = np.asarray(tips.side) != 0
    point, weights = (np.asarray(one, np.float64)[is_used] for one in (tips.next_points, tips.weights))
    corners = position[np.asarray(tips.corners)[is_used]]
    offset = point + np.einsum("pk,pka->pa", weights, corners)
    edges = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    height, normal, first, second = _turning_height(offset, *edges, np.asarray(tips.side)[is_used])
    gradient = weights[:, :, None] * normal[:, None] + np.stack([-first - second, first, second], axis=1)
    overlap = np.maximum(float(constants.collision_thickness) - height, 0.0)
    return _barrier_blocks(gradient, overlap, tips, float(constants.collision_stiffness))


def pair_table(pairs: Pairs | None, num_corners: int) -> Int[np.ndarray, "pairs corners"]:
    """Return the vertices of cloth in every pair in use: four of layers, three of tips."""
    if pairs is None:
        return np.zeros((0, num_corners), np.int64)
    return np.asarray(pairs.corners)[np.asarray(pairs.side) != 0]


def _turning_height(
    offset: np.ndarray, first: np.ndarray, second: np.ndarray, side: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return heights along the common normal of two edges [m], the normal, and derivatives by both edges.

    The derivatives are those of the height through the normal; the offset is held constant.
    """
    normal = np.cross(first, second)
    size = np.linalg.norm(normal, axis=1)[:, None]
    size = np.where(size > 0, size, 1.0)
    normal = normal * (side[:, None] / size)
    height = np.sum(offset * normal, axis=1)
    tangential = (offset - height[:, None] * normal) * (side[:, None] / size)
    return height, normal, np.cross(second, tangential), np.cross(tangential, first)


def _barrier_blocks(gradient: np.ndarray, overlap: np.ndarray, pairs: Pairs, stiffness: float) -> np.ndarray:
    """Return 6 k a overlap g g^T for pairs in use, from the gradient of their height, and the overlap [m]."""
    gradient = gradient.reshape(len(overlap), -1)
    areas = np.asarray(pairs.areas, np.float64)[np.asarray(pairs.side) != 0]
    curvature = 6.0 * stiffness * areas * overlap
    return curvature[:, None, None] * gradient[:, :, None] * gradient[:, None, :]
