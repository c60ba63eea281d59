"""The bundled garments on five other bodies: what carrying them there costs in stretch, and pictures.

    python experiments/other_bodies.py [--smoke] [--out DIR]    (the figure needs the extra `remesh`)

The bodies are synthetic, since no SMPL model and no bought character may ship: the bundled body in other
proportions and on other rigs, in T-poses, and a figure of capsules with a surface of its own.
"""

import dataclasses
import time
import warnings
from typing import Any

import jax
import numpy as np
from harness import keep, kept, parser

from eslr_jax.config import SimConfig
from eslr_jax.mesh.padding import choose_bucket, common_bucket
from eslr_jax.mesh.prepare import pad_alike
from eslr_jax.pipeline.assets import load_body, load_garment, load_motion
from eslr_jax.pipeline.dressing.clearance import body_heights
from eslr_jax.pipeline.dressing.postures import find_arms, rest_posture
from eslr_jax.pipeline.extras import require
from eslr_jax.pipeline.pictures import render_frame, side_by_side, write_png
from eslr_jax.pipeline.report.metrics import measure_frames
from eslr_jax.pipeline.report.report import environment, trajectory_report
from eslr_jax.pipeline.rigs.rig import UnitsWarning, body_skeleton, make_body
from eslr_jax.pose.joints import find_parts
from eslr_jax.pose.motion import Motion, obstacle_surface, pose_body, shape_body, still_motion
from eslr_jax.pose.skeleton import RiggedMesh, Skeleton
from eslr_jax.pose.timing import SETTLE_FRAMES, with_settling
from eslr_jax.simulation.plan import prepare_scene
from eslr_jax.simulation.simulate import last_frames, simulate
from eslr_jax.terms import Ground, scene_terms
from eslr_jax.types import Body

_SMPL = {
    "pelvis": "Hips", "left_hip": "LeftUpLeg", "right_hip": "RightUpLeg", "spine1": "LowerBack",
    "left_knee": "LeftLeg", "right_knee": "RightLeg", "spine2": "Spine", "left_ankle": "LeftFoot",
    "right_ankle": "RightFoot", "spine3": "Spine1", "left_foot": "LeftToeBase", "right_foot": "RightToeBase",
    "neck": "Neck", "left_collar": "LeftShoulder", "right_collar": "RightShoulder", "head": "Head",
    "left_shoulder": "LeftArm", "right_shoulder": "RightArm", "left_elbow": "LeftForeArm",
    "right_elbow": "RightForeArm", "left_wrist": "LeftHand", "right_wrist": "RightHand",
    "left_hand": "LeftFingerBase", "right_hand": "RightFingerBase",
}  # fmt: skip
_MIXAMO = {"LowerBack": "Spine", "Spine": "Spine1", "Spine1": "Spine2"}


def proportioned(
    mesh: RiggedMesh, lengths: dict[str, float], girths: dict[str, float], size: float = 1.0
) -> RiggedMesh:
    """Return a body of other proportions, larger by a size.

    Bones become longer by `lengths`, and thicker by `girths`, factors by their part, such as upper_leg.
    """
    skeleton = mesh.skeleton
    part_of = {joint: part[1] for part, joints in find_parts(skeleton).items() for joint in joints}
    rest, count = skeleton.rest_positions, len(skeleton)
    maps = np.tile(np.eye(3), (count, 1, 1))
    for joint in range(count):
        children = [child for child, parent in enumerate(skeleton.parents) if parent == joint]
        part = part_of.get(joint, "")
        axis = rest[children].mean(axis=0) - rest[joint] if children else np.array([0.0, 1.0, 0.0])
        if part in ("hips", "spine", "neck", "head") or np.linalg.norm(axis) < 1e-6:
            axis = np.array([0.0, 1.0, 0.0])
        axis = axis / np.linalg.norm(axis)
        along = np.outer(axis, axis)
        maps[joint] = size * (lengths.get(part, 1.0) * along + girths.get(part, 1.0) * (np.eye(3) - along))
    places = rest.copy()
    for joint, parent in enumerate(skeleton.parents):
        above = places[parent] + maps[parent] @ (rest[joint] - rest[parent])
        places[joint] = above if parent >= 0 else size * rest[joint]
    shifts = places - np.einsum("jxy,jy->jx", maps, rest)
    transforms = np.concatenate([maps, shifts[:, :, None]], axis=2)
    blended = np.einsum("vi,vixy->vxy", mesh.skin_weights, transforms[mesh.skin_indices])
    positions = np.einsum("vxy,vy->vx", blended[:, :, :3], mesh.positions) + blended[:, :, 3]
    return moved(mesh, positions, places)


