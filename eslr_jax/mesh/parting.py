"""Parts of a body that pass through each other are pushed apart, so that cloth between them has room (host).

Skinned bodies pinch: an arm sinks into the trunk, a thigh into the other, an elbow into itself. No cloth can lie
there and cross nothing. So the body that cloth touches yields by a few millimetres, once per motion:

1. A vertex before a face of another part, to which it turns, keeps a gap from it. Both sides give way by half.
2. Where faces cross still, at creases, their vertices move towards their neighbours'.

Legs that pass each other within a frame may be apart at both its ends, and cross on straight ways between them.
So a fast body yields for places beside its frames, too, and then for what still crosses on its ways.

Source: Ando 2024, doi 10.1145/3687908, for a body that yields; the way it does so here is the project's own.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import scipy.sparse
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from eslr_jax.mesh.piercing import close_faces, piercing_edges
from eslr_jax.mesh.topology import adjacency, face_cross_products, normalize, unique_edges

_GAP = 5e-3  # [m] between two parts: cloth on both sides that keeps two millimetres off, and one to spare
_DEEP = 15e-3  # [m] that a vertex may be behind a face; deeper ones belong to the far side of a limb
_AROUND = 0.025  # [m] in which faces are looked for
# [m] apart at rest, below which places belong to one crease; and the gap over what is beyond `_CREASE_START`
_CREASE = (0.04, 0.2)
_CREASE_START = 0.03  # [m]
_TURNED = -0.2  # cosine between normals, below which two places face each other
_FOLDED = 0.2  # cosine between normals, below which faces may cross
_SWEEPS = 40  # of pushes; ten are enough for most frames
_SHARE = 0.8  # of a push that is done at a time
_SMOOTHING = 0.3  # share of the way to the neighbours' mean, at a time
_KEPT = 0.8  # share of what the frames beside it yield that a frame yields too, so that cloth is moved gently
_FAST = 0.02  # [m] in a frame, beyond the common way, from which parts may pass each other between frames
_BETWEEN = (0.25, 0.5)  # shares of a straight way at which its end yields, before the other end does
_ALONG = np.arange(8) / 8  # shares of a fast way at which it is looked at again
_TURNS = 4  # of that, at most
_UNLIKE = 2e-3  # [m] that the ends of a way yield unlike; less does not close a gap
_ENOUGH = 2e-4  # [m] of a gap that may be lacking
_MARGIN = 2e-3  # [m] between faces that are compared; where vertices move by half of it they are found anew


def parted(
    positions: Float[np.ndarray, "frames vertices 3"],
    rest: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
) -> Float[np.ndarray, "frames vertices 3"]:
    """Return the positions of a body whose parts have been pushed apart [m]; at rest nothing crosses."""
    positions, whole, out = np.asarray(positions), _Body(rest, faces), np.array(positions)
    # What is near in any place is looked at in all.
    is_near = np.any([whole.looked_for(posed)[1] for posed in _sampled(positions)], axis=0)
    if not is_near.any():
        return out
    # With the faces around them: these bound how far the others give way.
    is_near = np.isin(faces, np.unique(faces[is_near])).any(axis=1)
    ids, corners = np.unique(faces[is_near], return_inverse=True)
    part, reached = _Body(rest[ids], corners.reshape(-1, 3)), positions[:, ids]
    yields = np.zeros((len(positions), len(ids), 3))
    for frame in range(len(positions)):
        yields[frame] = part.yielding(_places(reached, frame), _KEPT * yields[frame - 1])
    for frame in reversed(range(len(positions) - 1)):
        yields[frame] = _longer(yields[frame], _KEPT * yields[frame + 1])
    part.open_ways(reached, yields)
    out[:, ids] += yields.astype(out.dtype)
    return out


def _sampled(positions: Float[np.ndarray, "frames vertices 3"]) -> Iterator[np.ndarray]:
    """Yield where a body is [m], so often that no part of it comes near another, or passes it, unseen.

    Two parts that both move by `_AROUND` come nearer by twice as much, and are near for as long.
    """
    last = positions[0]
    yield last
    for here, there in itertools.pairwise(positions):
        if _spread(last, there) > _AROUND:
            count = math.ceil(_spread(here, there) / _AROUND)
            yield from (here + share * (there - here) for share in np.arange(1, count + 1) / count)
            last = there
    yield positions[-1]


def _places(positions: Float[np.ndarray, "frames vertices 3"], frame: int) -> list[np.ndarray]:
    """Return where a body is at a frame and next to it [m]: a limb that passes another yields at both ends."""
    here, places = positions[frame], [positions[frame]]
    for other in positions[max(frame - 1, 0) : frame + 2]:
        if _spread(here, other) > _FAST:
            places += [here + share * (other - here) for share in _BETWEEN]
    return places


def _spread(here: Float[np.ndarray, "vertices 3"], there: Float[np.ndarray, "vertices 3"]) -> float:
    """Return how far a part of a body moves at most, beyond the common way [m]."""
    way = there - here
    return float(np.max(np.linalg.norm(way - way.mean(axis=0), axis=1)))


def uncrossed(
    points: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> Float[np.ndarray, "vertices 3"]:
    """Return the vertices of a mesh [m], moved towards their neighbours' where faces cross.

    So a crease that skinning folds through itself opens. What `_SWEEPS` moves don't free stays crossed.
    """
    mesh, moved = _Mesh(np.asarray(faces), len(points)), np.asarray(points, float)
    crossing = _Crossing(mesh.faces)
    for _ in range(_SWEEPS):
        crossed = crossing.at(moved)
        if not len(crossed):
            break
        moved = moved + mesh.smoothing(moved, crossed)
    return moved.astype(points.dtype)


class _Mesh:
    """Faces, and which vertices are neighbours."""

    def __init__(self, faces: Int[np.ndarray, "faces 3"], num_vertices: int):
        self.faces = faces
        self.neighbors = adjacency(unique_edges(faces), num_vertices)
        self.degrees = np.maximum(np.asarray(self.neighbors.sum(axis=1)).ravel(), 1.0)

    def smoothing(self, points: np.ndarray, crossing: Int[np.ndarray, "crossing 3"]) -> np.ndarray:
        """Return moves of vertices of crossing faces towards their neighbours', and half as much around [m]."""
        crossed = np.zeros(len(points))
        crossed[crossing.ravel()] = 1.0
        crossed = np.maximum(crossed, 0.5 * (self.neighbors @ crossed > 0))
        mean = (self.neighbors @ points) / self.degrees[:, None]
        return _SMOOTHING * crossed[:, None] * (mean - points)


