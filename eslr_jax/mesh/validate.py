"""Checks of users' meshes; the first failure raises a `MeshError` that names the place and the remedy."""

from __future__ import annotations

import numpy as np
import scipy.sparse
from jaxtyping import Bool, Float, Int
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from eslr_jax.errors import MeshError
from eslr_jax.mesh import topology

_FLAT = 1e-6  # of the cube around a body: less volume than that is rounding
MIN_DIAGONAL = 0.05  # [m] of the bounding box; smaller is no garment
MAX_DIAGONAL = 5.0  # [m]
DUPLICATE_TOLERANCE = 1e-7  # of the bounding box's diagonal
DEGENERATE_TOLERANCE = 1e-10  # of the longest edge squared
UNITS = {"m": 1.0, "dm": 0.1, "cm": 1e-2, "mm": 1e-3, "in": 0.0254, "ft": 0.3048}  # metres per unit
MIN_VOLUME_RATIO = -0.03  # of the volume of a sphere of the same area; below, it is inside out
MAX_HOLE_SHARE = 0.7  # of the mesh's area; with larger holes it has no inside
GARMENT_DIAGONAL = 1.0  # [m] a typical garment, to guess the unit by


def validate_mesh(
    positions: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    *,
    name: str = "mesh",
    allow_components: bool = False,
) -> None:
    """Check that a mesh can be simulated, its positions in metres; messages begin with `name`.

    Raises:
        MeshError: The mesh is empty, has wrong shapes, indices out of range, NaN, an implausible scale,
            unreferenced or duplicate vertices, degenerate or duplicate faces, non-manifold edges or vertices,
            inconsistent orientation, or several components that are not allowed.
    """
    positions, faces = np.asarray(positions), np.asarray(faces)
    check_arrays(positions, faces, name)
    _check_scale(positions, name)
    _check_vertices(positions, faces, name)
    _check_faces(positions, faces, name)
    _check_edges(faces, name)
    _check_fans(faces, len(positions), name)
    num_components, component = topology.vertex_components(faces, len(positions))
    if num_components > 1 and not allow_components:
        sizes = np.bincount(component)
        largest = np.sort(sizes)[::-1]
        other = int(np.argmax(component != np.argmax(sizes)))
        raise MeshError(
            f"{name}: {num_components} separate components (sizes {', '.join(map(str, largest[:5]))}"
            f"{', ...' * (len(sizes) > 5)}; "
            f"vertex {other} is not connected to the largest); join them, delete the loose parts, "
            "or allow several components"
        )


def validate_lengths(
    positions: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"], *, name: str
) -> None:
    """Raise a MeshError on NaN, an implausible scale or degenerate faces in other positions of a valid mesh.

    Vertices of several garments may coincide there: an outfit's garments are sewn one by one.
    """
    positions, faces = np.asarray(positions), np.asarray(faces)
    check_arrays(positions, faces, name)
    _check_scale(positions, name)
    _check_faces(positions, faces, name)


def check_arrays(positions: np.ndarray, faces: np.ndarray, name: str) -> None:
    """Raise on empty arrays, wrong shapes or dtypes, non-finite positions and indices out of range."""
    if positions.size == 0 or faces.size == 0:
        raise MeshError(
            f"{name}: empty mesh ({len(positions)} vertices, {len(faces)} faces); give a triangle mesh"
        )
    if positions.ndim != 2 or positions.shape[1] != 3 or positions.dtype.kind not in "fiu":
        raise MeshError(
            f"{name}: positions have shape {positions.shape} and dtype {positions.dtype}; "
            "give [vertices, 3] floats"
        )
    if faces.ndim != 2 or faces.shape[1] != 3:
        raise MeshError(f"{name}: faces have shape {faces.shape}, not [faces, 3]; triangulate the mesh")
    if faces.dtype.kind not in "iu":
        raise MeshError(f"{name}: faces have dtype {faces.dtype}; give integer vertex indices")
    is_bad = ~np.isfinite(positions).all(axis=1)
    if is_bad.any():
        vertex = int(np.argmax(is_bad))
        raise MeshError(
            f"{name}: vertex {vertex} is not finite ({_point(positions[vertex])}); repair its position"
        )
    is_bad = ((faces < 0) | (faces >= len(positions))).any(axis=1)
    if is_bad.any():
        face = int(np.argmax(is_bad))
        raise MeshError(
            f"{name}: face {face} {_ids(faces[face])} names a vertex outside 0..{len(positions) - 1}; "
            "export the mesh again"
        )