def moved(mesh: RiggedMesh, positions: np.ndarray, places: np.ndarray) -> RiggedMesh:
    """Return a body with vertices and joints at other places [m]."""
    skeleton = dataclasses.replace(mesh.skeleton, rest_positions=places)
    return dataclasses.replace(mesh, positions=positions, skeleton=skeleton)


def posed(mesh: RiggedMesh, arm_angle: float) -> RiggedMesh:
    """Return a body that rests with its arms lifted by an angle [degrees], as a T-pose does."""
    body = make_body(mesh)
    poses = pose_body(body, still_motion(body, 1, arm_angle=arm_angle))
    transforms = np.asarray(poses.joint_transforms[0], np.float64)
    rest = mesh.skeleton.rest_positions
    places = np.einsum("jxy,jy->jx", transforms[:, :, :3], rest) + transforms[:, :, 3]
    return moved(mesh, np.asarray(poses.positions[0], np.float64), places)


def renamed(
    mesh: RiggedMesh, names: tuple[str, ...], parents: tuple[int, ...], owner: np.ndarray
) -> RiggedMesh:
    """Return a body on a rig of other names and parents; `owner` has the new joint of every old one."""
    first = [int(np.argmax(owner == joint)) for joint in range(len(names))]
    weights = np.zeros((len(mesh.positions), len(names)))
    rows = np.arange(len(weights))[:, None]
    np.add.at(weights, (rows, owner[mesh.skin_indices]), mesh.skin_weights)
    skeleton = Skeleton(names, parents, mesh.skeleton.rest_positions[first])
    kept, chosen = strongest(weights)
    return dataclasses.replace(mesh, skin_weights=kept, skin_indices=chosen, skeleton=skeleton)