class _Crossing:
    """Which of some faces cross others, as their vertices move; neighbours don't count."""

    def __init__(self, faces: Int[np.ndarray, "faces 3"]):
        self.faces = faces
        self.found_at: np.ndarray | None = None

    def at(self, points: Float[np.ndarray, "vertices 3"]) -> Int[np.ndarray, "crossing 3"]:
        """Return the faces that cross."""
        if self.found_at is None or np.max(np.abs(points - self.found_at)) > 0.5 * _MARGIN:
            self.found_at, self.pairs = points, close_faces(points, self.faces, _MARGIN)
        owners, _, pierced = piercing_edges(points, self.faces, self.pairs)
        return self.faces[np.unique(np.concatenate([owners, pierced]))]


class _Opposed(NamedTuple):
    """Vertices before faces that they turn to."""

    vertices: Int[np.ndarray, " rows"]
    corners: Int[np.ndarray, "rows 3"]  # of the faces
    normals: Float[np.ndarray, "rows 3"]  # of the faces
    sizes: Float[np.ndarray, " rows"]  # from their middle to the farthest corner [m]
    gaps: Float[np.ndarray, " rows"]  # to keep [m]


class _Body(_Mesh):
    """What does not move with the body."""

    def __init__(self, rest: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]):
        super().__init__(faces, len(rest))
        self.rest = rest
        self.middles, self.normals, _ = _middles_and_normals(rest, faces)
        corners = faces.ravel(), np.repeat(np.arange(len(faces)), 3)
        shape = (len(rest), len(faces))
        self.incidence = scipy.sparse.coo_array((np.ones(faces.size), corners), shape).tocsr()
        self.facing = normalize(self.incidence @ self.normals)

    def yielding(
        self, places: Sequence[Float[np.ndarray, "vertices 3"]], yielded: Float[np.ndarray, "vertices 3"]
    ) -> Float[np.ndarray, "vertices 3"]:
        """Return how far every vertex yields [m], at several places alike, from a first guess."""
        found = []
        for posed in places:
            opposed, folded = self.looked_for(posed)
            found.append((posed, opposed, _Crossing(self.faces[folded])))
        for _ in range(_SWEEPS):
            before = yielded
            for posed, opposed, crossing in found:
                push = _pushes(posed + yielded, opposed)
                if push is None:
                    crossed = crossing.at(posed + yielded)
                    if not len(crossed):
                        continue
                    push = self.smoothing(posed + yielded, crossed)
                yielded = yielded + push
            if yielded is before:
                break
        return yielded

    def open_ways(
        self,
        reached: Float[np.ndarray, "frames vertices 3"],
        yields: Float[np.ndarray, "frames vertices 3"],
    ) -> None:
        """Let the ends of a fast way yield alike where faces still cross on it, because they yielded unlike."""
        unlike = np.linalg.norm(np.diff(yields, axis=0), axis=2).max(axis=1, initial=0.0)
        ways = {way for way in np.flatnonzero(unlike > _UNLIKE) if _spread(*reached[way : way + 2]) > _FAST}
        for _ in range(_TURNS):
            changed = set()
            for way in sorted(ways):
                for share in _ALONG:
                    mixed = np.array([1.0 - share, share])
                    posed, own = (np.tensordot(mixed, of[way : way + 2], 1) for of in (reached, yields))
                    _, folded = self.looked_for(posed)
                    if len(_Crossing(self.faces[folded]).at(posed + own)):
                        yields[way : way + 2] += self.yielding([posed], own) - own
                        changed |= {way - 1, way, way + 1}
            ways &= changed

    def looked_for(
        self, posed: Float[np.ndarray, "vertices 3"]
    ) -> tuple[_Opposed, Bool[np.ndarray, " faces"]]:
        """Return opposed places, and faces that may cross others."""
        middles, normals, sizes = _middles_and_normals(posed, self.faces)
        facing = normalize(self.incidence @ normals)
        found = cKDTree(posed).sparse_distance_matrix(cKDTree(middles), _AROUND, output_type="ndarray")
        vertex, face = found["i"], found["j"]
        cosine = np.einsum("ij,ij->i", facing[vertex], normals[face])
        is_turned = cosine < _FOLDED
        vertex, face, cosine = vertex[is_turned], face[is_turned], cosine[is_turned]
        apart = self.rest[vertex] - self.middles[face]
        distance = np.linalg.norm(apart, axis=1)
        # The two sides of a lip, or of a toe, are turned so at rest, where they don't cross.
        was_turned = np.einsum("ij,ij->i", self.facing[vertex], self.normals[face]) < _FOLDED
        is_new = (distance > _CREASE[0]) | ~was_turned
        vertex, face, cosine, apart, distance = (
            rows[is_new] for rows in (vertex, face, cosine, apart, distance)
        )
        is_hot = np.zeros(len(posed), bool)
        is_hot[vertex] = True
        folded = is_hot[self.faces].any(axis=1)
        folded[face] = True
        # The far side of a limb lies behind its near side at rest; what faces it lies before it.
        is_before = np.einsum("ij,ij->i", apart, self.normals[face]) > -5e-3
        is_opposed = (cosine < _TURNED) & is_before & (distance > _CREASE[0])
        vertex, face, distance = vertex[is_opposed], face[is_opposed], distance[is_opposed]
        gaps = np.minimum(_GAP, _CREASE[1] * (distance - _CREASE_START))
        return _Opposed(vertex, self.faces[face], normals[face], sizes[face], gaps), folded


