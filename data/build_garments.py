"""Build the nine bundled garments from the bundled body.

A garment is the surface of a solid around the body: the body's distance field, thickened, joined with the tubes of
cloth that hang from it (torso, sleeves, trouser legs, skirt), with narrow creases closed. The surface is cut by smooth
scalar fields (neck, armholes, cuffs, hem, waist) and remeshed to about 1k, 4k and 10k vertices, so all three
resolutions share one shape. Hems are put back on the cut curve, and skin weights are diffused over the surface.

Run `python data/build_garments.py data/body/anny_cmu.npz` (optionally `--names tshirt dress --levels 1k 4k`).
It needs numpy, scipy, scikit-image, libigl, pyvista and pyacvd, none of which the package itself needs for this.

Lengths are in metres, Y is up, the body faces +Z and its left is +X. Heights are measured from the hip joints.
"""

import argparse
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import igl
import numpy as np
import pyacvd
import pyvista
from scipy.ndimage import gaussian_filter1d
from scipy.sparse import csr_matrix, diags
from scipy.sparse.csgraph import connected_components, reverse_cuthill_mckee
from scipy.sparse.linalg import splu
from skimage.measure import marching_cubes

LEVELS = {"1k": 1000, "4k": 4000, "10k": 10000}
CELL = 0.008  # grid spacing [m]
LOWER, UPPER = np.array([-0.62, -0.98, -0.40]), np.array([0.62, 0.64, 0.42])  # grid corners from the hips [m]
ANGLES = 72  # directions in which the hull of a section is measured
DRAPE_CENTRE = 0.03  # depth of the axis that hulls are measured from [m]
SEAT = -0.075  # height of the crotch of trousers, down to which the cloth spans the seat [m]
CLEARANCE = 0.005  # smallest distance between garment and body at rest [m]
POSITION_STEP = 2.0**-17  # stored positions are multiples of this [m]: 8 micrometres, and they compress well
WEIGHT_LEVELS = 1024  # stored weights are multiples of 1 / WEIGHT_LEVELS and sum to one exactly

ARM = ("Arm", "ForeArm", "Hand", "FingerBase", "HandFinger1")
HAND = ("Hand", "FingerBase", "HandFinger1")
LEG = ("UpLeg", "Leg", "Foot", "ToeBase")

Surface = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class CrewNeck:
    """A round collar: cut by an ellipsoid at the base of the neck, tilted so that the front is lower than the back."""

    centre: tuple[float, float] = (0.562, 0.016)  # height and depth [m]
    tilt: float = 0.47  # angle between the collar's plane and the horizontal [rad]
    axes: tuple[float, float, float] = (0.092, 0.065, 0.092)  # half width, half height and half depth [m]


@dataclass(frozen=True)
class ScoopNeck:
    """A round low neck with straps beside it: half an ellipse seen from the front, deeper in front than behind."""

    height: float = 0.575  # height of the ellipse's centre [m]
    width: float = 0.088  # half width: the inner edge of the straps [m]
    front: float = 0.135  # depth below the centre in front [m]
    back: float = 0.075  # depth below the centre behind [m]


@dataclass(frozen=True)
class Armhole:
    """The outer edge of the straps at `width`, bending outwards below `height` to pass under the arm."""

    width: float = 0.138  # half distance between the two outer strap edges [m]
    height: float = 0.520  # where the edge starts to bend [m]
    bend: float = 1.3  # curvature of the bend [1/m]


@dataclass(frozen=True)
class Sleeve:
    """A tube around the arm from the shoulder to `length`."""

    length: float  # in upper arms; 1 is the elbow and 2 the wrist
    ease: tuple[float, ...]  # cloth minus arm radius [m], evenly spaced from the shoulder to the cuff


@dataclass(frozen=True)
class Trouser:
    """Two leg tubes down to `hem`."""

    hem: float  # height of the hem [m]
    waist: float  # height of the waistband's upper edge [m]
    ease: tuple[float, ...]  # cloth minus leg radius [m], evenly spaced from the crotch to the hem


