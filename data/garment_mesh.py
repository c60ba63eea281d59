"""Triangle meshes of garments: cutting, remeshing, hems and diffusion over the surface."""

import igl
import numpy as np
import pyacvd
import pyvista
from scipy.ndimage import gaussian_filter1d
from scipy.sparse import csr_matrix, diags
from scipy.sparse.csgraph import connected_components, reverse_cuthill_mckee
from scipy.sparse.linalg import splu

Surface = tuple[np.ndarray, np.ndarray]  # vertices [V, 3] [m] and faces [F, 3]


def to_polydata(surface: Surface) -> pyvista.PolyData:
    """Wrap a triangle mesh for VTK."""
    vertices, faces = surface
    return pyvista.PolyData(vertices, np.column_stack([np.full(len(faces), 3), faces]).ravel())


def from_polydata(mesh: pyvista.PolyData) -> Surface:
    """Unwrap a triangle mesh of VTK."""
    return np.array(mesh.points, dtype=float), np.array(mesh.faces, dtype=np.int64).reshape(-1, 4)[:, 1:]


def largest_component(surface: Surface) -> Surface:
    """Keep the connected part with the most vertices."""
    vertices, faces = surface
    _, label = connected_components(vertex_adjacency(faces, len(vertices)), directed=False)
    keep = label == np.bincount(label).argmax()
    index = np.cumsum(keep) - 1
    return vertices[keep], index[faces[keep[faces[:, 0]]]]


def cut_surface(surface: Surface, values: np.ndarray) -> Surface:
    """Return the largest part of the surface where the vertex field `values` is positive."""
    mesh = to_polydata(surface)
    mesh["cut"] = values
    clipped = mesh.clip_scalar(scalars="cut", value=0.0, invert=False).triangulate().clean(tolerance=1e-6)
    return largest_component(from_polydata(clipped))


def mesh_edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the undirected edges [E, 2] and how many faces each has [E]."""
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    return np.unique(np.sort(directed, axis=1), axis=0, return_counts=True)


def vertex_adjacency(faces: np.ndarray, num_vertices: int) -> csr_matrix:
    """Return the symmetric 0/1 adjacency of the vertices."""
    edges, _ = mesh_edges(faces)
    rows, columns = np.concatenate([edges, edges[:, ::-1]]).T
    return csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(num_vertices, num_vertices))


def boundary_loops(faces: np.ndarray) -> list[np.ndarray]:
    """Return the boundary loops as ordered vertex indices; raise if a boundary vertex lies on two loops."""
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    _, inverse, counts = np.unique(np.sort(directed, axis=1), axis=0, return_inverse=True, return_counts=True)
    boundary = directed[counts[inverse.ravel()] == 1]
    follow = dict(boundary.tolist())
    if len(follow) != len(boundary):
        raise ValueError("a boundary vertex lies on two loops")
    loops = []
    while follow:
        loop = [next(iter(follow))]
        while (following := follow.pop(loop[-1])) != loop[0]:
            loop.append(following)
        loops.append(np.array(loop))
    return loops


def smooth_surface(surface: Surface, iterations: int) -> Surface:
    """Remove the grid's terraces from a closed surface by Taubin smoothing (no shrinkage)."""
    vertices, faces = surface
    adjacency = vertex_adjacency(faces, len(vertices))
    average = diags(1.0 / np.asarray(adjacency.sum(axis=1)).ravel()) @ adjacency
    for k in range(2 * iterations):
        vertices = vertices + (0.5, -0.52)[k % 2] * (average @ vertices - vertices)
    return vertices, faces


def fair_surface(surface: Surface, length: float) -> Surface:
    """Smooth away bumps narrower than a few `length` [m] by solving `(M + length^4 L M^-1 L) x = M x0`."""
    vertices, faces = surface
    laplacian = igl.cotmatrix(vertices, faces)
    mass = igl.massmatrix(vertices, faces, igl.MASSMATRIX_TYPE_BARYCENTRIC)
    bending = laplacian @ diags(1.0 / mass.diagonal()) @ laplacian
    return splu((mass + length**4 * bending).tocsc()).solve(mass @ vertices), faces


