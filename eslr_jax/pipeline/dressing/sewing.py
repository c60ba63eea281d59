"""Sew a pattern around a body: the cloth contracts from where its panels stand, outside the body (host).

Seams are joined from the first moment. The cloth then starts far stretched, and flows to its cut shape: every
face is drawn to its panel's, turned as it lies (local step), and a linear system finds the vertices (global
step). What is inside the body after a step is moved out of it, and slides along it ever more easily. There is no
gravity, and cloth does not keep off cloth: panels before and behind the body close like a sandwich.

Source: Bouaziz et al. 2014, doi 10.1145/2601097.2601116, whose iteration this is.
"""

from __future__ import annotations

import dataclasses
import itertools
from typing import Any

import numpy as np
import scipy.sparse
from jaxtyping import Float, Int
from scipy.sparse.linalg import splu

from eslr_jax.errors import MeshError
from eslr_jax.mesh.parting import uncrossed
from eslr_jax.mesh.piercing import piercing_edges
from eslr_jax.mesh.validate import validate_mesh
from eslr_jax.pipeline.dressing.clearance import body_heights, lay_to_rest
from eslr_jax.pipeline.dressing.panels import SewnMesh, join_panels
from eslr_jax.pipeline.dressing.pins import choose_pins
from eslr_jax.pipeline.dressing.postures import Posture, rest_posture
from eslr_jax.pipeline.dressing.report import wearer_entry
from eslr_jax.pipeline.dressing.transfer import carry_shape, pose_alike
from eslr_jax.pipeline.formats.garment import GarmentFile
from eslr_jax.pipeline.formats.mesh import Positions
from eslr_jax.pipeline.formats.pattern import Pattern
from eslr_jax.pipeline.rigs.rig import body_skeleton
from eslr_jax.pose.joints import find_parts
from eslr_jax.pose.skeleton import Skeleton
from eslr_jax.types import Body

# Where limbs of the left side point, by their joints.
_STANCE = {
    ("upper_arm", "forearm", "hand"): np.array([np.sqrt(0.5), -np.sqrt(0.5), 0.0]),
    ("upper_leg", "lower_leg", "foot"): np.array([0.0, -1.0, 0.0]),
}
_BEYOND = 0.3  # of the body's height: panels farther away belong to no garment
_TIGHT = 1.25  # stretch of a tenth of a panel, from which on it does not fit
_MARGIN = 0.02  # [m] between panels that are laid out
# Turns in which the cloth contracts, each of steps with one matrix, whose factors take half the time. Friction
# ceases in the second half; in the last turn distances from the skin are exact.
_TURNS, _STEPS = 100, 4
_ANKLE = 0.13  # [m] over the soles, below which hems start rolled up: feet would go through them
_ROLLED = 0.9  # by how much
_STRIDE = 0.015  # [m] that a vertex moves in a step at most: less than limbs are thick
_INERTIA = 10.0  # [1/m2] weight of staying, against stretch: waves longer than a metre take several steps
_STIFFNESS = 4e-4  # [m2] of bending, against stretch: folds are a few centimetres wide
_FRICTION = 5.0  # weight of staying of what touches the body, against the stretch of its faces, some 3.5
_CLEARANCE = 5e-3  # [m] from the skin, at the end
_NEAR = 0.04  # [m] from a vertex of the skin, within which its tangent plane stands for it
_SANDWICH = 0.1  # [m] between the sides of a seam, from which on the body may be between them
_BESIDE = 0.02  # [m] from the skin, from which on a seam starts beside the body
_RAYS, _RINGS, _RING = 24, 30, 0.01  # directions, and steps [m], in which a place beside it is looked for


