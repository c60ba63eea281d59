"""Other meshes of a garment: even triangulations of an edge length (extra `remesh`), and subdivisions (host)."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.sparse
from jaxtyping import Int
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from eslr_jax.errors import ConfigError, MeshError
from eslr_jax.mesh import topology
from eslr_jax.mesh.closest import closest_points
from eslr_jax.mesh.validate import validate_mesh
from eslr_jax.pipeline.dressing.repair import consistent_orientation
from eslr_jax.pipeline.extras import require
from eslr_jax.pipeline.formats.mesh import Faces, Positions

_MIN_VERTICES, _MAX_VERTICES = 50, 200_000
_ATTEMPTS = 6  # clusterings with a few vertices more; one in ten leaves a vertex where two fans meet


def remesh(
    positions: Positions, faces: Faces, edge_length: float
) -> tuple[Positions, Faces, Int[np.ndarray, " faces"]]:
    """Return an even triangulation with a given mean edge length [m], and the source face of every face.

    Vertices are the centres of equal clusters (Valette and Chassery 2004, the package pyacvd). The centres
    shrink away from open edges, so boundary vertices are moved back onto the open edges of the source.

    Raises:
        ConfigError: The edge length gives an impossible number of vertices.
        MeshError: No clustering gave a clean mesh.
        MissingExtraError: The extra `remesh` is not installed.
    """
    area = float(topology.face_areas(positions, faces).sum())
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
                    topology.face_cross_products(points, triangles)
                    * topology.face_cross_products(positions, faces)[nearest]
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
    loops = [positions[loop] for loop in topology.boundary_loops(faces)]
    result = points.copy()
    for loop in topology.boundary_loops(triangles) if loops else []:
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

    faces: Faces
    parents: Int[np.ndarray, " faces"]  # the coarse face that each comes of
    smooth: csr_matrix  # places vertices on the smooth surface
    linear: csr_matrix  # interpolates what belongs to the vertices


def refine(faces: Faces, num_vertices: int, scheme: str) -> Refinement:
    """Refine an oriented manifold mesh by a scheme of letters: t triples the number of faces, q quadruples it.

    Source: t: Kobbelt 2000, doi 10.1145/344779.344835, with a boundary that stays; q: Loop 1987.
    """
    step = {"t": _triple, "q": _quadruple}
    identity = csr_matrix(scipy.sparse.identity(num_vertices))
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


def _below(old: csr_matrix, new: csr_matrix) -> csr_matrix:
    """Return the matrix of the old vertices with that of the new ones below it."""
    return scipy.sparse.vstack([old, new], format="csr")


def _smoothed(
    edges: np.ndarray,
    is_boundary: np.ndarray,
    count: int,
    share_of: Callable[[np.ndarray], np.ndarray],
    at_boundary: float,
) -> csr_matrix:
    """Return the matrix that moves old vertices towards the mean of their neighbours.

    `share_of` tells the share of the mean that an inner vertex of so many edges takes, `at_boundary` is that of a
    boundary vertex, of its two neighbours along the boundary.
    """
    degree = np.bincount(edges.ravel(), minlength=count)
    on_boundary = np.zeros(count, bool)
    on_boundary[edges[is_boundary]] = True
    share = np.where(on_boundary, at_boundary, np.where(degree > 0, share_of(np.maximum(degree, 1)), 0.0))
    ends = np.concatenate([edges, edges[:, ::-1]])
    start, end = ends[np.tile(is_boundary, 2) | ~on_boundary[ends[:, 0]]].T
    each = share[start] / np.where(on_boundary, 2, np.maximum(degree, 1))[start]
    return csr_matrix((each, (start, end)), (count, count)) + scipy.sparse.diags(1.0 - share)


def _quadruple(faces: np.ndarray, count: int) -> Refinement:
    """Split every face in four."""
    edges, behind, counts = topology.undirected_edges(faces)
    is_boundary = counts == 1
    a, b, c = faces.T
    ab, bc, ca = count + behind.reshape(-1, 3).T
    finer = np.concatenate(
        [np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    )
    shape, ends = (len(edges), count), (np.arange(len(edges)).repeat(2), edges.ravel())
    near = csr_matrix((np.where(is_boundary, 0.5, 0.375).repeat(2), ends), shape)
    opposite = topology.half_edges(faces)[2]
    across = csr_matrix((np.where(is_boundary, 0.0, 0.125)[behind], (behind, opposite)), shape)

    def share(degree: np.ndarray) -> np.ndarray:
        return 0.625 - (0.375 + 0.25 * np.cos(2 * np.pi / degree)) ** 2

    return Refinement(
        finer,
        np.tile(np.arange(len(faces)), 4),
        _below(_smoothed(edges, is_boundary, count, share, 0.25), near + across),
        _below(scipy.sparse.identity(count), csr_matrix((np.full(edges.size, 0.5), ends), shape)),
    )


def _triple(faces: np.ndarray, count: int) -> Refinement:
    """Put a vertex into every face, and turn the inner edges to join two of these."""
    edges, behind, counts = topology.undirected_edges(faces)
    starts, ends, _ = topology.half_edges(faces)
    hinges, sides = topology.find_hinges(faces)
    (low, high), (left, right) = hinges[:, :2].T, sides.T
    rim = np.flatnonzero(counts[behind] == 1)
    finer = np.concatenate(
        [
            np.stack([low, count + right, count + left], axis=1),
            np.stack([high, count + left, count + right], axis=1),
            np.stack([starts[rim], ends[rim], count + rim // 3], axis=1),
        ]
    )
    corners = np.arange(len(faces)).repeat(3), faces.ravel()
    thirds = csr_matrix((np.full(faces.size, 1.0 / 3.0), corners), (len(faces), count))

    def share(degree: np.ndarray) -> np.ndarray:
        return (4.0 - 2.0 * np.cos(2 * np.pi / degree)) / 9.0

    return Refinement(
        finer,
        np.concatenate([left, right, rim // 3]),
        _below(_smoothed(edges, counts == 1, count, share, 0.0), thirds),
        _below(scipy.sparse.identity(count), thirds),
    )