def is_clean(faces: np.ndarray, num_vertices: int, num_loops: int) -> bool:
    """Tell whether the mesh is manifold, connected and has `num_loops` simple boundary loops."""
    edges, counts = mesh_edges(faces)
    if counts.max() > 2 or len(np.unique(faces)) != num_vertices:
        return False
    try:
        loops = boundary_loops(faces)
    except (ValueError, KeyError):
        return False
    euler = num_vertices - len(edges) + len(faces)
    parts, _ = connected_components(vertex_adjacency(faces, num_vertices), directed=False)
    return parts == 1 and len(loops) == num_loops and euler == 2 - num_loops


def remesh(surface: Surface, num_vertices: int, num_loops: int) -> Surface:
    """Return an even triangulation of the surface with about `num_vertices` vertices."""
    clustering = pyacvd.Clustering(to_polydata(surface))
    clustering.subdivide(2 if len(surface[0]) < 25 * num_vertices else 1)
    for attempt in range(8):
        clustering.cluster(num_vertices + 7 * attempt)
        vertices, faces = from_polydata(clustering.create_mesh().triangulate().clean())
        faces = orient_like(surface, vertices, faces)
        if is_clean(faces, len(vertices), num_loops):
            return vertices, faces
    raise RuntimeError(f"no manifold remesh with {num_loops} loops near {num_vertices} vertices")


def orient_like(surface: Surface, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Flip all faces if most of them oppose the reference surface."""
    centres = vertices[faces].mean(axis=1)
    _, nearest, _ = igl.point_mesh_squared_distance(centres, *surface)
    agree = (face_normals(vertices, faces) * face_normals(*surface)[nearest]).sum(axis=1)
    return faces if np.median(agree) > 0 else np.ascontiguousarray(faces[:, ::-1])


def face_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return unit normals, shape [F, 3]."""
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)


def smooth_loop(points: np.ndarray, spacing: float = 0.002, width: float = 0.006) -> np.ndarray:
    """Resample a closed polyline [N, 3] evenly and smooth it over `width` [m]."""
    closed = np.vstack([points, points[:1]])
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    even = np.linspace(0.0, arc[-1], max(int(arc[-1] / spacing), 16), endpoint=False)
    resampled = np.column_stack([np.interp(even, arc, closed[:, axis]) for axis in range(3)])
    return gaussian_filter1d(resampled, width / spacing, axis=0, mode="wrap")


def spread_on_loop(points: np.ndarray, loop: np.ndarray) -> np.ndarray:
    """Move ordered hem vertices [N, 3] onto the cut curve [M, 3] at even spacing, sliding little."""
    nearest = np.linalg.norm(points[:, None] - loop, axis=-1).argmin(axis=1)
    phase = 2.0 * np.pi * nearest / len(loop)
    even = 2.0 * np.pi * np.arange(len(points)) / len(points)
    fits = [np.exp(1j * (phase - sign * even)).mean() for sign in (1, -1)]
    sign = 1 if abs(fits[0]) > abs(fits[1]) else -1
    target = (np.angle(fits[0 if sign > 0 else 1]) + sign * even) / (2.0 * np.pi) % 1.0 * len(loop)
    low = target.astype(int) % len(loop)
    t = (target - target.astype(int))[:, None]
    return (1.0 - t) * loop[low] + t * loop[(low + 1) % len(loop)]