def sew_pattern(
    pattern: Pattern, body: Body, made_for: Body, *, num_vertices: int, pin: tuple[str, ...], name: str
) -> GarmentFile:
    """Cut a pattern's panels, sew them around the body that they are made for, and carry the garment to a body.

    The panels stand around a body whose feet are at the origin, `made_for`, which is the same object if it is the
    wearer. The garment has about `num_vertices`; `pin` is that of `FitOptions`, a panel a part.
    `metadata["sewing"]` reports on it and holds the vertices of every seam. Messages say its `name`.

    Raises:
        MeshError: The panels stand elsewhere, can't be cut or joined, or can't be carried to the body.
        ConfigError: The number of vertices is out of range, or a pin is unknown.
        MissingExtraError: The extra `patterns` is not installed.
    """
    mesh, posture = join_panels(pattern, num_vertices, name), pattern_posture(made_for)
    mesh = dataclasses.replace(mesh, placed=mesh.placed + posture.stands[-1])
    _check_place(mesh, pattern, posture, name)
    draped = drape(mesh, posture)
    faces, corners = mesh.faces, mesh.panel_corners
    is_inward = posture.is_turned_in(draped, faces)
    faces = np.where(is_inward[:, None], faces[:, ::-1], faces)
    corners = np.where(is_inward[:, None, None], corners[:, ::-1], corners)
    validate_mesh(draped, faces, name=f"{name}, sewn", allow_components=True)
    warnings, report = _judge(dataclasses.replace(mesh, faces=faces, panel_corners=corners), draped, pattern)
    placed, worn_in, transfer = draped, posture, {}
    if made_for is not body:
        placed, lengths, worn_in, carried = carry_shape(draped, faces, posture, made_for, body, scale="body")
        corners, transfer = _recut(corners, draped[faces], lengths[faces]), {"transfer": carried}
    worn, penetration = lay_to_rest(placed, faces, worn_in, body)
    garment = GarmentFile(
        **worn,
        faces=faces,
        is_pinned=np.zeros(len(placed), bool),
        sewn_positions=placed,
        panel_corners=corners,
        corner_uvs=_laid_out(mesh.face_panels, corners),
        face_parts=mesh.face_panels,
        part_names=tuple(pattern.panels),
    )
    is_pinned, pinned_by, falling = choose_pins(pin, garment, body)
    return dataclasses.replace(
        garment,
        is_pinned=is_pinned,
        metadata={
            "name": name,
            **wearer_entry(body),
            **transfer,
            "sewing": report
            | {
                "inside": penetration["after"]["inside"],
                "pinned": int(is_pinned.sum()),
                "pinned_by": pinned_by,
                "warnings": [*warnings, *falling],
                "seams": {
                    str(seam): np.unique(mesh.seam_edges[mesh.edge_seams == number]).tolist()
                    for number, seam in enumerate(pattern.seams)
                },
            },
        },
    )


def _check_place(mesh: SewnMesh, pattern: Pattern, posture: Posture, name: str) -> None:
    height = float(np.ptp(posture.positions[:, 1]))
    for number, panel in enumerate(pattern.panels):
        place = mesh.placed[np.unique(mesh.faces[mesh.face_panels == number])]
        away, top = float(np.abs(posture.heights(place)).min()), float(place[:, 1].max()) - posture.floor
        if away > _BEYOND * height or top > (1.0 + _BEYOND) * height:
            raise MeshError(
                f"{name}: panel {panel} reaches {top:.2f} m above the soles, and is {away:.2f} m away from the "
                f"body, which is {height:.2f} m tall; move it, correct units_in_meter, or give the body that the "
                "pattern is made for (eslr sew --made-for)"
            )


def _judge(mesh: SewnMesh, draped: Positions, pattern: Pattern) -> tuple[list[str], dict[str, Any]]:
    """Return warnings of what lies badly after sewing, and figures."""
    stretched, names = stretches(mesh, draped), list(pattern.panels)
    owners, _, pierced = piercing_edges(draped, mesh.faces)
    crossing = {
        tuple(sorted(names[mesh.face_panels[k]] for k in pair)) for pair in zip(owners, pierced, strict=True)
    }
    warnings = [f"{first} and {second} pass through each other" for first, second in sorted(crossing)]
    tight = {
        panel: float(np.quantile(stretched[mesh.face_panels == k], 0.9)) for k, panel in enumerate(names)
    }
    panel, most = max(tight.items(), key=lambda item: item[1])
    if most > _TIGHT:
        warnings.append(
            f"{panel} is stretched to {most:.2f} times its length: the pattern is too small for this body, or "
            "stands too far from where it is worn"
        )
    for (first, second), _ in pattern.seams:
        between = abs(first.edge - second.edge)
        is_dart = between in (1, len(pattern.panels[first.panel].edges) - 1)  # its sides meet in a corner
        if first.panel == second.panel and not is_dart:
            warnings.append(
                f"{first.panel} edge {first.edge} to edge {second.edge} joins a panel to itself: if it goes "
                "around a limb, cut it in two panels, one on either side"
            )
    report = {
        "panels": len(names),
        "vertices": len(draped),
        "faces": len(mesh.faces),
        "crossing_pairs": len({tuple(sorted(pair)) for pair in zip(owners, pierced, strict=True)}),
        "p99_principal_stretch": round(float(np.quantile(stretched, 0.99)), 3),
    }
    return warnings, report