def strongest(weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the four largest weights of every vertex, with sum one, and their joints."""
    chosen = np.argsort(-weights, axis=1, kind="stable")[:, :4]
    kept = np.take_along_axis(weights, chosen, axis=1)
    return kept / kept.sum(axis=1, keepdims=True), chosen


def bundled_mesh(body: Body | None = None) -> RiggedMesh:
    """Return the bundled body as if it came from a file."""
    body = load_body() if body is None else body
    return RiggedMesh(
        "body", np.asarray(body.rest_positions, np.float64), np.asarray(body.faces),
        np.asarray(body.skin_weights, np.float64), np.asarray(body.skin_indices), body_skeleton(body),
    )  # fmt: skip


def smpl_rig(mesh: RiggedMesh) -> RiggedMesh:
    """Return a body on SMPL's 24 joints."""
    old, parents = list(mesh.skeleton.joint_names), mesh.skeleton.parents
    names = tuple(_SMPL)
    home = {theirs: names.index(ours) for ours, theirs in _SMPL.items()}
    owner = np.zeros(len(old), int)
    for joint, name in enumerate(old):
        owner[joint] = home[name] if name in home else owner[parents[joint]]
    places = [old.index(theirs) for theirs in _SMPL.values()]
    tree = tuple(-1 if parents[place] < 0 else int(owner[parents[place]]) for place in places)
    return moved(renamed(mesh, names, tree, owner), mesh.positions, mesh.skeleton.rest_positions[places])


def smpl_male() -> RiggedMesh:
    """Return a tall man in SMPL's T-pose: broad shoulders, narrow hips."""
    mesh = bundled_mesh(shape_body(load_body(), [0.3, -0.5]))
    mesh = proportioned(mesh, {"clavicle": 1.12}, {"spine": 1.08, "upper_arm": 1.15, "hips": 0.97})
    return smpl_rig(posed(mesh, 47.0))


def smpl_female() -> RiggedMesh:
    """Return a short woman in SMPL's T-pose: narrow shoulders, wide hips."""
    mesh = bundled_mesh(shape_body(load_body(), [-1.6, 0.5, 0.0, 1.0]))
    girths = {"spine": 0.92, "upper_arm": 0.85, "forearm": 0.85, "hips": 1.08, "upper_leg": 1.08}
    return smpl_rig(posed(proportioned(mesh, {"clavicle": 0.9}, girths), 47.0))


def child() -> RiggedMesh:
    """Return a child of 1.1 m: a large head, short limbs, no waist."""
    lengths = {"upper_leg": 0.78, "lower_leg": 0.76, "upper_arm": 0.85, "forearm": 0.85}
    lengths |= {"neck": 0.8, "head": 1.35}
    girths = {"head": 1.4, "neck": 1.05, "upper_arm": 1.05, "clavicle": 0.95}
    return smpl_rig(proportioned(bundled_mesh(), lengths, girths, size=0.68))


def mixamo() -> RiggedMesh:
    """Return a hero in Mixamo's T-pose and centimetres: long legs, a chest, thin arms."""
    mesh = bundled_mesh()
    lengths = {"upper_leg": 1.12, "lower_leg": 1.12, "clavicle": 1.2}
    mesh = proportioned(mesh, lengths, {"spine": 1.12, "forearm": 0.9, "upper_leg": 0.92, "hips": 0.9})
    mesh = posed(mesh, 47.0)
    names = tuple(f"mixamorig:{_MIXAMO.get(name, name)}" for name in mesh.skeleton.joint_names)
    mesh = renamed(mesh, names, mesh.skeleton.parents, np.arange(len(names)))
    return moved(mesh, 100.0 * mesh.positions, 100.0 * mesh.skeleton.rest_positions)


# A figure of capsules: joint by VRM's name, parent, place [m].
_FIGURE = (
    ("C_Hips", -1, (0.0, 0.52, 0.0)), ("C_Spine", 0, (0.0, 0.60, 0.0)),
    ("C_Chest", 1, (0.0, 0.72, 0.0)), ("C_Neck", 2, (0.0, 0.86, 0.0)),
    ("C_Head", 3, (0.0, 0.93, 0.0)), ("L_Shoulder", 2, (0.03, 0.82, 0.0)),
    ("L_UpperArm", 5, (0.15, 0.81, 0.0)), ("L_LowerArm", 6, (0.29, 0.70, 0.0)),
    ("L_Hand", 7, (0.43, 0.59, 0.0)), ("R_Shoulder", 2, (-0.03, 0.82, 0.0)),
    ("R_UpperArm", 9, (-0.15, 0.81, 0.0)), ("R_LowerArm", 10, (-0.29, 0.70, 0.0)),
    ("R_Hand", 11, (-0.43, 0.59, 0.0)), ("L_UpperLeg", 0, (0.085, 0.48, 0.0)),
    ("L_LowerLeg", 13, (0.10, 0.27, 0.0)), ("L_Foot", 14, (0.11, 0.06, 0.0)),
    ("R_UpperLeg", 0, (-0.085, 0.48, 0.0)), ("R_LowerLeg", 16, (-0.10, 0.27, 0.0)),
    ("R_Foot", 17, (-0.11, 0.06, 0.0)),
)  # fmt: skip
_CAPSULES = (  # joint, start and end [m], radii [m]
    (0, (-0.04, 0.50, 0.0), (0.04, 0.50, 0.0), 0.095, 0.095),
    (1, (0.0, 0.56, 0.01), (0.0, 0.68, 0.0), 0.110, 0.100),
    (2, (-0.05, 0.74, 0.0), (0.05, 0.74, 0.0), 0.095, 0.095),
    (3, (0.0, 0.80, 0.0), (0.0, 0.95, 0.0), 0.055, 0.05),
    (4, (0.0, 1.06, 0.0), (0.0, 1.10, 0.01), 0.17, 0.17),
    *((k, (s * 0.06, 0.80, 0.0), (s * 0.15, 0.81, 0.0), 0.06, 0.050) for k, s in ((5, 1), (9, -1))),
    *((k, (s * 0.15, 0.81, 0.0), (s * 0.29, 0.70, 0.0), 0.048, 0.040) for k, s in ((6, 1), (10, -1))),
    *((k, (s * 0.29, 0.70, 0.0), (s * 0.43, 0.59, 0.0), 0.040, 0.035) for k, s in ((7, 1), (11, -1))),
    *((k, (s * 0.43, 0.59, 0.0), (s * 0.47, 0.56, 0.0), 0.045, 0.045) for k, s in ((8, 1), (12, -1))),
    *((k, (s * 0.085, 0.47, 0.0), (s * 0.10, 0.27, 0.0), 0.075, 0.058) for k, s in ((13, 1), (16, -1))),
    *((k, (s * 0.10, 0.27, 0.0), (s * 0.11, 0.06, 0.0), 0.058, 0.045) for k, s in ((14, 1), (17, -1))),
    *((k, (s * 0.11, 0.05, 0.0), (s * 0.12, 0.05, 0.09), 0.05, 0.045) for k, s in ((15, 1), (18, -1))),
)  # fmt: skip
_CELL = 0.012  # [m] of the grid
_BLEND = 0.02  # [m] of the smooth union of two capsules


def figure() -> RiggedMesh:
    """Return a figure of 1.27 m with a large head, of capsules that flow into each other, in an A-pose."""
    pyvista = require("pyvista", extra="remesh", purpose="the figure's surface")
    low, high = np.array([-0.55, -0.05, -0.25]), np.array([0.55, 1.35, 0.25])
    counts = np.ceil((high - low) / _CELL).astype(int)
    grid = pyvista.ImageData(dimensions=tuple(counts), spacing=(_CELL,) * 3, origin=tuple(low))
    points = np.asarray(grid.points)
    distances = _capsule_distances(points)
    grid["d"] = -_BLEND * np.log(np.exp(-distances / _BLEND).sum(axis=1))
    surface = grid.contour([0.0], scalars="d").triangulate().clean()
    positions, faces = np.array(surface.points, float), np.array(surface.regular_faces)
    if np.sum(np.linalg.det(positions[faces])) < 0:
        faces = faces[:, ::-1]
    closeness = np.exp(-np.maximum(_capsule_distances(positions), 0.0) / 0.015)
    weights = np.zeros((len(positions), len(_FIGURE)))
    np.add.at(weights, (slice(None), [joint for joint, *_ in _CAPSULES]), closeness)
    names, parents, places = zip(*_FIGURE, strict=True)
    skeleton = Skeleton(tuple(f"J_Bip_{name}" for name in names), parents, np.array(places, float))
    return RiggedMesh("figure", positions, faces, *strongest(weights), skeleton)


def _capsule_distances(points: np.ndarray) -> np.ndarray:
    """Return the distance of points to every capsule [m], shape [points, capsules]."""
    result = np.empty((len(points), len(_CAPSULES)))
    for k, (_, start, end, first, last) in enumerate(_CAPSULES):
        start, end = np.array(start), np.array(end)
        share = np.clip((points - start) @ (end - start) / ((end - start) @ (end - start)), 0, 1)
        gap = np.linalg.norm(points - start - share[:, None] * (end - start), axis=1)
        result[:, k] = gap - (first + share * (last - first))
    return result


BODIES = {make.__name__: make for make in (smpl_male, smpl_female, child, mixamo, figure)}
GARMENTS = (
    "tshirt", "tank", "longsleeve", "shortsleeve", "dress", "tightdress", "shorts", "kneepants", "pants",
)  # fmt: skip
CLIP, FRAMES = "cmu_016_32", 100  # a walk, and frames of it
STILL, RAISE = 50, 25  # frames that the body stands, and in which it lifts its arms to its own rest pose
STANDING = 45.0  # [degrees] of the arms below the horizontal, as garments are cut
CONFIG = SimConfig(iterations=30)


def standing_motion(body: Body, frames: int) -> Motion:
    """Return a motion of a body that stands with its arms at 45 degrees, then lifts them to its rest pose."""
    (shoulder, elbow), *_ = find_arms(body) or [(0, 1)]
    bone = np.asarray(body.joint_rest_positions, np.float64)[[shoulder, elbow]]
    angle = np.degrees(np.arctan2(bone[0, 1] - bone[1, 1], abs(bone[1, 0] - bone[0, 0]))) - STANDING
    lowered = still_motion(body, frames, arm_angle=float(angle))
    share = np.clip((np.arange(frames) - STILL) / RAISE, 0.0, 1.0)
    return dataclasses.replace(lowered, rotations=(1.0 - share[:, None, None]) * lowered.rotations)


def measure(body: Body, garments: tuple[str, ...] = GARMENTS, vertices: str = "1k", frames: int = FRAMES):
    """Yield how bundled garments sit on a body at rest and on a walk: figures, and what a picture needs."""
    began = time.perf_counter()
    own = [load_garment(name, vertices=vertices, body=body, cache=False) for name in garments]  # type: ignore[arg-type]
    took = (time.perf_counter() - began) / len(own)
    cloths = pad_alike(own, common_bucket([choose_bucket(cloth) for cloth in own]))
    options = {"terms": scene_terms(without=(Ground,)), "integrator": "bdf2"}
    options["surface"] = obstacle_surface(body)  # bodies of one topology then share a program
    still = pose_body(body, standing_motion(body, SETTLE_FRAMES + frames))
    walk = pose_body(body, load_motion(CLIP, body=body), num_frames=frames)
    for name, cloth in zip(garments, cloths, strict=True):
        is_real = np.asarray(cloth.vertex_mask)
        standing, walking = (
            simulate(None, prepare_scene(cloth, poses, **options), config=CONFIG, raises=False)
            for poses in (still, with_settling(walk, SETTLE_FRAMES, body))
        )
        at_rest = jax.device_get(measure_frames(standing.trajectory.positions, standing.scene))
        trajectory, scene = last_frames(walking.trajectory, walking.scene, frames)
        moving = trajectory_report(trajectory, scene, poses=walk)
        positions = np.asarray(trajectory.positions)[:, is_real]
        depth = -at_rest.distances[[STILL - 1, -1]][:, is_real].min()  # of the deepest vertex [m]
        heights, _ = body_heights(np.asarray(cloth.rest_positions, np.float64)[is_real], rest_posture(body))
        yield (
            {
                "garment": name,
                "transfer_s": round(took, 2),
                "inside_at_rest": int((heights < 0).sum()),
                "standing_max_stretch": float(at_rest.max_stretch[STILL - 1]),
                "standing_p99_stretch": float(at_rest.p99_stretch[STILL - 1]),
                "rest_max_stretch": float(at_rest.max_stretch[-1]),
                "rest_p99_stretch": float(at_rest.p99_stretch[-1]),
                "rest_inside_mm": float(max(depth, 0.0) * 1e3),
                "walk_finite": moving["finite"] and int(trajectory.status) == 0,
                "walk_p99_stretch": moving["p99_principal_stretch"],
                "walk_max_stretch": moving["max_principal_stretch"],
                "walk_inside_mm": moving["penetration_max_mm"],
            },
            (
                np.asarray(walk.positions),
                positions,
                np.asarray(cloth.faces)[np.asarray(cloth.rest_areas) > 0],
            ),
        )


def main() -> None:
    options = parser(__doc__, "one garment, one body, few frames")
    options.add_argument("--bodies", nargs="+", default=["bundled", *BODIES], choices=["bundled", *BODIES])
    chosen = options.parse_args()
    names, garments = (["mixamo"], GARMENTS[:1]) if chosen.smoke else (chosen.bodies, GARMENTS)
    path = chosen.out / "other_bodies.json"
    about = {"clip": CLIP, "frames": FRAMES, "iterations": CONFIG.iterations, **environment()}
    table: dict[str, Any] = {**kept(path), **about}
    for name in names:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UnitsWarning)  # Mixamo's is in centimetres, on purpose
            body = load_body() if name == "bundled" else make_body(BODIES[name]())
        rows, pictures = [], []
        dressed = {"rest_positions": np.asarray(body.rest_positions), "rig": body, "follows": False}
        for row, (moving, positions, faces) in measure(
            body, garments, frames=STILL if chosen.smoke else FRAMES
        ):
            print(name, row, flush=True)
            rows.append(row)
            mesh = (moving[-1], np.asarray(body.faces), positions[-1], faces)
            pictures.append(render_frame(*mesh, camera=25.0, size=(180, 280), **dressed))
        table[name] = rows
        write_png(
            chosen.out / f"other_bodies_{name}.png", side_by_side(pictures, [row["garment"] for row in rows])
        )
        keep(path, table)


if __name__ == "__main__":
    main()