@dataclass(frozen=True)
class Drape:
    """A tube around torso and legs that hangs from its widest section so far, as cloth does."""

    top: float  # height where the tube starts [m]
    hem: float  # height of the hem [m]
    ease: float  # distance between tube and hull of the body [m]
    flare: float = 0.0  # widening per metre of fall
    fade: float = 0.10  # fall over which the ease grows to its value [m]
    hang: bool = True  # keep the widest section; otherwise follow the body's hull


@dataclass(frozen=True)
class GarmentSpec:
    """Cut of one garment."""

    offset: float  # thickness between body and cloth where the cloth rests on it [m]
    closing: float  # radius of the closing that bridges armpit, chest and crotch [m]
    neck: CrewNeck | ScoopNeck | None = None
    armhole: Armhole | None = None
    sleeve: Sleeve | None = None
    trouser: Trouser | None = None
    drapes: tuple[Drape, ...] = ()
    smoothing: float = 0.03  # diffusion length of the skin weights [m]
    pin_depth: float = 0.0  # vertices within this distance below the top edge are pinned [m]


STRAP = ScoopNeck()
SPECS = {
    "tshirt": GarmentSpec(
        0.010, 0.030, neck=CrewNeck(), sleeve=Sleeve(0.66, (0.012, 0.020, 0.024)),
        drapes=(Drape(0.45, -0.10, 0.022, flare=0.02),),
    ),
    "tank": GarmentSpec(
        0.010, 0.030, neck=STRAP, armhole=Armhole(), drapes=(Drape(0.45, -0.10, 0.012, flare=0.02),), pin_depth=0.025
    ),
    "longsleeve": GarmentSpec(
        0.010, 0.025, neck=CrewNeck(), sleeve=Sleeve(1.90, (0.012, 0.018, 0.018, 0.016, 0.014)),
        drapes=(Drape(0.45, -0.12, 0.018),),
    ),
    "shorts": GarmentSpec(0.010, 0.012, trouser=Trouser(-0.27, 0.13, (0.016, 0.022, 0.028)), pin_depth=0.03),
    "pants": GarmentSpec(
        0.010, 0.012, trouser=Trouser(-0.875, 0.13, (0.014, 0.020, 0.024, 0.022, 0.028)), pin_depth=0.03
    ),
    "dress": GarmentSpec(
        0.010, 0.030, neck=STRAP, armhole=Armhole(), smoothing=0.08, pin_depth=0.025,
        drapes=(Drape(0.24, -0.52, 0.012, flare=0.20),),
    ),
    "kneepants": GarmentSpec(0.010, 0.012, trouser=Trouser(-0.50, 0.13, (0.014, 0.022, 0.026)), pin_depth=0.03),
    "shortsleeve": GarmentSpec(
        0.009, 0.025, neck=CrewNeck(axes=(0.098, 0.068, 0.098)), sleeve=Sleeve(0.42, (0.010, 0.016)),
        drapes=(Drape(0.43, -0.04, 0.012),),
    ),
    "tightdress": GarmentSpec(
        0.009, 0.030, neck=STRAP, armhole=Armhole(), smoothing=0.06, pin_depth=0.025,
        drapes=(Drape(0.20, -0.36, 0.010, hang=False),),
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Body:
    """The body at rest with the origin between its hip joints."""

    vertices: np.ndarray  # [B, 3] [m]
    faces: np.ndarray  # [G, 3]
    weights: np.ndarray  # dense skin weights, [B, J]
    joints: dict[str, np.ndarray]  # joint name -> position [m]
    origin: np.ndarray  # where the hips were in the file [m]
    columns: dict[str, int] = field(default_factory=dict)  # joint name -> column of `weights`

    def share(self, names: list[str]) -> np.ndarray:
        """Return the summed skin weight of the joints in `names` for every vertex, shape [B]."""
        return self.weights[:, [self.columns[name] for name in names if name in self.columns]].sum(axis=1)


def load_body(path: Path) -> Body:
    """Read the bundled body and move the midpoint of its hip joints to the origin."""
    with np.load(path) as archive:
        vertices, joints = archive["rest_positions"].astype(float), archive["joint_rest_positions"].astype(float)
        names = [str(name) for name in archive["joint_names"]]
        faces = archive["faces"].astype(np.int64)
        sparse, indices = archive["skin_weights"].astype(float), archive["skin_indices"].astype(int)
    weights = np.zeros((len(vertices), len(names)))
    np.add.at(weights, (np.arange(len(vertices))[:, None], indices), sparse)
    columns = {name: k for k, name in enumerate(names)}
    origin = 0.5 * (joints[columns["LeftUpLeg"]] + joints[columns["RightUpLeg"]])
    placed = {name: joints[k] - origin for name, k in columns.items()}
    return Body(vertices - origin, faces, weights, placed, origin, columns)


def limb_names(suffixes: tuple[str, ...], sides: tuple[str, ...] = ("Left", "Right")) -> list[str]:
    """Return the joint names of the limb on each side, thumbs with hands."""
    names = [side + suffix for side in sides for suffix in suffixes]
    return names + [side[0] + "Thumb" for side in sides if "Hand" in suffixes]


# --- Distance fields -------------------------------------------------------------------------------------------


def make_grid() -> np.ndarray:
    """Return the points of the sampling grid [m], shape [X, Y, Z, 3]."""
    axes = [np.arange(low, high, CELL) for low, high in zip(LOWER, UPPER, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


def signed_distance(points: np.ndarray, surface: Surface) -> np.ndarray:
    """Return the distance of `points` [..., 3] to a closed surface, negative inside [m]."""
    flat = np.ascontiguousarray(points.reshape(-1, 3))
    return igl.signed_distance(flat, *surface)[0].reshape(points.shape[:-1])


def extract_surface(distance: np.ndarray, level: float) -> Surface:
    """Return the level set of a grid field as an outward-oriented triangle mesh."""
    vertices, faces, _, _ = marching_cubes(distance, level, spacing=(CELL,) * 3)
    corners = vertices[faces]
    volume = np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    faces = faces if volume > 0 else faces[:, ::-1]
    return vertices.astype(float) + LOWER, np.ascontiguousarray(faces, dtype=np.int64)


def smooth_union(a: np.ndarray, b: np.ndarray, radius: float) -> np.ndarray:
    """Return the union of two distance fields with a fillet of the given radius [m]."""
    blend = np.clip(0.5 + 0.5 * (b - a) / radius, 0.0, 1.0)
    return blend * a + (1.0 - blend) * b - radius * blend * (1.0 - blend)


def smoothstep(value: np.ndarray) -> np.ndarray:
    """Return the cubic that rises from 0 at 0 to 1 at 1."""
    t = np.clip(value, 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def close_creases(distance: np.ndarray, grid: np.ndarray, radius: float) -> Surface:
    """Return the surface of the solid `distance < 0` after a morphological closing by a ball of `radius` [m]."""
    grown = extract_surface(distance, radius)
    closed = np.where(distance < radius, -9.0, 9.0)
    band = (distance > -4 * CELL) & (distance < radius + 4 * CELL)
    closed[band] = signed_distance(grid[band], grown)
    return extract_surface(closed, -radius)


def section_points(vertices: np.ndarray, faces: np.ndarray, point: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return where the mesh edges cross the plane through `point` with `normal`, shape [N, 3] [m]."""
    height = (vertices - point) @ normal
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = edges[(height[edges[:, 0]] < 0) != (height[edges[:, 1]] < 0)]
    t = height[edges[:, 0]] / (height[edges[:, 0]] - height[edges[:, 1]])
    return vertices[edges[:, 0]] + t[:, None] * (vertices[edges[:, 1]] - vertices[edges[:, 0]])


def limb_tube(body: Body, joints: list[str], suffixes: tuple[str, ...], stations: np.ndarray) -> tuple:
    """Measure a limb: centres [N, 3] and outer radii [N] of its sections [m].

    Args:
        body: The body at rest.
        joints: Names of the joints along the limb; `stations` counts bones along them.
        suffixes: Joints whose skin belongs to the limb.
        stations: Positions along the limb, e.g. 0.5 is the middle of the first bone, shape [N].
    """
    side = "Left" if joints[0].startswith("Left") else "Right"
    own = body.share(limb_names(suffixes, (side,))) > 0.5
    faces = body.faces[own[body.faces].all(axis=1)]
    chain = np.array([body.joints[name] for name in joints])
    centres, radii = [], []
    for station in stations:
        bone = min(int(station), len(chain) - 2)
        direction = chain[bone + 1] - chain[bone]
        ring = section_points(
            body.vertices, faces, chain[bone] + (station - bone) * direction, direction / np.linalg.norm(direction)
        )
        centre = 0.5 * (ring.min(axis=0) + ring.max(axis=0))
        centres.append(centre)
        radii.append(np.linalg.norm(ring - centre, axis=1).max())
    return np.array(centres), np.array(radii)


def tube_distance(points: np.ndarray, centres: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """Return the distance of `points` [..., 3] to a chain of round cones, negative inside [m]."""
    best = np.full(points.shape[:-1], 9.0)
    for start, end, radius, next_radius in zip(centres[:-1], centres[1:], radii[:-1], radii[1:], strict=True):
        axis = end - start
        t = np.clip((points - start) @ axis / (axis @ axis), 0.0, 1.0)
        reach = np.linalg.norm(points - start - t[..., None] * axis, axis=-1)
        best = np.minimum(best, reach - (radius + t * (next_radius - radius)))
    return best


def hull_directions() -> np.ndarray:
    """Return unit vectors all around, in (z, x), shape [2, ANGLES]."""
    angle = 2.0 * np.pi * np.arange(ANGLES) / ANGLES
    return np.stack([np.cos(angle), np.sin(angle)])


def drape_hulls(body: Body, heights: np.ndarray, hang: bool) -> np.ndarray:
    """Return support functions of the hull of torso and legs at falling `heights` [N], shape [N, ANGLES] [m].

    With `hang`, each hull contains all hulls above it. Averaging over directions and heights rounds the hulls.
    """
    torso = body.share(limb_names(ARM)) < 0.3
    faces = body.faces[torso[body.faces].all(axis=1)]
    support = []
    for height in heights:
        ring = section_points(body.vertices, faces, np.array([0.0, height, 0.0]), np.array([0.0, 1.0, 0.0]))
        support.append(((ring[:, [2, 0]] - [DRAPE_CENTRE, 0.0]) @ hull_directions()).max(axis=0))
    hulls = np.maximum.accumulate(support) if hang else np.array(support)
    return gaussian_filter1d(gaussian_filter1d(hulls, 2.5, axis=1, mode="wrap"), 4.0, axis=0, mode="nearest")


def drape_distance(body: Body, grid: np.ndarray, drape: Drape) -> np.ndarray:
    """Return the distance field of a hanging tube: at every height the hull of the body, plus ease and flare.

    The distance to a convex outline is the largest of `point . direction - support(direction)`.
    """
    heights = grid[0, :, 0, 1]
    plane = grid[:, 0, :, :][..., [2, 0]] - [DRAPE_CENTRE, 0.0]
    start, stop = np.searchsorted(heights, drape.top), np.searchsorted(heights, drape.hem - 0.08)
    inside = np.arange(start, stop - 1, -1)
    distance = np.full(grid.shape[:3], 9.0)
    for k, hull in zip(inside, drape_hulls(body, heights[inside], drape.hang), strict=True):
        distance[:, k] = (plane @ hull_directions() - hull).max(axis=-1)
    distance[:, start + 1 :] = distance[:, start : start + 1] + (heights[start + 1 :] - heights[start])[:, None]
    fall = np.maximum(drape.top - heights, 0.0)
    width = drape.ease * smoothstep(fall / drape.fade) + drape.flare * np.maximum(fall - 0.5 * drape.fade, 0.0)
    return distance - width[None, :, None]


def sleeve_distance(body: Body, grid: np.ndarray, sleeve: Sleeve) -> np.ndarray:
    """Return the distance field of both sleeves."""
    stations = np.linspace(0.22, sleeve.length, 12)
    ease = np.interp(np.linspace(0, 1, 12), np.linspace(0, 1, len(sleeve.ease)), sleeve.ease)
    best = np.full(grid.shape[:3], 9.0)
    for side in ("Left", "Right"):
        joints = [side + name for name in ("Arm", "ForeArm", "Hand")]
        centres, radii = limb_tube(body, joints, ARM, stations)
        centres[:, 1] -= 0.4 * ease
        best = np.minimum(best, tube_distance(grid, centres, gaussian_filter1d(radii, 1.5) + ease))
    return best


def trouser_distance(body: Body, grid: np.ndarray, trouser: Trouser) -> np.ndarray:
    """Return the distance field of both trouser legs, kept apart below the crotch."""
    bones = [body.joints["Left" + name][1] for name in ("UpLeg", "Leg", "Foot")]
    stop = np.interp(-trouser.hem, -np.array(bones), [0.0, 1.0, 2.0])
    stations = np.linspace(0.34, min(stop + 0.05, 1.98), 14)
    ease = np.interp(np.linspace(0, 1, 14), np.linspace(0, 1, len(trouser.ease)), trouser.ease)
    best = np.full(grid.shape[:3], 9.0)
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        centres, radii = limb_tube(body, [side + name for name in ("UpLeg", "Leg", "Foot")], LEG, stations)
        tube = tube_distance(grid, centres, gaussian_filter1d(radii, 2.0) + ease)
        gap = 0.004 + 0.12 * np.maximum(SEAT - 0.02 - grid[..., 1], 0.0)
        best = np.minimum(best, -smooth_union(-tube, sign * grid[..., 0] - gap, 0.02))
    seat = drape_distance(body, grid, Drape(0.10, SEAT, 0.004, hang=False))
    return smooth_union(best, -smooth_union(-seat, grid[..., 1] - SEAT, 0.02), 0.03)


def garment_solid(body: Body, grid: np.ndarray, body_distance: np.ndarray, spec: GarmentSpec) -> Surface:
    """Return the closed surface that the garment is cut from."""
    solid = body_distance - spec.offset
    for drape in spec.drapes:
        solid = smooth_union(solid, drape_distance(body, grid, drape), 0.03)
    if spec.sleeve:
        solid = smooth_union(solid, sleeve_distance(body, grid, spec.sleeve), 0.02)
    if spec.trouser:
        solid = smooth_union(solid, trouser_distance(body, grid, spec.trouser), 0.02)
    return close_creases(solid, grid, spec.closing)


# --- Cuts ------------------------------------------------------------------------------------------------------


def crew_field(points: np.ndarray, neck: CrewNeck) -> np.ndarray:
    """Return the cut field of a collar, positive where cloth stays [m]."""
    cos, sin = np.cos(neck.tilt), np.sin(neck.tilt)
    frame = np.array([[1.0, 0.0, 0.0], [0.0, cos, sin], [0.0, -sin, cos]])
    offset = (points - np.array([0.0, *neck.centre])) @ frame.T
    return neck.axes[0] * (np.linalg.norm(offset / neck.axes, axis=1) - 1.0)


def scoop_field(points: np.ndarray, neck: ScoopNeck) -> np.ndarray:
    """Return the cut field of a scoop neck, positive where cloth stays [m]."""
    depth = neck.back + (neck.front - neck.back) * smoothstep((points[:, 2] + 0.04) / 0.11)
    below = np.minimum(points[:, 1] - neck.height, 0.0)
    return neck.width * (np.hypot(points[:, 0] / neck.width, below / depth) - 1.0)


def armhole_field(points: np.ndarray, armhole: Armhole) -> np.ndarray:
    """Return the cut field of both armholes, positive where cloth stays [m]."""
    below = np.maximum(armhole.height - points[:, 1], 0.0)
    return armhole.width + armhole.bend * below**2 - np.abs(points[:, 0])


def cuff_field(points: np.ndarray, body: Body, arm_share: np.ndarray, length: float) -> np.ndarray:
    """Return the cut field of both cuffs: planes across the arm at `length` bones, positive where cloth stays [m]."""
    result = np.full(len(points), 0.1)
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        chain = np.array([body.joints[side + name] for name in ("Arm", "ForeArm", "Hand")])
        bone = min(int(length), 1)
        direction = chain[bone + 1] - chain[bone]
        cuff = chain[bone] + (length - bone) * direction
        own = (arm_share > 0.5) & (sign * points[:, 0] > 0)
        result[own] = np.minimum(((cuff - points[own]) @ direction) / np.linalg.norm(direction), 0.1)
    return result


def cut_field(points: np.ndarray, body: Body, spec: GarmentSpec) -> np.ndarray:
    """Return the field that is positive where the garment is, shape [N] [m]."""
    fields = [np.full(len(points), 0.1)]
    if isinstance(spec.neck, CrewNeck):
        fields.append(crew_field(points, spec.neck))
    elif isinstance(spec.neck, ScoopNeck):
        fields.append(scoop_field(points, spec.neck))
    if spec.armhole:
        fields.append(armhole_field(points, spec.armhole))
    if spec.sleeve:
        arm_share = nearest_body_weights(points, body)[:, [body.columns[n] for n in arm_columns(body)]].sum(axis=1)
        fields.append(cuff_field(points, body, arm_share, spec.sleeve.length))
    fields.extend(points[:, 1] - drape.hem for drape in spec.drapes)
    if spec.trouser:
        fields.extend([points[:, 1] - spec.trouser.hem, spec.trouser.waist - points[:, 1]])
    return np.min(fields, axis=0)


def arm_columns(body: Body) -> list[str]:
    """Return the arm joints that this body has."""
    return [name for name in limb_names(ARM) if name in body.columns]


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


# --- Meshes ----------------------------------------------------------------------------------------------------


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
    """Move ordered hem vertices [N, 3] onto the cut curve [M, 3] at even spacing, sliding as little as possible."""
    nearest = np.linalg.norm(points[:, None] - loop, axis=-1).argmin(axis=1)
    phase = 2.0 * np.pi * nearest / len(loop)
    even = 2.0 * np.pi * np.arange(len(points)) / len(points)
    fits = [np.exp(1j * (phase - sign * even)).mean() for sign in (1, -1)]
    sign = 1 if abs(fits[0]) > abs(fits[1]) else -1
    target = (np.angle(fits[0 if sign > 0 else 1]) + sign * even) / (2.0 * np.pi) % 1.0 * len(loop)
    low = target.astype(int) % len(loop)
    t = (target - target.astype(int))[:, None]
    return (1.0 - t) * loop[low] + t * loop[(low + 1) % len(loop)]


def fit_to_cut(vertices: np.ndarray, faces: np.ndarray, surface: Surface, iterations: int = 12) -> np.ndarray:
    """Put hems on the cut curves and relax the inside along the surface, which evens out the triangles."""
    curves = [smooth_loop(surface[0][loop]) for loop in boundary_loops(surface[1])]
    fixed = np.zeros(len(vertices), dtype=bool)
    result = vertices.copy()
    for loop in boundary_loops(faces):
        curve = min(curves, key=lambda curve: np.linalg.norm(curve.mean(axis=0) - vertices[loop].mean(axis=0)))
        result[loop] = spread_on_loop(vertices[loop], curve)
        fixed[loop] = True
    adjacency = vertex_adjacency(faces, len(vertices))
    average = diags(1.0 / np.asarray(adjacency.sum(axis=1)).ravel()) @ adjacency
    for _ in range(iterations):
        moved = 0.5 * result + 0.5 * (average @ result)
        _, _, moved = igl.point_mesh_squared_distance(moved, *surface)
        result[~fixed] = moved[~fixed]
    return result


def push_out(vertices: np.ndarray, body: Body, clearance: float) -> np.ndarray:
    """Move vertices that are closer than `clearance` [m] to the body away from it."""
    normals = face_normals(body.vertices, body.faces)
    for _ in range(5):
        distance, face, closest, _ = igl.signed_distance(vertices, body.vertices, body.faces)
        near = distance < clearance
        if not near.any():
            break
        outward = np.where(distance > 1e-4, 1.0, -1.0)[:, None] * (vertices - closest)
        length = np.linalg.norm(outward, axis=1, keepdims=True)
        outward = np.where(length > 1e-4, outward / np.maximum(length, 1e-9), normals[face])
        vertices = vertices + np.where(near, clearance - distance, 0.0)[:, None] * outward
    return vertices


def reorder(vertices: np.ndarray, faces: np.ndarray) -> Surface:
    """Number vertices and faces so that neighbours are close in memory and the file compresses well."""
    order = np.asarray(reverse_cuthill_mckee(vertex_adjacency(faces, len(vertices)), symmetric_mode=True))
    index = np.empty_like(order)
    index[order] = np.arange(len(order))
    faces = index[faces]
    first = faces.argmin(axis=1)
    faces = np.take_along_axis(faces, (first[:, None] + np.arange(3)) % 3, axis=1)
    return vertices[order], faces[np.lexsort(faces.T[::-1])]


# --- Skin weights and pins -------------------------------------------------------------------------------------


def nearest_body_weights(points: np.ndarray, body: Body) -> np.ndarray:
    """Return dense skin weights of the closest body points [N, J]; hands and head do not count."""
    hands = body.share([*limb_names(HAND), "Head"]) > 0.5
    faces = np.ascontiguousarray(body.faces[~hands[body.faces].any(axis=1)])
    _, nearest, closest = igl.point_mesh_squared_distance(points, body.vertices, faces)
    corners = body.vertices[faces[nearest]]
    coordinates = igl.barycentric_coordinates(closest, *(np.ascontiguousarray(corners[:, k]) for k in range(3)))
    coordinates = np.clip(coordinates, 0.0, 1.0)
    coordinates /= coordinates.sum(axis=1, keepdims=True)
    return np.einsum("nk,nkj->nj", coordinates, body.weights[faces[nearest]])


def diffuse(values: np.ndarray, surface: Surface, length: float) -> np.ndarray:
    """Solve one implicit heat step over the surface, `(M + length^2 L) x = M values`, for each column."""
    laplacian = -igl.cotmatrix(*surface)
    mass = igl.massmatrix(*surface, igl.MASSMATRIX_TYPE_VORONOI)
    return splu((mass + length**2 * laplacian).tocsc()).solve(np.asarray(mass @ values))


def quantise_weights(dense: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Keep the four largest weights, normalised to multiples of 1 / WEIGHT_LEVELS that sum to one.

    Returns:
        Weights [V, 4] float32 and joint indices [V, 4] int16, largest first.
    """
    indices = np.argsort(-dense, axis=1, kind="stable")[:, :4]
    top = np.clip(np.take_along_axis(dense, indices, axis=1), 0.0, None)
    counts = np.round(top / top.sum(axis=1, keepdims=True) * WEIGHT_LEVELS)
    counts[:, 0] += WEIGHT_LEVELS - counts.sum(axis=1)
    indices = np.where(counts > 0, indices, 0)
    return (counts / WEIGHT_LEVELS).astype(np.float32), indices.astype(np.int16)


def pinned_vertices(vertices: np.ndarray, spec: GarmentSpec) -> np.ndarray:
    """Return which vertices move with the body: the waistband, or the top of the shoulder straps; shape [V]."""
    return vertices[:, 1] > vertices[:, 1].max() - spec.pin_depth if spec.pin_depth else np.zeros(len(vertices), bool)


# --- Assembly --------------------------------------------------------------------------------------------------


def build_pattern(body: Body, grid: np.ndarray, body_distance: np.ndarray, spec: GarmentSpec) -> Surface:
    """Return the cut surface that all resolutions of a garment are remeshed from."""
    solid = smooth_surface(garment_solid(body, grid, body_distance, spec), 10)
    return cut_surface(solid, cut_field(solid[0], body, spec))


def build_level(body: Body, pattern: Surface, spec: GarmentSpec, num_vertices: int) -> dict[str, np.ndarray]:
    """Return the arrays of one garment file."""
    vertices, faces = remesh(pattern, num_vertices, len(boundary_loops(pattern[1])))
    vertices = push_out(fit_to_cut(vertices, faces, pattern), body, CLEARANCE)
    vertices, faces = reorder(vertices, faces)
    weights, indices = quantise_weights(
        diffuse(nearest_body_weights(vertices, body), (vertices, faces), spec.smoothing)
    )
    return {
        "rest_positions": (np.round((vertices + body.origin) / POSITION_STEP) * POSITION_STEP).astype(np.float32),
        "faces": faces.astype(np.int32),
        "skin_weights": weights,
        "skin_indices": indices,
        "pinned": pinned_vertices(vertices, spec),
    }


def describe(garment: dict[str, np.ndarray], body: Body) -> dict[str, float]:
    """Measure a garment: sizes, triangle quality and distance to the body."""
    vertices, faces = garment["rest_positions"].astype(float), garment["faces"].astype(np.int64)
    edges, _ = mesh_edges(faces)
    length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    distance = igl.signed_distance(vertices - body.origin, body.vertices, body.faces)[0]
    return {
        "V": len(vertices),
        "F": len(faces),
        "area": round(float(igl.doublearea(vertices, faces).sum()) / 2, 3),
        "edge_mm": round(1e3 * float(length.mean()), 1),
        "edge_cv": round(float(length.std() / length.mean()), 3),
        "min_angle": round(float(np.degrees(igl.internal_angles(vertices, faces).min())), 1),
        "clearance_mm": round(1e3 * float(distance.min()), 1),
        "ease_mm": round(1e3 * float(np.median(distance)), 1),
        "loops": len(boundary_loops(faces)),
        "pinned": int(garment["pinned"].sum()),
    }


def build_all(body: Body, names: list[str], levels: list[str], out: Path, report: Callable[[str], None]) -> None:
    """Build and write the named garments at the named levels."""
    grid = make_grid()
    body_distance = signed_distance(grid, (body.vertices, body.faces))
    out.mkdir(parents=True, exist_ok=True)
    for name in names:
        pattern = build_pattern(body, grid, body_distance, SPECS[name])
        for level in levels:
            garment = build_level(body, pattern, SPECS[name], LEVELS[level])
            np.savez_compressed(out / f"{name}_{level}.npz", **garment)
            report(json.dumps({"garment": f"{name}_{level}", **describe(garment, body)}))


def main() -> None:
    """Parse the command line and build."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("body", type=Path, help="the bundled body, e.g. data/body/anny_cmu.npz")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "garments")
    parser.add_argument("--names", nargs="+", default=list(SPECS), choices=list(SPECS))
    parser.add_argument("--levels", nargs="+", default=list(LEVELS), choices=list(LEVELS))
    arguments = parser.parse_args()
    body = load_body(arguments.body)
    build_all(body, arguments.names, arguments.levels, arguments.out, lambda line: print(line, flush=True))


if __name__ == "__main__":
    main()
