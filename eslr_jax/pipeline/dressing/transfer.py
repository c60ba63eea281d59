"""Transfer a garment from the body that it was made for to another body, of any rig, shape and rest pose."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import scipy.sparse
from scipy.interpolate import RBFInterpolator
from scipy.sparse.linalg import splu

from eslr_jax.errors import ConfigError, MeshError, MotionError
from eslr_jax.mesh.topology import unique_edges
from eslr_jax.pipeline.dressing.clearance import body_heights, lay_to_rest, push_out
from eslr_jax.pipeline.dressing.options import Scale
from eslr_jax.pipeline.dressing.postures import Posture, rest_posture, take_posture
from eslr_jax.pipeline.dressing.report import wearer_entry
from eslr_jax.pipeline.formats.garment import GarmentFile
from eslr_jax.pipeline.formats.mesh import Faces, Positions
from eslr_jax.pipeline.rigs.alignment import align_rests
from eslr_jax.pipeline.rigs.rig import body_skeleton
from eslr_jax.pose.joints import Part, find_parts
from eslr_jax.pose.motion import Motion, pose_body
from eslr_jax.pose.retarget import local_rotations
from eslr_jax.pose.skeleton import Skeleton
from eslr_jax.types import Body

_JOINTS = ("upper_arm", "forearm", "hand", "upper_leg", "lower_leg", "foot")  # that all rigs have alike
_NEEDED = ("upper_arm", "upper_leg")  # without them a trunk has no size
_MIDLINE = 0.01  # of the body's height: vertices nearer to the middle than that can be the crotch
_CROTCH = (0.15, 0.02)  # of the body's height: how far below and above the hip joints it can be
_EASE = 0.03  # [m] from the skin, from which on cloth rather follows the cloth around it
_REACHES = (0.6, 0.3, 0.15, 0.1, 0.06)  # [m] over which the cloth moves together, one after the other
_ROUNDS = 3  # of each
_UNSEEN = 1e-6  # weight of the offset where no skin is near


def transfer_garment(
    garment: GarmentFile, source: Body, target: Body, *, scale: Scale = "body"
) -> GarmentFile:
    """Carry a garment from the body that it was made for to another one.

    The bodies may differ in rig, shape, size and rest pose; their joints need names of a common family.

    Args:
        garment: A garment on the source body, such as a bundled one; see `load_garment_file`.
        source: The body that it was made for.
        target: The body that is to wear it.
        scale: Which lengths the cloth gets. "body": the cut is graded, so that the ease stays that of the source
            body, in proportion; "girth": all lengths change by one factor, the ratio of the girths; "none": the
            cloth keeps its lengths.

    Returns:
        The garment in the target's rest pose, with skin weights of the target; `metadata["transfer"]` reports
        what was done, `metadata["body"]` tells the target.

    Raises:
        ConfigError: The garment has a sewn shape of its own: it was fitted, and may have another pose.
        MeshError: The target lacks arms or legs of known names, or does not stand at rest.
    """
    if garment.sewn_positions is not None:
        raise ConfigError(
            "a fitted garment can't be carried to another body; give the mesh it was fitted from, and the body "
            "that it was made for (eslr fit --made-for)"
        )
    placed, sewn, posture, report = carry_shape(
        garment.rest_positions, garment.faces, rest_posture(source), source, target, scale=scale
    )
    worn, _ = lay_to_rest(placed, garment.faces, posture, target)
    return dataclasses.replace(
        garment,
        **worn,
        sewn_positions=sewn,
        metadata=garment.metadata | wearer_entry(target) | {"transfer": report},
    )


def carry_shape(
    positions: Positions, faces: Faces, source: Posture, made_for: Body, target: Body, *, scale: Scale
) -> tuple[Positions, Positions, Posture, dict[str, Any]]:
    """Carry a garment's shape [m] from a posed body, `source`, to another body in the same pose.

    A spline through the joints and the crotch maps space from one body to the other. Then the cloth moves along
    the skin's normals until its distance from the skin is the old one, scaled by the ratio of the bodies'
    sizes. Loose cloth follows the cloth around it.

    Returns:
        Vertices outside the target [m], those with the lengths that the cloth is to have [m], the target in the
        pose in which the garment was made, and a report.

    Raises:
        MeshError: The target lacks arms or legs of known names, or does not stand at rest.

    Source: Duchon 1977 (doi:10.1007/BFb0086566), the spline; Brouet et al. 2012 (doi:10.1145/2185520.2185532),
    the aim to keep proportion, ease and shape.
    """
    joints = Skeleton(made_for.joint_names, made_for.parents, source.joints)
    posture = pose_alike(target, joints)
    here = _landmarks(source, joints)
    there = _landmarks(posture, Skeleton(target.joint_names, target.parents, posture.joints))
    # Hip joints are at quite different heights from rig to rig: they only stand in for the crotch.
    passed = ("upper_leg",) if all(("", "crotch") in marks for marks in (here, there)) else ("crotch",)
    shared = [part for part in here if part in there and part[1] not in passed]
    start, end = (np.array([marks[part] for part in shared]) for marks in (here, there))
    size = np.linalg.norm(end - end.mean(axis=0)) / np.linalg.norm(start - start.mean(axis=0))
    spline = RBFInterpolator(start, end - size * start, kernel="linear", degree=0)
    heights, _ = body_heights(positions, source)
    graded = _keep_ease(size * positions + spline(positions), faces, size * heights, posture)
    placed, _ = push_out(graded, faces, posture)
    left, right = (here[side, "upper_arm"] for side in ("left", "right"))
    is_trunk = _aside(positions, left, right) < _aside(left, left, right)
    edges = unique_edges(faces)
    edges = edges[is_trunk[edges].all(axis=1)]
    spans = [np.abs(points[edges[:, 1]] - points[edges[:, 0]]) for points in (placed, positions)]
    girth, length = (  # of level lengths around trunk and legs, and of upright ones
        float(np.divide(*(np.linalg.norm(span[:, axes], axis=1).sum() for span in spans)))
        for axes in ([0, 2], [1])
    )
    if scale == "body":
        sewn = np.where(heights[:, None] > 0, placed, graded)  # what was tight stays tight
    else:
        sewn = positions * (girth if scale == "girth" else 1.0)
    report = {"scale": scale, "girth": round(girth, 3), "length": round(length, 3)}
    return placed, sewn, posture, report


def pose_alike(body: Body, skeleton: Skeleton) -> Posture:
    """Return a body whose limbs point where those of another skeleton point.

    Raises:
        MeshError: The body lacks arms or legs of known names, or does not stand at rest.
    """
    own = body_skeleton(body)
    ours, theirs = find_parts(own), find_parts(skeleton)
    for rig, parts in ((own, ours), (skeleton, theirs)):
        for part in [(side, chain) for chain in _NEEDED for side in ("left", "right")]:
            if part not in parts:
                raise MeshError(
                    f"garments are carried between bodies with arms and legs, but no joint of one of them "
                    f"({', '.join(rig.joint_names[:4])}, ...) is known as its {' '.join(part).replace('_', ' ')}"
                    "; name the joints as Mixamo does, or give the mesh of a garment that fits"
                )
    ours = {part: joints for part, joints in ours.items() if part in theirs}
    try:
        turned = align_rests(own, skeleton, ours, theirs)
    except MotionError as error:
        raise MeshError(
            "no garment can be carried to a body that does not stand at rest; export it in a T-pose or A-pose"
        ) from error
    known = {joint for joints in ours.values() for joint in joints}
    for joint, parent in enumerate(own.parents):
        if parent >= 0 and joint not in known:
            turned[joint] = turned[parent]
    rotations = local_rotations(turned[None], own.parents)
    pose = Motion("pose", rotations, own.rest_positions[:1], 30.0, body.joint_names, arm_abduction=0.0)
    poses = pose_body(body, pose)
    return take_posture(body, np.asarray(poses.positions[0]), np.asarray(poses.joint_transforms[0]))


def _landmarks(posture: Posture, skeleton: Skeleton) -> dict[Part, np.ndarray]:
    """Return places that correspond between bodies [m]: joints, and the crotch.

    That is the lowest point of the trunk between the legs, unless they meet farther down.
    """
    places = {
        part: skeleton.rest_positions[joints[0]]
        for part, joints in find_parts(skeleton).items()
        if part[1] in _JOINTS
    }
    left, right = places["left", "upper_leg"], places["right", "upper_leg"]
    height = float(np.ptp(posture.positions[:, 1]))
    points = posture.positions[posture.touchable]
    middle = points[_aside(points, left, right) < _MIDLINE * height, 1]
    x, y, z = 0.5 * (left + right)
    if len(middle) and -_CROTCH[0] * height < middle.min() - y < _CROTCH[1] * height:
        places["", "crotch"] = np.array([x, middle.min(), z])
    return places


def _aside(points: np.ndarray, left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return how far points are from the middle of two joints, along the level line through both [m]."""
    across = (left - right) * [1, 0, 1]  # whatever the body faces
    return np.abs((points - 0.5 * (left + right)) @ across) / np.linalg.norm(across)


def _keep_ease(positions: np.ndarray, faces: np.ndarray, wanted: np.ndarray, posture: Posture) -> np.ndarray:
    """Move cloth along the skin's normals to the wanted heights above the skin [m], with its neighbours."""
    edges = unique_edges(faces)
    edge = float(np.linalg.norm(positions[edges[:, 0]] - positions[edges[:, 1]], axis=1).mean())
    laplacian = scipy.sparse.csgraph.laplacian(
        scipy.sparse.coo_array((np.ones(len(edges)), edges.T), (len(positions),) * 2), symmetrized=True
    )
    trust = 1.0 / (1.0 + (wanted / _EASE) ** 2)
    result = positions
    for reach in np.repeat(_REACHES, _ROUNDS):
        heights, normals = body_heights(result, posture)
        weight = np.where(normals.any(axis=1), trust, 0.0) + _UNSEEN
        system = scipy.sparse.diags_array(weight) + (reach / edge) ** 2 * laplacian
        result = result + splu(system.tocsc()).solve((weight * (wanted - heights))[:, None] * normals)
    return result