def _recut(
    corners: Float[np.ndarray, "faces 3 2"],
    old: Float[np.ndarray, "faces 3 3"],
    new: Float[np.ndarray, "faces 3 3"],
) -> Float[np.ndarray, "faces 3 2"]:
    """Return the corners of flat faces [m], stretched as the faces of a shape in space are from old to new."""
    flat, before, after = map(_edges, (corners, old, new))
    lower = np.linalg.cholesky(before.swapaxes(1, 2) @ before)
    inverse = np.linalg.inv(lower)
    # In the frame of the old face, whose edges are lower^T; its stretch is the root of the pulled-back metric.
    metric = after.swapaxes(1, 2) @ after
    values, vectors = np.linalg.eigh(inverse @ metric @ inverse.swapaxes(1, 2))
    root = vectors @ (np.sqrt(values)[:, :, None] * vectors.swapaxes(1, 2))
    turn = flat @ inverse.swapaxes(1, 2)  # from that frame to the panel's
    edges = turn @ root @ lower.swapaxes(1, 2)
    return np.concatenate([edges.swapaxes(1, 2), np.zeros((len(corners), 1, 2))], axis=1)


def _laid_out(
    face_panels: Int[np.ndarray, " faces"], corners: Float[np.ndarray, "faces 3 2"]
) -> Float[np.ndarray, "faces 3 2"]:
    """Return texture coordinates in metres: the panels side by side, their warp along the second."""
    laid, start = corners.copy(), 0.0
    for panel in range(face_panels.max() + 1):
        own = laid[face_panels == panel]
        low, high = own.min(axis=(0, 1)), own.max(axis=(0, 1))
        laid[face_panels == panel] = own - low + [start, 0.0]
        start += high[0] - low[0] + _MARGIN
    return laid


def pattern_posture(body: Body) -> Posture:
    """Return a body that stands as panels are placed for: straight arms at 45 degrees, legs upright.

    A body whose joints are not known, such as a moving mesh, stays as it rests.
    """
    skeleton = body_skeleton(body)
    parts, joints = find_parts(skeleton), skeleton.rest_positions.copy()
    for limb, direction in _STANCE.items():
        for side, sign in (("left", 1.0), ("right", -1.0)):
            chain = [parts[side, part][0] for part in limb if (side, part) in parts]
            for above, below in itertools.pairwise(chain):
                length = np.linalg.norm(skeleton.rest_positions[below] - skeleton.rest_positions[above])
                joints[below] = joints[above] + length * np.array([sign, 1.0, 1.0]) * direction
    try:
        return pose_alike(body, Skeleton(body.joint_names, body.parents, joints))
    except MeshError:
        return rest_posture(body)


