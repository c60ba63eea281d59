"""A garment on the motion of a body: what terms ask to decide whether a scene needs them (host)."""

from __future__ import annotations

import dataclasses
import functools

import jax
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from eslr_jax.files import kept
from eslr_jax.mesh.parting import parted, uncrossed
from eslr_jax.mesh.surface import prepare_surface
from eslr_jax.mesh.topology import vertex_components
from eslr_jax.pose.lbs import skin_garment
from eslr_jax.pose.motion import SHOULDERS, lowest_point
from eslr_jax.types import Body, BodyMotion, BodySurface, Garment

# [m] that cloth may be away from its skinned place, besides its distance from the body at rest. Body faces that
# are farther away are left out.
REACH = 0.08
_MEETS = 0.04  # [m] between layers that may touch during the frames around
_FAR_AT_REST = 2.0 * _MEETS  # [m] between places of one piece that may meet; nearer ones bend towards
_SPACING = 0.1  # [s] between the frames that are looked at to decide what is modelled
# Vertices of a piece that are compared with each other; a part of a finer one is enough.
_MOST_COMPARED = 4000
_KEPT = 30  # bodies that made room for cloth; 200 frames of what a T-shirt reaches take 8 MB
skinned_frames = jax.jit(skin_garment)


@dataclasses.dataclass(frozen=True)
class Worn:
    """A garment, and the motion of the body that wears it."""

    garment: Garment
    poses: BodyMotion
    shared: BodySurface | None = None  # in the place of the faces in reach

    @functools.cached_property
    def skinned(self) -> Float[np.ndarray, "frames vertices 3"]:
        """The garment carried by the joints [m]."""
        return np.asarray(skinned_frames(self.garment, self.poses.joint_transforms))

    @property
    def unfolding(self) -> Float[np.ndarray, "vertices 3"]:
        """Moves of the first frame's cloth that open what skinning folds through itself [m]."""
        faces = np.asarray(self.garment.faces)[np.asarray(self.garment.rest_areas) > 0]
        return uncrossed(self.skinned[0], faces) - self.skinned[0]

    @functools.cached_property
    def radii(self) -> Float[np.ndarray, " real_vertices"]:
        """How far real vertices may stray from where they are skinned to [m]."""
        return REACH + looseness(self.garment, self.poses)

    @functools.cached_property
    def pieces(self) -> Int[np.ndarray, " vertices"]:
        """The piece of cloth that every vertex belongs to, which no edge joins to others; -1 where padded."""
        garment = self.garment
        faces = np.asarray(garment.faces)[np.asarray(garment.rest_areas) > 0]
        pieces = np.full(len(self._is_real), -1, np.int32)
        pieces[self._is_real] = vertex_components(faces, int(self._is_real.sum()))[1]
        return pieces

    @property
    def num_pieces(self) -> int:
        """Number of pieces of cloth."""
        return int(self.pieces.max()) + 1

    @functools.cached_property
    def surface(self) -> BodySurface | None:
        """The faces of the body that the cloth can reach, looking ten times a second; None without any.

        A T-shirt's scene then searches no legs, no head and no feet.
        """
        if self.shared is not None:
            return self.shared
        bodies = np.asarray(self.poses.positions)  # cut on the host, where it compiles nothing
        is_near = np.zeros(bodies.shape[1], bool)
        for frame in self._sampled:
            far = np.flatnonzero(~is_near)  # once is enough
            is_near[far] = within(self.radii, self.skinned[frame, self._is_real], bodies[frame, far])
        return surface_near(is_near, self.poses)

    @property
    def lowest_point(self) -> float:
        """Height of the lowest point of the moving body [m]."""
        return lowest_point(self.poses)

    def could_fall(self) -> bool:
        """Tell whether a part has no pin, and no cloth above the shoulders that it could hang from."""
        height = np.asarray(self.garment.rest_positions)[self._is_real, 1]
        body = np.asarray(self.poses.rest_positions)[:, 1]
        is_held = self._is_pinned | (height > body.min() + SHOULDERS * np.ptp(body))
        piece = self.pieces[self._is_real]
        return bool(np.setdiff1d(piece, piece[is_held]).size)

    def reaches(self, height: float) -> bool:
        """Tell whether a free vertex comes as near to a height [m] as it may stray."""
        lowest = self.skinned[:, self._is_real, 1].min(axis=0) - self.radii
        return bool((lowest[~self._is_pinned] < height).any())

    def meets_itself(self) -> bool:
        """Tell whether cloth of one piece can touch itself.

        It hangs so far off the body that it can fold, or two places that are far apart at rest come close, such
        as a sleeve and the trunk.
        """
        if np.max(self.radii, initial=0.0) - REACH > _MEETS:
            return True
        rest = np.asarray(self.garment.rest_positions)[self._is_real]
        stride = -(-len(rest) // _MOST_COMPARED)
        rest = rest[::stride]
        for positions in self.skinned[self._sampled][:, self._is_real][:, ::stride]:
            pairs = cKDTree(positions).query_pairs(_MEETS, output_type="ndarray")
            if np.any(np.linalg.norm(rest[pairs[:, 0]] - rest[pairs[:, 1]], axis=1) > _FAR_AT_REST):
                return True
        return False

    @functools.cached_property
    def _is_real(self) -> np.ndarray:
        return np.asarray(self.garment.vertex_mask)

    @property
    def _is_pinned(self) -> np.ndarray:
        """Of real vertices."""
        return np.asarray(self.garment.is_pinned)[self._is_real]

    @functools.cached_property
    def _sampled(self) -> np.ndarray:
        """The frames that are looked at to decide what is modelled: first and last included."""
        last, spacing = len(self.poses.positions) - 1, max(round(_SPACING / float(self.poses.timestep)), 1)
        return np.unique(np.linspace(0, last, -(-last // spacing) + 1).astype(int))


def parted_body(poses: BodyMotion) -> BodyMotion:
    """Return the motion of a body whose parts, as far as cloth reaches them, don't pass through each other."""
    if (surface := poses.surface) is None:
        return poses
    ids, faces = np.asarray(surface.vertex_ids), np.asarray(surface.faces)
    positions = np.array(poses.positions)
    given = positions[:, ids], np.asarray(poses.rest_positions)[ids], faces
    path = kept.path_of("parted", kept.content_key(("mesh", "numerics.py"), *given) + ".npz")
    positions[:, ids] = kept.find(path, lambda: {"positions": parted(*given)}, _KEPT)["positions"]
    return poses.replace(positions=positions)


def surface_near(is_near: np.ndarray, body: Body | BodyMotion) -> BodySurface | None:
    """Return the surface of the obstacle faces with one of some body vertices; None without any."""
    faces = np.asarray(body.faces)[np.asarray(body.is_obstacle)]
    is_kept = is_near[faces].any(axis=1)
    if not is_kept.any():
        return None
    return prepare_surface(np.asarray(body.rest_positions), faces[is_kept])


def looseness(garment: Garment, body: Body | BodyMotion) -> np.ndarray:
    """Return how far real vertices hang from the body at rest [m]: a hem swings, a collar does not."""
    obstacle = np.unique(np.asarray(body.faces)[np.asarray(body.is_obstacle)])
    points = np.asarray(garment.rest_positions)[np.asarray(garment.vertex_mask)]
    distance, _ = cKDTree(np.asarray(body.rest_positions)[obstacle]).query(points)
    return distance


def within(radii: np.ndarray, centers: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return which points lie within the radius around any of the centers [m]."""
    is_within = np.zeros(len(points), bool)
    most = np.max(radii, initial=0.0)
    low, high = centers.min(axis=0) - most, centers.max(axis=0) + most
    boxed = np.flatnonzero(((points > low) & (points < high)).all(axis=1))  # a tree of few is quick to search
    for hits in cKDTree(points[boxed]).query_ball_point(centers, radii):
        is_within[boxed[hits]] = True
    return is_within
