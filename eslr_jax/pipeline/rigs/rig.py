"""Convert what a file holds for simulation: a rigged mesh to a body, a moving skeleton to a motion (host)."""

from __future__ import annotations

import dataclasses
import math
import warnings
from collections.abc import Mapping

import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy.sparse.csgraph import breadth_first_order

from eslr_jax.errors import AssetError, MotionError
from eslr_jax.files.npz import check_layout
from eslr_jax.mesh.validate import UNITS, check_outward
from eslr_jax.numerics import to_device
from eslr_jax.pipeline.formats.mesh import shared_vertices
from eslr_jax.pipeline.rigs.alignment import LIMBS, align_rests, match_parts, rig_scale
from eslr_jax.pose.joints import HAND, find_named_parts, find_parts, map_joints
from eslr_jax.pose.motion import Motion
from eslr_jax.pose.retarget import ARM_ABDUCTION, global_rotations, leg_length, local_rotations
from eslr_jax.pose.skeleton import RiggedMesh, Skeleton, SkeletonMotion, chain_positions
from eslr_jax.types import Body

MODEL_JOINTS = 18  # joints that a body shares with the SMPL family's 22 to be one of it
GROUND_QUANTILE = 0.05  # of the lowest sole of each frame: robust to a toe that dips for a moment
LOST_MOVE = 0.01  # [m] by which a character's joint may miss its place in the file without a word
_HUMAN = 1.7  # [m]
_IN_METRES = (0.3, 3.0)  # [m] extents of bodies that are taken to be in metres
_IN_UNITS = (0.5, 2.6)  # [m] extents that make another unit believable
_EXTENTS = (1e-4, 1e6)  # of a body in any unit; beyond, the file is damaged
_LAYOUT = {  # of a RiggedMesh
    "joints": ("f", "joints 3"),
    "positions": ("f", "vertices 3"),
    "faces": ("iu", "faces 3", "vertices"),
    "skin_weights": ("f", "vertices influences"),
    "skin_indices": ("iu", "vertices influences", "joints"),
}
_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # from Z up


class UnitsWarning(UserWarning):
    """The unit of a file was guessed."""


def metres_per_unit(name: str, extent: float, units: str | None = None) -> float:
    """Return the metres per unit of a body's file; warn with one line if that is a guess.

    A body of a person's size in metres is in metres. Otherwise the unit that comes closest to an adult's height
    is taken, and a body that fits no unit is scaled to that height. `extent` is the largest side of its bounding
    box, `units` one of `UNITS`, or a number of metres per unit.

    Raises:
        AssetError: The unit is unknown, or the body's extent is none.
    """
    if units in UNITS:
        return UNITS[units]
    if units is not None:
        try:
            scale = float(units)
        except ValueError:
            scale = math.nan
        if not (math.isfinite(scale) and scale > 0):
            raise AssetError(f"{name}: unknown unit {units!r}; give {', '.join(UNITS)}, or metres per unit")
        return scale
    if _IN_METRES[0] <= extent <= _IN_METRES[1]:
        return 1.0
    if not _EXTENTS[0] <= extent <= _EXTENTS[1]:
        raise AssetError(f"{name} is {extent:.4g} units large; export it again in metres")
    heights = {unit: extent * metres for unit, metres in UNITS.items() if unit != "m"}
    fitting = {unit: height for unit, height in heights.items() if _IN_UNITS[0] <= height <= _IN_UNITS[1]}
    if fitting:
        unit = min(fitting, key=lambda unit: abs(math.log(fitting[unit] / _HUMAN)))
        text = f"taken to be in {unit}, which makes it {fitting[unit]:.2f} m"
        scale = UNITS[unit]
    else:
        scale = _HUMAN / extent
        text = f"scaled to {_HUMAN} m, since no unit makes it a person"
    warnings.warn(
        f"{name} is {extent:.4g} units large: {text}; name its unit if not (a person of {_HUMAN} m has "
        f"{_HUMAN / extent:.3g} m per unit)",
        UnitsWarning,
        stacklevel=3,
    )
    return scale


def body_skeleton(body: Body) -> Skeleton:
    """Return a body's joints at rest."""
    rest = np.asarray(body.joint_rest_positions, np.float64)
    return Skeleton(body.joint_names, body.parents, rest)


