"""Other meshes of a garment: even triangulations of an edge length (extra `remesh`), and subdivisions (host)."""

from __future__ import annotations

import warnings
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix, csr_matrix
from scipy.spatial import cKDTree

from eslr_jax.errors import ConfigError, MeshError
from eslr_jax.mesh.closest import closest_points
from eslr_jax.mesh.topology import boundary_loops, face_areas, face_cross_products, undirected_edges
from eslr_jax.mesh.validate import validate_mesh
from eslr_jax.pipeline.dressing.repair import consistent_orientation
from eslr_jax.pipeline.extras import require

_MIN_VERTICES, _MAX_VERTICES = 50, 200_000
_ATTEMPTS = 6  # clusterings with a few vertices more; one in ten leaves a vertex where two fans meet


def remesh(
    positions: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"], edge_length: float
) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"], Int[np.ndarray, " faces"]]:
    """Return an even triangulation with a given mean edge length [m], and the source face of every face.

    Vertices are the centres of equal clusters (Valette and Chassery 2004, the package pyacvd). The centres
    shrink away from open edges, so boundary vertices are moved back onto the open edges of the source.

    Raises:
        ConfigError: The edge length gives an impossible number of vertices.
        MeshError: No clustering gave a clean mesh.
        MissingExtraError: The extra `remesh` is not installed.
    """
    area = float(face_areas(positions, faces).sum())
    # Of equilateral triangles, two per vertex, each with the area sqrt(3) / 4 of its squared edge.
    count = round(area / (np.sqrt(3.0) / 2.0 * edge_length**2)) if edge_length > 0 else 0
    if not _MIN_VERTICES <= count <= _MAX_VERTICES:
        raise ConfigError(
            f"edge length {edge_length:g} m gives {count} vertices over {area:.2f} m^2; choose one for "
            f"{_MIN_VERTICES} to {_MAX_VERTICES}"
        )
    pyacvd, pyvista = (require(name, extra="remesh", purpose="remeshing") for name in ("pyacvd", "pyvista"))
    source = pyvista.PolyData.from_regular_faces(positions, faces)
    with warnings.catch_warnings():  # pyacvd 0.4 reads an attribute that pyvista 0.49 deprecates
        warnings.simplefilter("ignore")
        clustering = pyacvd.Clustering(source)
        clustering.subdivide(max(1, min(4, int(np.ceil(np.log(25 * count / len(positions)) / np.log(4.0))))))
        cause = ""
        for attempt in range(_ATTEMPTS):
            clustering.cluster(count + 7 * attempt)
            mesh = clustering.create_mesh().triangulate().clean()
            points, triangles = np.array(mesh.points, np.float64), np.array(mesh.regular_faces, np.int64)
            try:
                # To the side that the source faces.
                turn = consistent_orientation(points, triangles)
                triangles = np.where(turn[:, None], triangles[:, ::-1], triangles)
                nearest, _ = closest_points(points[triangles].mean(axis=1), positions, faces)
                agreement = np.sum(
                    face_cross_products(points, triangles) * face_cross_products(positions, faces)[nearest]
                )
                triangles = triangles if agreement > 0 else np.ascontiguousarray(triangles[:, ::-1])
                points = _onto_open_edges(points, triangles, positions, faces)
                validate_mesh(points, triangles, allow_components=True)
            except (MeshError, ValueError, KeyError) as error:
                cause = str(error)
                continue
            return points, triangles, closest_points(points[triangles].mean(axis=1), positions, faces)[0]
    raise MeshError(
        f"no clean mesh with edges of {edge_length:g} m was found ({cause}); choose another length"
    )


def _onto_open_edges(
    points: np.ndarray, triangles: np.ndarray, positions: np.ndarray, faces: np.ndarray
) -> np.ndarray:
    """Move boundary vertices to the closest point of the source's nearest open edge."""
    loops = [positions[loop] for loop in boundary_loops(faces)]
    result = points.copy()
    for loop in boundary_loops(triangles) if loops else []:
        distances = [cKDTree(other).query(points[loop])[0].mean() for other in loops]
        start = loops[int(np.argmin(distances))]
        end = np.roll(start, -1, axis=0)
        along = end - start
        share = np.einsum("lsx,sx->ls", points[loop][:, None] - start, along) / np.sum(along**2, axis=1)
        closest = start + np.clip(share, 0.0, 1.0)[:, :, None] * along
        pick = np.argmin(np.linalg.norm(closest - points[loop][:, None], axis=2), axis=1)
        result[loop] = closest[np.arange(len(loop)), pick]
    return result


class Refinement(NamedTuple):
    """A finer mesh as a function of a coarse one; matrices have shape [fine vertices, coarse vertices]."""

    faces: Int[np.ndarray, "faces 3"]
    parents: Int[np.ndarray, " faces"]  # the coarse face that each comes of
    smooth: csr_matrix  # places vertices on the smooth surface
    linear: csr_matrix  # interpolates what belongs to the vertices