def _check_scale(positions: np.ndarray, name: str) -> None:
    """Raise on a size that no garment in metres has, and guess the unit."""
    diagonal = _diagonal(positions)
    if MIN_DIAGONAL <= diagonal <= MAX_DIAGONAL:
        return
    hint = "positions must be in metres"
    if diagonal > MAX_DIAGONAL:
        unit, factor = min(UNITS.items(), key=lambda item: abs(np.log(diagonal * item[1] / GARMENT_DIAGONAL)))
        if MIN_DIAGONAL <= diagonal * factor <= MAX_DIAGONAL:
            hint = f"it seems to be in {unit}: scale by {factor:g}"
    elif diagonal > 0:
        hint += f": scale by about {10.0 ** round(-np.log10(diagonal)):g}"
    cause = f"bounding-box diagonal {diagonal:.4g} m is outside {MIN_DIAGONAL}-{MAX_DIAGONAL} m"
    raise MeshError(f"{name}: {cause}; {hint}")


def _check_vertices(positions: np.ndarray, faces: np.ndarray, name: str) -> None:
    """Raise on vertices that no face uses, and on coincident vertices."""
    is_used = np.zeros(len(positions), bool)
    is_used[faces] = True
    if not is_used.all():
        vertex = int(np.argmin(is_used))
        raise MeshError(
            f"{name}: {np.sum(~is_used)} vertices belong to no face, the first is vertex {vertex}; "
            "delete loose vertices"
        )
    pairs = KDTree(positions).query_pairs(DUPLICATE_TOLERANCE * _diagonal(positions), output_type="ndarray")
    if len(pairs):
        first, second = np.sort(pairs, axis=1)[np.lexsort(np.sort(pairs, axis=1).T[::-1])[0]]
        raise MeshError(
            f"{name}: vertices {first} and {second} coincide at {_point(positions[first])} "
            f"({len(pairs)} such pairs); merge vertices by distance"
        )


def _check_faces(positions: np.ndarray, faces: np.ndarray, name: str) -> None:
    """Raise on faces without area and on faces that name the same three vertices."""
    corners = positions[faces]
    longest = np.max(np.sum((corners - np.roll(corners, 1, axis=1)) ** 2, axis=2), axis=1)
    is_bad = topology.face_areas(positions, faces) <= DEGENERATE_TOLERANCE * longest
    if is_bad.any():
        face = int(np.argmax(is_bad))
        raise MeshError(
            f"{name}: face {face} {_ids(faces[face])} has no area ({is_bad.sum()} such faces); "
            "dissolve degenerate faces"
        )
    ordered = np.sort(faces, axis=1)
    order = np.lexsort(ordered.T)
    is_same = np.all(ordered[order][1:] == ordered[order][:-1], axis=1)
    if is_same.any():
        first, second = np.sort(order[np.argmax(is_same) + np.arange(2)])
        raise MeshError(
            f"{name}: faces {first} and {second} are the same triangle {_ids(faces[first])} "
            f"({is_same.sum()} duplicates); delete duplicate faces"
        )


def _check_edges(faces: np.ndarray, name: str) -> None:
    """Raise on edges with more than two faces, and on neighbours that wind in opposite directions."""
    starts, ends, _ = topology.half_edges(faces)
    edges, edge_of, counts = topology.undirected_edges(faces)
    if counts.max() > 2:
        edge = int(np.argmax(counts > 2))
        users = np.flatnonzero(edge_of == edge) // 3
        raise MeshError(
            f"{name}: edge {_ids(edges[edge])} belongs to {counts[edge]} faces {_ids(users[:6])} "
            f"({np.sum(counts > 2)} such edges); cloth is a sheet: delete or separate the extra faces"
        )
    forward = np.bincount(edge_of, weights=starts < ends, minlength=len(edges))
    is_bad = (counts == 2) & (forward != 1)
    if is_bad.any():
        edge = int(np.argmax(is_bad))
        users = np.flatnonzero(edge_of == edge) // 3
        raise MeshError(
            f"{name}: faces {users[0]} and {users[1]} wind in opposite directions along edge "
            f"{_ids(edges[edge])} ({is_bad.sum()} such edges); recalculate normals so that all point outside"
        )