def make_body(mesh: RiggedMesh, *, units: str | None = None) -> Body:
    """Return a rigged mesh as a body in metres; by default its unit is recognised, see `metres_per_unit`.

    Vertices at one place are joined, the hips become joint 0, and hands are no obstacle.

    Raises:
        AssetError: The mesh is empty, not finite or hands alone, its weights and faces don't fit, or its unit is
            unknown.
        MeshError: Its faces point inside.
    """
    _check_mesh(mesh)
    scale = metres_per_unit(f"body {mesh.name}", float(np.ptp(mesh.positions, axis=0).max()), units)
    vertices, places = shared_vertices(mesh.positions)
    faces = places[mesh.faces]
    corners = np.sort(faces, axis=1)
    faces = faces[(corners[:, 0] != corners[:, 1]) & (corners[:, 1] != corners[:, 2])]
    check_outward(mesh.positions[vertices], faces, name=f"body {mesh.name}")
    skeleton, order = hips_first(mesh.skeleton)
    joint_place = np.argsort(order)
    indices = joint_place[mesh.skin_indices[vertices]]
    weights = mesh.skin_weights[vertices]

    def lengths(values: NDArray):
        return scale * values

    shapes, joint_shapes = mesh.shape_directions, mesh.joint_shape_directions
    if shapes is None or joint_shapes is None:
        shapes, joint_shapes = np.zeros((len(mesh.positions), 3, 0)), np.zeros((len(order), 3, 0))
    is_hand = np.zeros(len(skeleton), bool)
    for (_, chain), joints in find_parts(skeleton).items():
        is_hand[joints] |= chain in HAND
    for joint, parent in enumerate(skeleton.parents):
        is_hand[joint] |= parent >= 0 and is_hand[parent]
    leading = np.take_along_axis(indices, weights.argmax(1)[:, None], axis=1)[:, 0]
    is_obstacle = ~is_hand[leading][faces].all(axis=1)
    if not is_obstacle.any():
        raise AssetError(f"body {mesh.name} is hands alone; bind its other meshes to its skeleton")
    rigged = Body(
        rest_positions=lengths(mesh.positions[vertices]),
        shape_directions=lengths(shapes[vertices]),
        joint_rest_positions=lengths(skeleton.rest_positions),
        joint_shape_directions=lengths(joint_shapes[order]),
        skin_weights=weights / weights.sum(1, keepdims=True),
        skin_indices=indices,
        faces=faces,
        is_obstacle=is_obstacle,
        parents=skeleton.parents,
        joint_names=skeleton.joint_names,
        pose_directions=None if mesh.pose_directions is None else lengths(mesh.pose_directions[vertices]),
    )
    return to_device(rigged)


def _check_mesh(mesh: RiggedMesh) -> None:
    arrays = vars(mesh) | {"joints": mesh.skeleton.rest_positions}
    check_layout(arrays, _LAYOUT, what=f"body {mesh.name}", remedy="export it again")
    if not len(mesh.positions) or not len(mesh.faces):
        raise AssetError(f"body {mesh.name} has no vertices or faces; give a mesh")
    values = (mesh.positions, mesh.skin_weights, mesh.skeleton.rest_positions)
    if not all(np.isfinite(array).all() for array in values):
        raise AssetError(f"body {mesh.name} has NaN or infinite vertices, weights or joints; repair it")
    is_bad = (mesh.skin_weights < 0).any(1) | (mesh.skin_weights.sum(1) < 1e-3)
    if is_bad.any():
        raise AssetError(
            f"body {mesh.name}: vertex {np.argmax(is_bad)} has no or negative skin weights; bind it to a joint"
        )


def hips_first(skeleton: Skeleton) -> tuple[Skeleton, NDArray]:
    """Make the hips joint 0, as motions have it; return the skeleton, and the old index of each of its joints."""
    hips, count = find_parts(skeleton)["", "hips"][0], len(skeleton)
    if hips == 0:
        return skeleton, np.arange(count)
    bones = np.array([pair for pair in enumerate(skeleton.parents) if pair[1] >= 0]).reshape(-1, 2)
    graph = scipy.sparse.coo_array((np.ones(len(bones)), tuple(bones.T)), (count, count))
    order, above = breadth_first_order(graph, hips, directed=False)
    place = {joint: new for new, joint in enumerate(order.tolist())}
    names = tuple(skeleton.joint_names[joint] for joint in place)
    parents = tuple(place.get(int(above[joint]), -1) for joint in place)
    return Skeleton(names, parents, skeleton.rest_positions[order]), order


