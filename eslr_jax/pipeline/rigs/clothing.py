"""What is drawn of garments and a body, which wears neutral shorts and a top beneath them (host).

Shorts and top are the body's own surface in another colour, cut along smooth hems: skin-tight, and no part of
any scene.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Float

from eslr_jax.mesh.skinning import smooth
from eslr_jax.pipeline.formats.animated import Skin
from eslr_jax.pipeline.formats.garment import split_outfit
from eslr_jax.pipeline.formats.mesh import Faces, Positions
from eslr_jax.pipeline.formats.palette import BODY_COLORS, Color, garment_color
from eslr_jax.pose.joints import find_named_parts
from eslr_jax.types import Body

_SKIN, _TOP, _SHORTS = 0, 1, 2
_NAMES = ("skin", "top", "shorts")
_LEG = 0.42  # share of the thigh that the shorts cover
_STRAP = 0.8  # half width of the top at the shoulders, over half the distance of the shoulder joints
_ARMHOLE = 0.75  # depth of the armholes below the shoulder joints, over the same length
_NECKLINE = 0.45  # radius of the neckline, over the same length
_LIMB = 0.1  # [m] over which the weight of a limb goes from none to one
_SMOOTHINGS = 6  # of the border of a limb, over the mesh


class Piece(NamedTuple):
    """A mesh of one colour, a part of a body or of an outfit."""

    name: str
    faces: Faces  # of its own vertices
    weights: sparse.csr_array | slice  # its vertices from those of the whole
    color: Color

    def place(self, positions: Positions) -> Float[np.ndarray, "own_vertices 3"]:
        """Return where its vertices are [m], given those of the whole [m]."""
        positions = np.asarray(positions, np.float32)
        return positions[self.weights] if isinstance(self.weights, slice) else self.weights @ positions


def garment_pieces(faces: Faces, outfit: dict[str, int]) -> list[Piece]:
    """Return the garments of an outfit, given its names and numbers of vertices in order."""
    faces = np.asarray(faces)
    return [
        Piece(name, faces[is_own] - rows.start, rows, garment_color(number))
        for number, (name, rows, is_own) in enumerate(split_outfit(faces, outfit))
    ]


def body_pieces(rest_positions: Positions, faces: Faces, rig: Body | Skin | None) -> list[Piece]:
    """Return skin, top and shorts of a body at rest, upright [m].

    All of it is skin without what moves it, and if its joints have no common names.
    """
    positions, faces = np.asarray(rest_positions, np.float64), np.asarray(faces)
    weights = sparse.eye_array(len(positions), format="csr")
    fields = None if rig is None else _fields(positions, faces, rig)
    if fields is None:
        return [_piece(_SKIN, faces, weights)]
    cloth, waist = fields
    faces, weights = _cut(faces, weights, cloth)
    faces, weights = _cut(faces, weights, weights @ waist)
    is_cloth = (weights @ cloth)[faces].mean(axis=1) > 0
    is_top = (weights @ waist)[faces].mean(axis=1) > 0
    kinds = np.where(is_cloth, np.where(is_top, _TOP, _SHORTS), _SKIN)
    return [_piece(kind, faces[kinds == kind], weights) for kind in np.unique(kinds)]


def _piece(kind: int, faces: np.ndarray, weights: sparse.csr_array) -> Piece:
    """Return a part of the body with the vertices of its faces alone."""
    vertices, own = np.unique(faces, return_inverse=True)
    return Piece(_NAMES[kind], own.reshape(-1, 3), weights[vertices].astype(np.float32), BODY_COLORS[kind])


def _fields(
    positions: np.ndarray, faces: np.ndarray, rig: Body | Skin
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return how far every vertex is inside the clothing, and over the waist [m]; None for unknown joints."""
    parts = find_named_parts(rig.joint_names)
    chains = [
        (side, chain) for chain in ("upper_arm", "upper_leg", "lower_leg") for side in ("left", "right")
    ]
    needed = [*chains, ("", "neck"), ("", "spine")]
    if any(part not in parts for part in needed):
        return None
    left_arm, right_arm, *_, neck, spine = found = [parts[part][0] for part in needed]
    joints = np.asarray(rig.joint_rest_positions, np.float64)
    arms, legs, knees = joints[found[:6]].reshape(3, 2, 3)
    middle, half = arms.mean(axis=0), 0.5 * np.linalg.norm(arms[0] - arms[1])
    is_limb = np.isin(np.arange(len(rig.parents)), (left_arm, right_arm, neck))
    for _ in rig.parents:  # and what hangs on arms and neck
        is_limb |= np.array([parent >= 0 and is_limb[parent] for parent in rig.parents])
    moved = np.asarray(rig.skin_weights, np.float64) * is_limb[np.asarray(rig.skin_indices)]
    limbs = smooth(moved.sum(axis=1, keepdims=True), faces, _SMOOTHINGS)[:, 0]
    inside = [
        _LIMB * (0.5 - limbs),
        np.maximum(
            _STRAP * half - abs(positions[:, 0] - middle[0]), middle[1] - _ARMHOLE * half - positions[:, 1]
        ),
        np.linalg.norm(positions - joints[neck], axis=1) - _NECKLINE * half,
    ]
    for hip, knee in zip(legs, knees, strict=True):
        length = np.linalg.norm(knee - hip)
        along = (positions - hip) @ (knee - hip) / length
        is_its_side = (positions - legs.mean(axis=0)) @ (hip - legs.mean(axis=0)) > 0
        inside.append(np.where(is_its_side, _LEG * length - along, _LIMB))
    return np.min(inside, axis=0), positions[:, 1] - joints[spine][1]


def _cut(
    faces: np.ndarray, weights: sparse.csr_array, field: np.ndarray
) -> tuple[np.ndarray, sparse.csr_array]:
    """Cut faces where a field, linear on each of them, is zero; return faces and vertices that follow the old."""
    is_in = field > 0
    count = is_in[faces].sum(axis=1)
    is_whole = (count == 0) | (count == 3)
    mixed = faces[~is_whole]
    lonely = np.where((count[~is_whole] == 1)[:, None], is_in[mixed], ~is_in[mixed])  # alone on its side
    turn = (lonely.argmax(axis=1)[:, None] + np.arange(3)) % 3
    apex, left, right = np.take_along_axis(mixed, turn, axis=1).T
    edges = np.concatenate([np.stack([apex, left], 1), np.stack([apex, right], 1)])
    unique, number = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True)
    start, end = field[unique].T
    share = start / (start - end)
    shares = sparse.diags_array(1 - share), sparse.diags_array(share)
    new = shares[0] @ weights[unique[:, 0]] + shares[1] @ weights[unique[:, 1]]
    to_left, to_right = len(field) + number.ravel().reshape(2, -1)
    pieces = [(apex, to_left, to_right), (to_left, left, right), (to_left, right, to_right)]
    return (
        np.concatenate([faces[is_whole], *(np.stack(piece, axis=1) for piece in pieces)]),
        sparse.csr_array(sparse.vstack([weights, new])),
    )
