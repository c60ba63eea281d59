"""Where the threads of a fabric run on a garment's faces, and their curvatures, for bending in newton metres.

The angle of a hinge is divided between its two faces: each face turns by its share, from its middle to the common
edge. The turns at the three edges of a face give its curvature, the sum of turn times edge length over area along
the edges' normals (the element of Morley). The shares follow from the curvature around the hinge, which the three
angles of a face determine. So a sheet bent to a cylinder has the energy of a cylinder, in any direction and on
any mesh. The turn at a free edge is that of least energy, which is the natural boundary condition.

Sources: Morley 1968, doi 10.1017/S0001925900004546 (the element); Grinspun et al. 2006,
doi 10.1111/j.1467-8659.2006.00974.x (curvature of faces from the rotation of their edges).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from eslr_jax.errors import MeshError
from eslr_jax.mesh import topology
from eslr_jax.types import Garment, Plate

_SLOTS = 9  # hinges of a face and of its three neighbours
_DEGREE = 6  # times that one hinge can be among them: two faces with two more neighbours each
_UP = (0.0, 1.0, 0.0)
_LEAST = 1e-3  # length of a direction's projection below which a face does not see it
_SOFTNESS = 1e-2  # share of the mean by which the angles of a face may miss its curvature; bounds the inverse


class _Sides(NamedTuple):
    """The edges of every face, in its plane; a curvature is (along warp, along weft, sqrt(2) mixed)."""

    hinge: Int[np.ndarray, "faces 3"]  # -1 at a free edge
    neighbor: Int[np.ndarray, "faces 3"]  # likewise
    height: Float[np.ndarray, "faces 3"]  # [m]
    normal: Float[np.ndarray, "faces 3 3"]  # curvature across the edge, as a row
    turn: Float[np.ndarray, "faces 3 3"]  # turn at the edge for every curvature [m]
    reach: Float[np.ndarray, "faces 3"]  # edge length over area [1/m]


def rest_corners(garment: Garment) -> Float[np.ndarray, "faces 3 2"]:
    """Return the corners of every real rest face in its own plane [m], the last at the origin; float64."""
    inverse = np.asarray(garment.inverse_rest_frames, np.float64)[_is_real(garment)]
    edges = np.linalg.inv(inverse)
    return np.stack([edges[:, :, 0], edges[:, :, 1], np.zeros_like(edges[:, :, 0])], axis=1)


def warp_directions(
    garment: Garment,
    corner_uvs: Float[np.ndarray, "faces 3 2"] | None = None,
    *,
    direction: Sequence[float] = _UP,
) -> Float[np.ndarray, "faces 2"]:
    """Return the direction of the warp on every real face: a unit vector in the frame of `rest_corners`.

    Patterns are cut and drawn with the warp along the second texture coordinate, here of the corners of the
    garment's faces. Without texture coordinates, or where a face has none, the warp runs along a direction laid
    onto the rest mesh: by default up, as in a garment whose pieces hang along the grain. A face that lies across
    it takes the mean of the faces around it, or if there is none its own first edge.

    Raises:
        MeshError: The texture coordinates fit another mesh, or the direction is no direction.
    """
    corners = rest_corners(garment)
    warp = _laid(garment, corners, direction)
    if corner_uvs is None:
        return warp
    uvs = np.asarray(corner_uvs, np.float64)
    if uvs.shape != corners.shape:
        raise MeshError(f"texture coordinates of shape {uvs.shape} don't fit {len(corners)} faces")
    in_plane, in_texture = (np.stack([x[:, 0] - x[:, 2], x[:, 1] - x[:, 2]], axis=2) for x in (corners, uvs))
    determinant = np.linalg.det(in_texture)
    is_mapped = np.abs(determinant) > 1e-12
    columns = np.linalg.solve(
        np.where(is_mapped[:, None, None], in_texture, np.eye(2)), np.array([[0.0], [1.0]])
    )
    along = topology.normalize((in_plane @ columns)[:, :, 0])
    return np.where(is_mapped[:, None], along, warp)


def _laid(garment: Garment, corners: np.ndarray, direction: Sequence[float]) -> np.ndarray:
    """Return a direction of space in the plane of every face."""
    wanted = np.asarray(direction, np.float64)
    if wanted.shape != (3,) or not np.linalg.norm(wanted) > 0:
        raise MeshError(f"{direction} is no direction; give three numbers")
    positions = np.asarray(garment.rest_positions, np.float64)
    faces = np.asarray(garment.faces)[: len(corners)]
    points = positions[faces]
    first = topology.normalize(points[:, 0] - points[:, 2])
    normal = topology.normalize(np.cross(points[:, 0] - points[:, 2], points[:, 1] - points[:, 2]))

    def laid(vectors: np.ndarray) -> np.ndarray:
        return vectors - np.vecdot(normal, vectors)[:, None] * normal

    seen = laid(wanted / np.linalg.norm(wanted))
    while (is_blind := np.linalg.norm(seen, axis=1) < _LEAST).any():
        around = np.zeros_like(positions)
        known = topology.normalize(np.where(is_blind[:, None], 0.0, seen))
        np.add.at(around, faces.ravel(), np.repeat(known, 3, axis=0))
        mean = laid(around[faces].sum(axis=1))
        is_found = is_blind & (np.linalg.norm(mean, axis=1) > _LEAST)
        if not is_found.any():  # no face beside it sees the direction
            seen = np.where(is_blind[:, None], first, seen)
            break
        seen = np.where(is_found[:, None], mean, seen)
    second = np.cross(normal, first)
    return topology.normalize(np.stack([np.vecdot(seen, first), np.vecdot(seen, second)], axis=1))


def prepare_plate(
    garment: Garment, warp: Float[np.ndarray, "faces 2"], rigidity: Float[np.ndarray, "faces 2"]
) -> Plate:
    """Return what bending needs of a fabric with its own rigidity along warp and weft [N m]; NumPy leaves.

    The rigidity of twist is the geometric mean of the two (Huber): equal ones bend alike in all directions.
    Poisson's ratio of bending is zero. The warp is a unit vector in the frame of `rest_corners` on every face.
    """
    is_real = _is_real(garment)
    faces = np.asarray(garment.faces)[is_real]
    num_faces, num_hinges = len(is_real), len(garment.hinge_rest_areas)
    areas = np.asarray(garment.rest_areas, np.float64)[is_real]
    sides = _sides(faces, rest_corners(garment), np.asarray(warp, np.float64)[: len(faces)])
    along, across = np.asarray(rigidity, np.float64)[: len(faces)].T
    moduli = np.stack([along, across, np.sqrt(along * across)], axis=1)

    hinges, shares = _shares(sides, areas)
    rows = np.einsum("fje,fjs->fes", _edge_curvatures(sides, moduli), shares)  # e: entry of the curvature
    rows *= np.sqrt(areas[:, None] * moduli)[:, :, None]
    table = np.zeros((num_faces, _SLOTS), np.int32)
    table[: len(faces)] = np.maximum(hinges, 0)
    weights = np.zeros((3, _SLOTS, num_faces), np.float32)
    weights[:, :, : len(faces)] = rows.transpose(1, 2, 0)
    return Plate(
        hinges=table, incidence=_incidence(hinges, num_faces, num_hinges).astype(np.int32), rows=weights
    )


def _is_real(garment: Garment) -> Bool[np.ndarray, " faces"]:
    """Return which faces are not padding; those come first."""
    return np.asarray(garment.rest_areas) > 0


def _sides(
    faces: Int[np.ndarray, "faces 3"],
    corners: Float[np.ndarray, "faces 3 2"],
    warp: Float[np.ndarray, "faces 2"],
) -> _Sides:
    """Return the sides of faces by their corners in the plane [m] and the direction of the warp there."""
    hinge, neighbor = np.full((2, faces.size), -1)
    left, right = topology.hinge_half_edges(faces)
    hinge[left] = hinge[right] = np.arange(len(left))
    neighbor[left], neighbor[right] = right // 3, left // 3

    weft = np.stack([-warp[:, 1], warp[:, 0]], axis=1)
    threads = np.stack([warp, weft], axis=1)
    points = np.einsum("fta,fca->fct", threads, corners)
    edges = np.roll(points, -1, axis=1) - points
    length = np.linalg.norm(edges, axis=2)
    tangent = edges / length[:, :, None]
    normal = np.stack([-tangent[:, :, 1], tangent[:, :, 0]], axis=2)  # inwards
    apex = np.roll(points, -2, axis=1) - 0.5 * (points + np.roll(points, -1, axis=1))
    height = np.sum(apex * normal, axis=2)
    foot = np.sum(apex * tangent, axis=2)  # from the middle of the edge
    across, mixed, along = _row(normal, normal), _row(normal, tangent), _row(tangent, tangent)
    # A quadratic height field w = x H x / 2 through the corners, against its own slope at the middle of the edge.
    turn = 0.5 * height[:, :, None] * across + foot[:, :, None] * mixed
    turn += (0.5 * (foot**2 - 0.25 * length**2) / height)[:, :, None] * along
    areas = 0.5 * height * length
    return _Sides(hinge.reshape(-1, 3), neighbor.reshape(-1, 3), height, across, turn, length / areas)


def _row(a: np.ndarray, b: np.ndarray) -> Float[np.ndarray, "faces 3 3"]:
    """Return a . H b as a row over the entries of the curvature H."""
    mixed = a[..., 0] * b[..., 1] + a[..., 1] * b[..., 0]
    return np.stack([a[..., 0] * b[..., 0], a[..., 1] * b[..., 1], mixed / np.sqrt(2.0)], axis=-1)


def _edge_curvatures(sides: _Sides, moduli: Float[np.ndarray, "faces 3"]) -> Float[np.ndarray, "faces 3 3"]:
    """Return the curvature of a face by the turn at each of its edges [1/m]; free edges turn as they will.

    Their own turn makes the energy least: what it adds to the curvature is subtracted.
    """
    columns = sides.reach[:, :, None] * sides.normal
    is_free = (sides.hinge < 0)[:, :, None]
    free, stiff = np.where(is_free, columns, 0.0), np.where(is_free, 0.0, columns)
    gram = np.einsum("fie,fe,fje->fij", free, moduli, free)
    pull = np.einsum("fie,fe,fje->fij", free, moduli, stiff)
    return stiff - np.einsum("fie,fij->fje", free, np.linalg.pinv(gram, rcond=1e-9, hermitian=True) @ pull)


def _curvature_of_angles(
    sides: _Sides, angle: Float[np.ndarray, "faces 3 3"]
) -> Float[np.ndarray, "faces 3 3"]:
    """Return the smallest curvature of a face that has the angles of its hinges, as rows by angle [1/m].

    `angle` has that of each hinge for every curvature [m]; zero at free edges.
    """
    gram = np.einsum("fie,fje->fij", angle, angle)
    soft = _SOFTNESS * np.trace(gram, axis1=1, axis2=2) / np.maximum(np.sum(sides.hinge >= 0, axis=1), 1)
    soft = np.where(soft > 0, soft, 1.0)
    inverse = np.linalg.inv(gram + soft[:, None, None] * np.eye(3))
    return np.einsum("fie,fij->fej", angle, inverse)


def _shares(
    sides: _Sides, areas: Float[np.ndarray, " faces"]
) -> tuple[Int[np.ndarray, "faces 9"], Float[np.ndarray, "faces 3 9"]]:
    """Return the nine hinges around every face, -1 where there is none, and each edge's turn by their angles.

    The first three hinges are the face's own; each neighbour adds its other two. To first order, the turns at a
    hinge are in proportion to the heights of its faces. The rest follows from the curvature at the hinge, the
    mean of both faces weighted by area.
    """
    is_hinge = sides.hinge >= 0
    num_faces = len(areas)
    across = np.maximum(sides.neighbor, 0)
    # The place of the common edge in the neighbour, and of the two edges after it.
    place = np.argmax(sides.hinge[across] == sides.hinge[:, :, None], axis=2)
    after = np.stack([(place + 1) % 3, (place + 2) % 3], axis=2)
    others = np.where(is_hinge[:, :, None], sides.hinge[across[:, :, None], after], -1)
    hinges = np.concatenate([sides.hinge, others.reshape(num_faces, -1)], axis=1)

    height = np.where(is_hinge, sides.height[across, place], 0.0)
    part = sides.height / (sides.height + height)
    # Across a hinge directions keep their angle to its edge: there the neighbour's rows have other entries.
    # From the row (n0^2, n1^2, sqrt(2) n0 n1) of the normal n: t is n turned by a right angle.
    normal = sides.normal
    n0n1 = normal[..., 2] / np.sqrt(2.0)
    mixed = np.stack([n0n1, -n0n1, (normal[..., 1] - normal[..., 0]) / np.sqrt(2.0)], axis=-1)
    along = np.stack([normal[..., 1], normal[..., 0], -normal[..., 2]], axis=-1)
    basis = np.stack([normal, mixed, along], axis=2)
    beyond = basis[across, place]  # the same three curvatures, in the neighbour's threads
    back = np.linalg.solve(basis, beyond)  # from the neighbour's entries to the face's own
    own_turn = sides.turn
    other_turn = np.einsum("fjr,fjrs->fjs", sides.turn[across, place], np.linalg.inv(back))
    angle = np.where(is_hinge[:, :, None], own_turn + other_turn, 0.0)
    rest = np.where(is_hinge[:, :, None], own_turn - part[:, :, None] * angle, 0.0)

    curvature = _curvature_of_angles(sides, angle)
    weight = areas[:, None] / (areas[:, None] + areas[across])
    shares = np.zeros((num_faces, 3, _SLOTS))
    shares[:, np.arange(3), np.arange(3)] = np.where(is_hinge, part, 0.0)
    shares[:, :, :3] += weight[:, :, None] * np.einsum("fje,fek->fjk", rest, curvature)
    far = np.einsum("fje,fjes,fjsk->fjk", rest, back, curvature[across]) * (1.0 - weight)[:, :, None]
    rows = np.arange(num_faces)[:, None]
    edges = np.arange(3)[None]
    shares[rows, edges, edges] += far[rows, edges, place]
    for step in range(2):
        shares[rows, edges, 3 + 2 * edges + step] += far[rows, edges, after[:, :, step]]
    return hinges, np.where(hinges[:, None] >= 0, shares, 0.0)


def _incidence(
    hinges: Int[np.ndarray, "faces 9"], num_faces: int, num_hinges: int
) -> Int[np.ndarray, "hinges 6"]:
    """Return for each hinge the flat places in the transposed, padded table that name it; see `gather_values`."""
    face, slot = np.nonzero(hinges >= 0)
    hinge = hinges[face, slot]
    order = np.argsort(hinge, kind="stable")
    hinge, place = hinge[order], (slot * num_faces + face)[order]
    column = np.arange(len(hinge)) - np.searchsorted(hinge, hinge)
    table = np.full((num_hinges, _DEGREE), _SLOTS * num_faces)
    table[hinge, column] = place
    return table