def obtuse_edges(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return interior edges that break the Delaunay criterion, worst first.

    Returns:
        The two corners opposite to each edge, as indices into `faces.ravel()`, shape [E, 2].
    """
    angles = igl.internal_angles(vertices, faces).ravel()
    across = np.sort(
        np.stack([faces[:, [1, 2]], faces[:, [2, 0]], faces[:, [0, 1]]], axis=1).reshape(-1, 2), axis=1
    )
    order = np.lexsort(across.T)
    twin = (across[order[1:]] == across[order[:-1]]).all(axis=1)
    pairs = np.column_stack([order[:-1][twin], order[1:][twin]])
    excess = angles[pairs].sum(axis=1)
    pairs = pairs[excess > np.pi + 1e-6]
    return pairs[np.argsort(-angles[pairs].sum(axis=1))]


def flip_edges(vertices: np.ndarray, faces: np.ndarray, rounds: int = 8) -> np.ndarray:
    """Flip edges towards the Delaunay criterion; a flip that would repeat an edge is skipped."""
    faces = faces.copy()
    for _ in range(rounds):
        existing = {tuple(edge) for edge in mesh_edges(faces)[0].tolist()}
        touched: set[int] = set()
        for first, second in obtuse_edges(vertices, faces).tolist():
            (left, i), (right, j) = divmod(first, 3), divmod(second, 3)
            top, bottom = int(faces[left, i]), int(faces[right, j])
            edge = (min(top, bottom), max(top, bottom))
            if {left, right} & touched or edge in existing:
                continue
            start, end = int(faces[left, (i + 1) % 3]), int(faces[left, (i + 2) % 3])
            faces[left], faces[right] = (top, start, bottom), (bottom, end, top)
            existing.add(edge)
            touched |= {left, right}
        if not touched:
            break
    return faces


def relax(vertices: np.ndarray, faces: np.ndarray, surface: Surface, iterations: int) -> np.ndarray:
    """Average inner vertices along the surface, which evens out the triangles; hems stay."""
    adjacency = vertex_adjacency(faces, len(vertices))
    average = diags(1.0 / np.asarray(adjacency.sum(axis=1)).ravel()) @ adjacency
    inner = np.ones(len(vertices), dtype=bool)
    inner[np.concatenate(boundary_loops(faces))] = False
    result = vertices.copy()
    for _ in range(iterations):
        moved = 0.5 * result + 0.5 * (average @ result)
        _, _, moved = igl.point_mesh_squared_distance(moved, *surface)
        result[inner] = moved[inner]
    return result


def fit_to_cut(vertices: np.ndarray, faces: np.ndarray, surface: Surface) -> Surface:
    """Put hems on the cut curves, then even out the triangles by sliding vertices and flipping edges."""
    curves = [smooth_loop(surface[0][loop]) for loop in boundary_loops(surface[1])]
    result = vertices.copy()
    for loop in boundary_loops(faces):
        centre = vertices[loop].mean(axis=0)
        curve = min(curves, key=lambda curve, centre=centre: np.linalg.norm(curve.mean(axis=0) - centre))
        result[loop] = spread_on_loop(vertices[loop], curve)
    for _ in range(3):
        result = relax(result, faces, surface, 5)
        faces = flip_edges(result, faces)
    return relax(result, faces, surface, 3), faces


def reorder(vertices: np.ndarray, faces: np.ndarray) -> Surface:
    """Number vertices and faces so that neighbours are close in memory and the file compresses well."""
    order = np.asarray(reverse_cuthill_mckee(vertex_adjacency(faces, len(vertices)), symmetric_mode=True))
    index = np.empty_like(order)
    index[order] = np.arange(len(order))
    faces = index[faces]
    first = faces.argmin(axis=1)
    faces = np.take_along_axis(faces, (first[:, None] + np.arange(3)) % 3, axis=1)
    return vertices[order], faces[np.lexsort(faces.T[::-1])]


def diffuse(values: np.ndarray, surface: Surface, length: float) -> np.ndarray:
    """Solve one implicit heat step over the surface, `(M + length^2 L) x = M values`, for each column."""
    laplacian = -igl.cotmatrix(*surface)
    mass = igl.massmatrix(*surface, igl.MASSMATRIX_TYPE_VORONOI)
    return splu((mass + length**2 * laplacian).tocsc()).solve(np.asarray(mass @ values))
