"""Even triangulations of a given edge length (extra `remesh`)."""

from __future__ import annotations

import warnings

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from eslr_jax.errors import ConfigError, MeshError
from eslr_jax.mesh.closest import closest_points
from eslr_jax.mesh.topology import boundary_loops, face_areas, face_cross_products
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
