"""The solid that a garment is cut from, as a distance field around the body, and the fields that cut it.

Lengths are in metres, Y is up, the body faces +Z and its left is +X. Heights are measured from the hips.
"""

from dataclasses import dataclass, field
from pathlib import Path

import igl
import numpy as np
from garment_mesh import Surface
from garment_specs import Armhole, Drape, GarmentSpec, Neck, Sleeve, Trouser
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

CELL = 0.008  # grid spacing [m]
LOWER, UPPER = np.array([-0.62, -0.98, -0.40]), np.array([0.62, 0.64, 0.42])  # grid corners from the hips [m]
ANGLES = 72  # directions in which the hull of a section is measured
DRAPE_CENTRE = 0.03  # depth of the axis that hulls are measured from [m]
DRAPE_SINK = 0.01  # depth below the hull at which a drape starts, so that it leaves the body smoothly [m]
SEAT = -0.075  # height of the crotch of trousers [m]
SEAM_BEND = 1.5  # how fast the crotch seam rises to the front and the back [1/m]

ARM = ("Arm", "ForeArm", "Hand", "FingerBase", "HandFinger1")
HAND = ("Hand", "FingerBase", "HandFinger1")
LEG = ("UpLeg", "Leg", "Foot", "ToeBase")


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
        vertices, joints = (
            archive["rest_positions"].astype(float),
            archive["joint_rest_positions"].astype(float),
        )
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


def nearest_body_weights(points: np.ndarray, body: Body) -> np.ndarray:
    """Return dense skin weights of the closest body points [N, J]; hands and head do not count."""
    hands = body.share([*limb_names(HAND), "Head"]) > 0.5
    faces = np.ascontiguousarray(body.faces[~hands[body.faces].any(axis=1)])
    _, nearest, closest = igl.point_mesh_squared_distance(points, body.vertices, faces)
    corners = body.vertices[faces[nearest]]
    coordinates = igl.barycentric_coordinates(
        closest, *(np.ascontiguousarray(corners[:, k]) for k in range(3))
    )
    coordinates = np.clip(coordinates, 0.0, 1.0)
    coordinates /= coordinates.sum(axis=1, keepdims=True)
    return np.einsum("nk,nkj->nj", coordinates, body.weights[faces[nearest]])


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
    """Return the surface of the solid `distance < 0` after a morphological closing by a ball of `radius` [m].

    The closing is what lies deeper than `radius` inside the solid grown by `radius`. Depth is measured to the
    corners and centres of the grown surface's faces, which is exact to a tenth of a millimetre.
    """
    vertices, faces = extract_surface(distance, radius)
    samples = cKDTree(np.concatenate([vertices, vertices[faces].mean(axis=1)]))
    closed = np.where(distance < radius, -9.0, 9.0)
    band = (distance > -2 * CELL) & (distance < radius + CELL)
    closed[band] = samples.query(grid[band])[0] * np.sign(distance[band] - radius)
    return extract_surface(closed, -radius)


def section_points(
    vertices: np.ndarray, faces: np.ndarray, point: np.ndarray, normal: np.ndarray
) -> np.ndarray:
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
            body.vertices,
            faces,
            chain[bone] + (station - bone) * direction,
            direction / np.linalg.norm(direction),
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

    With `hang`, each hull contains all hulls above it. Averaging over directions and heights rounds them.
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
    distance[:, start + 1 :] = (
        distance[:, start : start + 1] + (heights[start + 1 :] - heights[start])[:, None]
    )
    fall = np.maximum(drape.top - heights, 0.0)
    width = (drape.ease + DRAPE_SINK) * smoothstep(fall / drape.fade) - DRAPE_SINK
    width += drape.flare * np.maximum(fall - 0.5 * drape.fade, 0.0)
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
        gap = 0.010 + 0.15 * np.maximum(SEAT - 0.02 - grid[..., 1], 0.0)
        best = np.minimum(best, -smooth_union(-tube, sign * grid[..., 0] - gap, 0.02))
    seat = drape_distance(body, grid, Drape(0.10, SEAT, 0.004, hang=False))
    seam = SEAT + SEAM_BEND * (grid[..., 2] - 0.01) ** 2
    return smooth_union(best, -smooth_union(-seat, grid[..., 1] - seam, 0.03), 0.05)


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


def neck_field(points: np.ndarray, neck: Neck) -> np.ndarray:
    """Return the cut field of the neck, positive where cloth stays [m]."""
    depth = neck.back + (neck.front - neck.back) * smoothstep((points[:, 2] + 0.04) / 0.11)
    below = np.minimum(points[:, 1] - neck.height, 0.0)
    return neck.width * (np.hypot(points[:, 0] / neck.width, below / depth) - 1.0)


def armhole_field(points: np.ndarray, armhole: Armhole) -> np.ndarray:
    """Return the cut field of both armholes, positive where cloth stays [m]."""
    below = np.maximum(armhole.height - points[:, 1], 0.0)
    return armhole.width + armhole.bend * below**2 - np.abs(points[:, 0])


def cuff_field(points: np.ndarray, body: Body, arm_share: np.ndarray, length: float) -> np.ndarray:
    """Return the cut field of both cuffs, planes across the arm; positive where cloth stays [m]."""
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
    if spec.neck:
        fields.append(neck_field(points, spec.neck))
    if spec.armhole:
        fields.append(armhole_field(points, spec.armhole))
    if spec.sleeve:
        arm_share = nearest_body_weights(points, body)[:, [body.columns[n] for n in arm_columns(body)]].sum(
            axis=1
        )
        fields.append(cuff_field(points, body, arm_share, spec.sleeve.length))
    fields.extend(points[:, 1] - drape.hem for drape in spec.drapes)
    if spec.trouser:
        fields.extend([points[:, 1] - spec.trouser.hem, spec.trouser.waist - points[:, 1]])
    return np.min(fields, axis=0)


def arm_columns(body: Body) -> list[str]:
    """Return the arm joints that this body has."""
    return [name for name in limb_names(ARM) if name in body.columns]