def make_motion(
    source: SkeletonMotion, body: Body, *, joint_map: Mapping[str, str] | None = None, up: str = "y"
) -> Motion:
    """Carry a moving skeleton over to a body.

    On its own rig, the turns of the joints and the path of the hips are kept, whatever the unit. A warning tells
    if bones also move or stretch, so that a joint with skin is more than 1 cm away from its place in the file.
    On another rig, limbs point where the source's limbs point, and the rest of the body turns as the source has
    turned since its rest pose. Steps are scaled by the length of the legs, the floor is put at y = 0, and the
    motion starts above the origin. The joint map is changed from joints of the body to joints of the source; ""
    keeps one still. The source's axis "y" or "z" points up, or "auto" judges by how it stands.

    Raises:
        MotionError: No joint is known to both, or the source stands neither at rest nor in a frame.
    """
    axes = _Y_UP if (_judge_up(source) if up == "auto" else up) == "z" else np.eye(3)
    rest_axes = axes if source.usual_up is None else np.eye(3)
    rest = source.skeleton.rest_positions @ rest_axes.T
    source = dataclasses.replace(
        source,
        skeleton=dataclasses.replace(source.skeleton, rest_positions=rest),
        rotations=axes @ source.rotations @ rest_axes.T,
        positions=source.positions @ axes.T,
    )
    target = body_skeleton(body)
    is_model = is_body_model(target, source)
    mapping = map_joints(target, source.skeleton, joint_map, same_names=is_model)
    if len(mapping) < min(2, len(target)):  # the hips are always found
        raise MotionError(
            f"no joint of the motion ({', '.join(source.skeleton.joint_names[:4])}, ...) is known to this body "
            f"({', '.join(target.joint_names[:4])}, ...); write a map with eslr "
            "joints --out map.json, fill in its empty names, and give it as --joint-map map.json"
        )
    place = {name: joint for joint, name in enumerate(source.skeleton.joint_names)}
    followed = [place[mapping[name]] if name in mapping else -1 for name in target.joint_names]
    lost = [
        " ".join(part).strip()
        for part, joints in find_parts(target).items()
        if part[1] in (*LIMBS, "spine") and not mapping.keys() & {target.joint_names[k] for k in joints}
    ]
    if lost and joint_map is None:
        warnings.warn(
            f"{source.name}: no joint of it is known as {', '.join(lost)}, which move with what they hang on; "
            "write a map with eslr joints --out map.json, and give it as --joint-map map.json",
            stacklevel=2,
        )
    scale = 1.0 if is_model else rig_scale(target, source.skeleton, followed)
    ours, theirs = match_parts(target, source.skeleton, followed)
    alignments = np.tile(np.eye(3), (len(target), 1, 1))
    if scale is None:
        alignments = align_rests(target, source.skeleton, ours, theirs, source)
    turned = np.empty((len(source.rotations), len(target), 3, 3))
    for joint, (other, parent) in enumerate(zip(followed, target.parents, strict=True)):
        if other >= 0:
            turned[:, joint] = source.rotations[:, other] @ alignments[joint]
        else:
            turned[:, joint] = turned[:, parent] if parent >= 0 else np.eye(3)
    translations = source.positions[:, theirs["", "hips"][0]]
    if scale is None:
        leg = leg_length(target.rest_positions, ours)
        other = leg_length(source.skeleton.rest_positions, theirs)
        if leg and other:
            translations = leg / other * translations
        translations = _put_on_floor(turned, translations, target, body)
    elif source.usual_up is not None:
        translations = translations + axes @ target.rest_positions[0]
    else:
        translations = scale * translations
        places = chain_positions(turned, translations, target)
        away = np.linalg.norm(places - scale * source.positions[:, followed], axis=2)
        _warn_of_lost_moves(source.name, away, body)
    has_arms = all((side, "upper_arm") in find_named_parts(target.joint_names) for side in ("left", "right"))
    return Motion(
        source.name,
        local_rotations(turned, target.parents),
        translations,
        source.fps,
        target.joint_names,
        arm_abduction=ARM_ABDUCTION if has_arms and scale is None else 0.0,
    )