def drape(mesh: SewnMesh, posture: Posture) -> Positions:
    """Return the vertices of a sewn mesh where its cloth lies around a body [m]."""
    columns, areas = _frames(mesh)
    num_vertices, num_faces = len(mesh.placed), len(mesh.faces)
    # Row 2 f + k of this matrix is column k of the deformation gradient of face f.
    rows = np.repeat(np.arange(2 * num_faces).reshape(-1, 2), 3, axis=0).ravel()
    corners = np.repeat(mesh.faces.ravel(), 2)
    gradient = scipy.sparse.csr_array((columns.ravel(), (rows, corners)), (2 * num_faces, num_vertices))
    weighted = (gradient * np.repeat(areas, 2)[:, None]).T.tocsr()
    stretch = weighted @ gradient
    masses = np.bincount(mesh.faces.ravel(), np.repeat(areas / 3.0, 3), num_vertices)
    bending = _STIFFNESS * stretch @ scipy.sparse.diags_array(1.0 / masses) @ stretch
    elastic = (stretch + bending).tocsc()
    over = mesh.placed[:, 1] - posture.floor - _ANKLE
    lifted = mesh.placed - np.outer(np.minimum(over, 0.0) * _ROLLED, [0.0, 1.0, 0.0])
    position = _beside(lifted, mesh.spans, posture)
    is_held = np.zeros(num_vertices, bool)
    for turn in range(_TURNS):
        friction = _FRICTION * min(1.0, 2.0 * (1.0 - turn / _TURNS)) ** 2
        staying = _INERTIA * masses + friction * is_held
        solve = splu(elastic + scipy.sparse.diags_array(staying, format="csc")).solve
        measure = body_heights if turn == _TURNS - 1 else _heights
        for _ in range(_STEPS):
            deformed = (gradient @ position).reshape(-1, 2, 3)
            left, _, right = np.linalg.svd(deformed, full_matrices=False)
            turned = (left @ right).reshape(-1, 3)
            step = solve(weighted @ turned + staying[:, None] * position) - position
            length = np.linalg.norm(step, axis=1, keepdims=True)
            position = position + step * np.minimum(1.0, _STRIDE / np.maximum(length, 1e-12))
            heights, normals = measure(position, posture)
            position = position + np.clip(_CLEARANCE - heights, 0.0, 3 * _STRIDE)[:, None] * normals
            is_held = heights < _CLEARANCE
    return uncrossed(position, mesh.faces)


def _beside(points: Positions, spans: Positions, posture: Posture) -> Positions:
    """Return points, of which those of seams that begin in the body stand beside it [m].

    A seam between a panel before and one behind the body belongs to its outline as seen from there. So it leaves
    the body at right angles to its span: at the shoulder upwards, and not to the front or to the back.
    """
    length = np.linalg.norm(spans, axis=1)
    heights, _ = body_heights(points, posture)
    inside = np.flatnonzero((heights < _BESIDE) & (length > _SANDWICH))
    axis = spans[inside] / length[inside, None]
    first = np.cross(axis, np.roll(axis, 1, axis=1))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    angle = np.linspace(0.0, 2 * np.pi, _RAYS, endpoint=False)[:, None, None]
    rays = np.cos(angle) * first + np.sin(angle) * np.cross(axis, first)
    moved, is_open = points.copy(), np.ones(len(inside), bool)
    for way in np.arange(1, _RINGS + 1) * _RING:
        places = points[inside] + way * rays
        clear, _ = _heights(places.reshape(-1, 3), posture)
        clear = clear.reshape(_RAYS, -1)
        best = np.argmax(clear, axis=0)
        rows = np.flatnonzero(is_open & (clear.max(axis=0) > _BESIDE))
        moved[inside[rows]] = places[best[rows], rows]
        is_open[rows] = False
    return moved


def _heights(
    points: Float[np.ndarray, "points 3"], posture: Posture
) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, "points 3"]]:
    """Return `body_heights`, to a few millimetres, from the skin's tangent plane at the nearest vertex."""
    distance, side, normals = posture.tangent_planes(points)
    return np.where(distance < _NEAR, side, np.copysign(distance, side)), normals


def _frames(mesh: SewnMesh) -> tuple[Float[np.ndarray, "faces 3 2"], Float[np.ndarray, " faces"]]:
    """Return what each corner adds to the columns of its face's deformation gradient [1/m], and areas [m2]."""
    edges = _edges(mesh.panel_corners)
    inverse, areas = np.linalg.inv(edges), 0.5 * np.abs(np.linalg.det(edges))
    return np.concatenate([inverse, -inverse.sum(axis=1, keepdims=True)], axis=1), areas


def _edges(corners: np.ndarray) -> np.ndarray:
    """Return the two edges of every face that end in its last corner, as columns."""
    return np.stack([corners[:, 0] - corners[:, 2], corners[:, 1] - corners[:, 2]], axis=2)


def stretches(mesh: SewnMesh, position: Positions) -> Float[np.ndarray, " faces"]:
    """Return the largest stretch of every face."""
    columns, _ = _frames(mesh)
    deformed = np.einsum("fck,fcx->fkx", columns, position[mesh.faces])
    return np.linalg.svd(deformed, compute_uv=False)[:, 0]