def _check_fans(faces: np.ndarray, num_vertices: int, name: str) -> None:
    """Raise on vertices whose faces form more than one fan (bow-ties).

    Corners of neighbouring faces at the same vertex are joined, so that each fan is a component of a graph.
    """
    starts, _, _ = topology.half_edges(faces.astype(np.int64))
    twins = topology.twin_half_edges(faces)
    start = np.flatnonzero(twins >= 0)  # corner of the half-edge's start
    twin = twins[start]
    rows = np.concatenate([start, topology.next_half_edges(start)])
    columns = np.concatenate([topology.next_half_edges(twin), twin])
    graph = scipy.sparse.coo_array((np.ones(len(rows), bool), (rows, columns)), (len(starts), len(starts)))
    _, first = np.unique(connected_components(graph, directed=False)[1], return_index=True)
    counts = np.bincount(starts[first], minlength=num_vertices)
    if counts.max() > 1:
        vertex = int(np.argmax(counts > 1))
        raise MeshError(
            f"{name}: {counts[vertex]} fans of faces meet only at vertex {vertex} "
            f"({np.sum(counts > 1)} such vertices); split the vertex, or bridge the faces around it"
        )


def validate_body(
    positions: Float[np.ndarray, "body_vertices 3"],
    faces: Int[np.ndarray, "body_faces 3"],
    is_obstacle: Bool[np.ndarray, " body_faces"],
    *,
    name: str = "body",
) -> None:
    """Raise a MeshError where a body is empty, not finite, open where cloth may touch it, or inside out.

    Contact keeps cloth on the side that normals point to. Cloth that slipped in through a hole would be held
    inside. Faces that are no obstacle may have open edges.
    """
    positions, faces = np.asarray(positions, np.float64), np.asarray(faces)
    check_arrays(positions, faces, name)
    if np.shape(is_obstacle) != (len(faces),):
        raise MeshError(
            f"{name}: {np.shape(is_obstacle)} obstacle marks for {len(faces)} faces; give one per face"
        )
    starts, ends, _ = topology.half_edges(faces.astype(np.int64))
    is_open = (topology.twin_half_edges(faces) < 0) & np.asarray(is_obstacle)[np.arange(len(starts)) // 3]
    if is_open.any():
        edge = int(np.argmax(is_open))
        raise MeshError(
            f"{name}: {is_open.sum()} edges have a face on one side only, the first is "
            f"{_ids(np.array([starts[edge], ends[edge]]))} of face {edge // 3}: the body is not closed; fill its "
            "holes, or mark the faces around them as no obstacles"
        )
    check_outward(positions, faces, name=name)


def check_outward(
    positions: Float[np.ndarray, "body_vertices 3"], faces: Int[np.ndarray, "body_faces 3"], *, name: str
) -> None:
    """Raise a MeshError where the faces of a body, which may have holes, enclose a negative volume."""
    volume = np.sum(np.linalg.det(positions[faces] - positions.mean(axis=0))) / 6
    if volume < -_FLAT * np.ptp(positions, axis=0).max() ** 3:
        raise MeshError(f"{name}: its faces point inside; flip the normals")


def validate_orientation(
    positions: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"], *, name: str = "mesh"
) -> None:
    """Raise a MeshError where the faces of a garment, a valid mesh, point inside.

    Its holes are closed with fans, and the sign of the enclosed volume decides. Meshes that are mostly hole pass.
    """
    positions, faces = np.asarray(positions, np.float64), np.asarray(faces)
    centered = positions - positions.mean(axis=0)
    triangles = [centered[faces]]
    for loop in topology.boundary_loops(faces):
        boundary = centered[loop]
        center = np.broadcast_to(boundary.mean(axis=0), boundary.shape)
        triangles.append(np.stack([np.roll(boundary, -1, axis=0), boundary, center], axis=1))
    areas = [
        0.5 * np.linalg.norm(np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]), axis=1).sum() for t in triangles
    ]
    volume = sum(np.sum(np.linalg.det(t)) for t in triangles) / 6.0
    of_sphere = 6.0 * np.sqrt(np.pi) * volume / sum(areas) ** 1.5
    if sum(areas[1:]) <= MAX_HOLE_SHARE * areas[0] and of_sphere < MIN_VOLUME_RATIO:
        raise MeshError(f"{name}: its faces point inside; flip the normals")


def _diagonal(positions: np.ndarray) -> float:
    return float(np.linalg.norm(positions.max(axis=0).astype(float) - positions.min(axis=0)))


def _ids(values: np.ndarray) -> str:
    return "(" + ", ".join(str(int(value)) for value in values) + ")"


def _point(values: np.ndarray) -> str:
    return "(" + ", ".join(f"{float(value):.6g}" for value in values) + ")"