def _longer(one: Float[np.ndarray, "rows 3"], other: Float[np.ndarray, "rows 3"]) -> np.ndarray:
    is_longer = np.einsum("ij,ij->i", one, one) >= np.einsum("ij,ij->i", other, other)
    return np.where(is_longer[:, None], one, other)


def _middles_and_normals(points: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the middle, the unit normal and the size of faces, from the middle to the farthest corner."""
    corners = points[faces]
    middles = corners.mean(axis=1)
    normals = normalize(face_cross_products(points, faces))
    return middles, normals, np.linalg.norm(corners - middles[:, None], axis=2).max(axis=1)


def _pushes(points: np.ndarray, opposed: _Opposed) -> np.ndarray | None:
    """Return moves that widen the gaps which are too small [m]; None where all are kept."""
    offset = points[opposed.vertices] - points[opposed.corners].mean(axis=1)
    height = np.einsum("ij,ij->i", offset, opposed.normals)
    aside = np.linalg.norm(offset - height[:, None] * opposed.normals, axis=1)
    is_near = (aside < opposed.sizes) & (height > -_DEEP)
    lack = np.where(is_near, opposed.gaps - height, 0.0)
    rows = np.flatnonzero(lack > 0)
    if np.max(lack, initial=0.0) < _ENOUGH:
        return None
    # The mean of what a vertex is asked for, weighted by it.
    moves, weights = np.zeros_like(points), np.zeros(len(points))
    half = 0.5 * _SHARE * np.square(lack[rows, None]) * opposed.normals[rows]
    for ids, sign in ((opposed.vertices, 1.0), *((corner, -1.0) for corner in opposed.corners.T)):
        np.add.at(moves, ids[rows], sign * half)
        np.add.at(weights, ids[rows], lack[rows])
    return moves / np.maximum(weights, 1e-12)[:, None]