def _warn_of_lost_moves(name: str, away: NDArray, body: Body) -> None:
    """Warn if a joint with skin is `away` from its place in the file [m], [frames, joints]."""
    has_skin = np.zeros(away.shape[1], bool)
    has_skin[np.asarray(body.skin_indices)[np.asarray(body.skin_weights) > 0]] = True
    away = np.where(has_skin, away, 0.0)
    frame, joint = np.unravel_index(away.argmax(), away.shape)
    if away[frame, joint] > LOST_MOVE:
        warnings.warn(
            f"{name}: its bones move or stretch apart from turning, which is not played: joint "
            f"{body.joint_names[joint]} is {100 * away[frame, joint]:.1f} cm away in frame {frame}; bake the "
            "animation to rotations, or export the character as a moving mesh",
            stacklevel=3,
        )


def skeleton_motion(motion: Motion, body: Body) -> SkeletonMotion:
    """Return the moving skeleton of a body's motion: the inverse of `make_motion` on the same rig.

    Raises:
        MotionError: The motion is for another rig.
    """
    if motion.joint_names != body.joint_names:
        raise MotionError(
            f"motion {motion.name} is for another skeleton ({', '.join(motion.joint_names[:4])}, ...); load it "
            "with this body"
        )
    skeleton = body_skeleton(body)
    turned = global_rotations(motion.rotations, skeleton.parents)
    positions = chain_positions(turned, motion.translations, skeleton)
    return SkeletonMotion(motion.name, skeleton, turned, positions, motion.fps)


def _judge_up(source: SkeletonMotion) -> str:
    """Return the axis "y" or "z" that points up in a motion; warn with one line if that is a guess."""
    rest, is_model = source.skeleton.rest_positions[None], source.usual_up is not None
    usual = source.usual_up or _standing_axis(source.skeleton, rest)
    found = _standing_axis(source.skeleton, source.positions) or usual or "y"
    if found != usual and (is_model or found == "z"):
        other = "z" if found == "y" else "y"
        warnings.warn(
            f"{source.name}: taken as {found.upper()} up, as the figure is longest along {found}, though not "
            f"{'as usual' if is_model else 'at rest'}; if it crawls or lies, say that {other.upper()} is up "
            f"(--motion-up {other})",
            stacklevel=3,
        )
    return found


def _standing_axis(skeleton: Skeleton, positions: np.ndarray) -> str | None:
    """Return "y" or "z", along which the head is above the feet; positions: [frames, joints, 3]."""
    parts = find_parts(skeleton)
    upper = next((parts["", chain][-1] for chain in ("head", "neck", "spine") if ("", chain) in parts), None)
    lower = [
        parts[side, chain][0]
        for side in ("left", "right")
        for chain in ("foot", "lower_leg", "upper_leg")
        if (side, chain) in parts
    ]
    if upper is None or not lower:
        return None
    _, along_y, along_z = (positions[:, upper] - positions[:, lower].mean(axis=1)).mean(axis=0)
    return "z" if along_z > abs(along_y) else "y" if along_y > abs(along_z) else None


def is_body_model(target: Skeleton, source: SkeletonMotion) -> bool:
    """Tell whether a motion holds pose parameters of the body's own body model, such as SMPL.

    Joints then follow by name, and rest where the parameters have none.
    """
    shared = set(target.joint_names) & set(source.skeleton.joint_names)
    return source.usual_up is not None and len(shared) >= MODEL_JOINTS


def _put_on_floor(turned: NDArray, translations: NDArray, target: Skeleton, body: Body) -> NDArray:
    """Return root positions [m] that start above the origin, with the soles on the floor, shape [frames, 3]."""
    translations = translations - translations[0] * [1.0, 0.0, 1.0]
    parts = find_parts(target)
    feet = [joint for (_, chain), joints in parts.items() if chain in ("foot", "toe") for joint in joints]
    if not feet:
        return translations
    soles = float(np.asarray(body.rest_positions)[:, 1].min())
    heights = target.rest_positions[feet, 1] - soles
    lowest = (chain_positions(turned, translations, target)[:, feet, 1] - heights).min(axis=1)
    return translations - [0.0, np.quantile(lowest, GROUND_QUANTILE), 0.0]