def refine(faces: Int[np.ndarray, "faces 3"], num_vertices: int, scheme: str) -> Refinement:
    """Refine an oriented manifold mesh by a scheme of letters: t triples the number of faces, q quadruples it.

    Source: t: Kobbelt 2000, doi 10.1145/344779.344835, with a boundary that stays; q: Loop 1987.
    """
    step = {"t": _triple, "q": _quadruple}
    everyone = np.arange(num_vertices)
    identity = _matrix([(everyone, everyone, np.ones(num_vertices))], (num_vertices, num_vertices))
    whole = Refinement(np.asarray(faces, np.int64), np.arange(len(faces)), identity, identity)
    for letter in scheme:
        finer = step[letter](whole.faces, np.shape(whole.smooth)[0])
        whole = Refinement(
            finer.faces,
            whole.parents[finer.parents],
            finer.smooth @ whole.smooth,
            finer.linear @ whole.linear,
        )
    return whole


def _edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return unique edges, the edge behind corner k of every face (from k to k + 1), and which are boundary."""
    edges, behind, counts = undirected_edges(faces)
    return edges, behind.reshape(-1, 3), counts == 1


def _matrix(entries: list[tuple[np.ndarray, np.ndarray, np.ndarray]], shape: tuple[int, int]) -> csr_matrix:
    """Return a sparse matrix from lists of rows, columns and values."""
    rows, columns, values = (np.concatenate(parts) for parts in zip(*entries, strict=True))
    return csr_matrix(coo_matrix((values, (rows, columns)), shape=shape))


def _smoothed(
    edges: np.ndarray, is_boundary: np.ndarray, count: int, share_of: np.ndarray, at_boundary: float
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return entries that move old vertices towards the mean of their neighbours.

    `share_of` has the share of the mean that an inner vertex of so many edges takes, `at_boundary` is that of a
    boundary vertex, of its two neighbours along the boundary.
    """
    degree = np.bincount(edges.ravel(), minlength=count)
    on_boundary = np.zeros(count, bool)
    on_boundary[edges[is_boundary]] = True
    share = np.where(on_boundary, at_boundary, share_of[degree])
    ends = np.concatenate([edges, edges[:, ::-1]])
    counts = np.concatenate([is_boundary, is_boundary]) | ~on_boundary[ends[:, 0]]
    ends = ends[counts]
    each = share[ends[:, 0]] / np.where(on_boundary, 2, np.maximum(degree, 1))[ends[:, 0]]
    everyone = np.arange(count)
    return [(everyone, everyone, 1.0 - share), (ends[:, 0], ends[:, 1], each)]


def _quadruple(faces: np.ndarray, count: int) -> Refinement:
    """Split every face in four."""
    edges, behind, is_boundary = _edges(faces)
    new = count + np.arange(len(edges))
    a, b, c = faces.T
    ab, bc, ca = (count + behind[:, k] for k in range(3))
    finer = np.concatenate(
        [np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    )
    opposite = np.roll(faces, -2, axis=1)  # the corner across the edge behind corner k
    inner = ~is_boundary
    near = np.where(is_boundary, 0.5, 0.375)
    is_inner = inner[behind.ravel()]
    degree = np.arange(1, 64)
    share = np.concatenate([[0.0], 0.625 - (0.375 + 0.25 * np.cos(2 * np.pi / degree)) ** 2])
    midpoints = [(new, edges[:, k], near) for k in range(2)]
    across = (
        count + behind.ravel()[is_inner],
        opposite.ravel()[is_inner],
        np.full(is_inner.sum(), 0.125),
    )
    shape = (count + len(edges), count)
    kept = [(np.arange(count), np.arange(count), np.ones(count))]
    return Refinement(
        finer,
        np.tile(np.arange(len(faces)), 4),
        _matrix([*_smoothed(edges, is_boundary, count, share, 0.25), *midpoints, across], shape),
        _matrix([*kept, *((new, edges[:, k], np.full(len(edges), 0.5)) for k in range(2))], shape),
    )


def _triple(faces: np.ndarray, count: int) -> Refinement:
    """Put a vertex into every face, and turn the inner edges to join two of these."""
    edges, behind, is_boundary = _edges(faces)
    middle = count + np.arange(len(faces))
    # Of every inner edge the two faces: the one that runs along it from its lower end comes first.
    flat, face = behind.ravel(), np.repeat(np.arange(len(faces)), 3)
    start = faces.ravel()
    runs_up = start == edges[flat, 0]
    left, right = np.full(len(edges), -1), np.full(len(edges), -1)
    left[flat[runs_up]], right[flat[~runs_up]] = face[runs_up], face[~runs_up]
    inner = np.flatnonzero(~is_boundary)
    low, high = edges[inner].T
    first, second = middle[left[inner]], middle[right[inner]]
    rim = is_boundary[flat]
    finer = np.concatenate(
        [
            np.stack([low, second, first], axis=1),
            np.stack([high, first, second], axis=1),
            np.stack([start[rim], np.roll(faces, -1, axis=1).ravel()[rim], middle[face[rim]]], axis=1),
        ]
    )
    degree = np.arange(1, 64)
    share = np.concatenate([[0.0], (4.0 - 2.0 * np.cos(2 * np.pi / degree)) / 9.0])
    shape = (count + len(faces), count)
    thirds = [(middle, faces[:, k], np.full(len(faces), 1.0 / 3.0)) for k in range(3)]
    kept = [(np.arange(count), np.arange(count), np.ones(count))]
    return Refinement(
        finer,
        np.concatenate([left[inner], right[inner], face[rim]]),
        _matrix([*_smoothed(edges, is_boundary, count, share, 0.0), *thirds], shape),
        _matrix([*kept, *thirds], shape),
    )
