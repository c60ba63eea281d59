"""An independent referee: intersections, distances and continuous collision by the IPC Toolkit (extra `dev`).

Nothing here shares code with the simulator's own contact search.
"""

from __future__ import annotations

import dataclasses
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from eslr_jax.extras import require

_CONSERVATIVE = 0.99  # share of the way to the contact at which continuous collision stops
_DEFAULT_REACH = 0.02  # [m] within which minimum distances are looked for


@dataclasses.dataclass(frozen=True)
class Verdict:
    """What the referee finds in one frame."""

    cloth_cloth: int  # pairs of cloth triangles that intersect
    cloth_body: int  # pairs of a cloth and a body triangle that intersect


class Referee:
    """Judges frames of one cloth mesh, with or without a body.

    Body triangles are never tested against each other: real bodies intersect themselves.
    """

    def __init__(
        self,
        cloth_faces: Int[np.ndarray, "faces 3"],
        num_cloth_vertices: int,
        body_faces: Int[np.ndarray, "body_faces 3"] | None = None,
        num_body_vertices: int = 0,
    ) -> None:
        """Prepare a referee.

        Args:
            cloth_faces: Triangles of the cloth.
            num_cloth_vertices: Vertices of the cloth; padded vertices, which no face uses, do no harm.
            body_faces: Triangles of the body, or None without one.
            num_body_vertices: Vertices of the body.

        Raises:
            MissingExtraError: The IPC Toolkit is not installed.
        """
        self._ipctk: ModuleType = require("ipctk", extra="dev", purpose="the referee")
        self._num_cloth = num_cloth_vertices
        self._num_body = num_body_vertices if body_faces is not None else 0
        faces = np.asarray(cloth_faces, np.int32)
        if body_faces is not None:
            faces = np.concatenate([faces, np.asarray(body_faces, np.int32) + num_cloth_vertices])
        self._faces = np.asfortranarray(faces)
        self._num_cloth_faces = len(cloth_faces)
        self._edges = np.asfortranarray(self._ipctk.edges(self._faces))
        self._edge_faces = _faces_of_edges(self._edges, self._faces)

    def judge(
        self,
        cloth: Float[np.ndarray, "vertices 3"],
        body: Float[np.ndarray, "body_vertices 3"] | None = None,
    ) -> Verdict:
        """Count intersecting pairs of triangles.

        Args:
            cloth: Cloth vertices [m].
            body: Body vertices [m], if the referee knows a body.
        """
        pairs = self.intersecting_pairs(cloth, body)
        is_body = pairs >= self._num_cloth_faces
        return Verdict(
            cloth_cloth=int(np.sum(~is_body.any(axis=1))), cloth_body=int(np.sum(is_body.any(axis=1)))
        )

    def intersecting_pairs(
        self, cloth: Float[np.ndarray, "vertices 3"], body: Float[np.ndarray, "body_vertices 3"] | None = None
    ) -> Int[np.ndarray, "pairs 2"]:
        """Return pairs of faces that intersect; body faces are counted on from the last cloth face.

        Two triangles intersect where an edge of one pierces the other. Faces that share a vertex are not
        tested: they touch by construction.
        """
        positions = self._join(cloth, body)
        if not np.isfinite(positions).all():
            return np.empty((0, 2), np.int64)
        broad = self._ipctk.LBVH()
        broad.can_vertices_collide = self._filter()
        broad.build(positions, self._edges, self._faces, 0.0)
        candidates = broad.detect_edge_face_candidates()
        ids = np.array([(c.edge_id, c.face_id) for c in candidates], np.int64).reshape(-1, 2)
        hits = ids[self._pierces(positions, ids)]
        pairs = [
            (min(face, other), max(face, other))
            for edge, face in hits
            for other in self._edge_faces[edge]
            if other >= 0 and not set(self._faces[face]) & set(self._faces[other])
        ]
        return np.unique(np.array(pairs, np.int64).reshape(-1, 2), axis=0)

    def minimum_distance(
        self,
        cloth: Float[np.ndarray, "vertices 3"],
        body: Float[np.ndarray, "body_vertices 3"] | None = None,
        *,
        between: str = "cloth_cloth",
        reach: float = _DEFAULT_REACH,
    ) -> float:
        """Return the least distance between triangles that share no vertex [m]; infinite beyond `reach`.

        Args:
            cloth: Cloth vertices [m].
            body: Body vertices [m].
            between: "cloth_cloth" or "cloth_body".
            reach: Look no farther than this [m].
        """
        positions = self._join(cloth, body)
        mesh = self._mesh(positions, between)
        collisions = self._ipctk.NormalCollisions()
        collisions.build(mesh, positions, reach)
        squared = collisions.compute_minimum_distance(mesh, positions)
        return float(np.sqrt(squared)) if np.isfinite(squared) else float("inf")

    def first_contact(
        self,
        cloth: Float[np.ndarray, "vertices 3"],
        next_cloth: Float[np.ndarray, "vertices 3"],
        body: Float[np.ndarray, "body_vertices 3"] | None = None,
        next_body: Float[np.ndarray, "body_vertices 3"] | None = None,
        *,
        between: str = "cloth_cloth",
    ) -> float:
        """Return the share of a frame after which surfaces meet, vertices moving straight; 1 is never.

        It stops at 99 % of the way to the contact.

        Args:
            cloth: Cloth vertices at t [m], free of intersections.
            next_cloth: At t + 1 [m].
            body: Body vertices at t [m].
            next_body: At t + 1 [m].
            between: "cloth_cloth" or "cloth_body".
        """
        start, end = self._join(cloth, body), self._join(next_cloth, next_body)
        # Tight inclusion takes minutes on the many parallel faces of resting cloth.
        method = self._ipctk.AdditiveCCD(max_iterations=10_000, conservative_rescaling=_CONSERVATIVE)
        mesh = self._mesh(start, between)
        return float(self._ipctk.compute_collision_free_stepsize(mesh, start, end, narrow_phase_ccd=method))

    def _join(self, cloth: np.ndarray, body: np.ndarray | None) -> np.ndarray:
        """Return all vertices in one array that the toolkit accepts."""
        parts = [np.asarray(cloth, np.float64)[: self._num_cloth]]
        if self._num_body:
            if body is None:
                raise ValueError("this referee knows a body; give its vertices")
            parts.append(np.asarray(body, np.float64))
        return np.asfortranarray(np.concatenate(parts))

    def _filter(self, between: str | None = None) -> Any:
        """Return which vertex pairs may meet: never two of the body, and else `between`."""
        if between == "cloth_body":
            patches = np.arange(self._num_cloth + self._num_body) >= self._num_cloth
            return self._ipctk.make_vertex_patches_filter(patches.astype(np.int32))
        keep = self._ipctk.make_static_obstacle_filter(self._num_cloth)
        if between == "cloth_cloth" and self._num_body:
            patches = np.arange(self._num_cloth + self._num_body) >= self._num_cloth
            keep = keep & ~self._ipctk.make_vertex_patches_filter(patches.astype(np.int32))
        return keep

    def _mesh(self, positions: np.ndarray, between: str) -> Any:
        """Return the toolkit's mesh with its filter."""
        if between not in ("cloth_cloth", "cloth_body"):
            raise ValueError(f'between is {between!r}; use "cloth_cloth" or "cloth_body"')
        mesh = self._ipctk.CollisionMesh(positions, self._edges, self._faces)
        mesh.can_collide = self._filter(between)
        return mesh

    def _pierces(self, positions: np.ndarray, ids: Int[np.ndarray, "pairs 2"]) -> Bool[np.ndarray, " pairs"]:
        """Return which edges pierce which faces; float64 sorts out the clear cases, the toolkit the rest."""
        start, end = (positions[self._edges[ids[:, 0], k]] for k in range(2))
        corners = positions[self._faces[ids[:, 1]]]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        heights = [np.einsum("ij,ij->i", point - corners[:, 0], normal) for point in (start, end)]
        size = np.abs(positions).max(initial=0.0) + 1e-300
        margin = 1e-12 * size * np.linalg.norm(normal, axis=1)
        is_apart = (np.minimum(*heights) > margin) | (np.maximum(*heights) < -margin)
        hits = ~is_apart
        for row in np.flatnonzero(hits):
            hits[row] = self._meets(start[row], end[row], corners[row])
        return hits

    def _meets(self, start: np.ndarray, end: np.ndarray, corners: np.ndarray) -> bool:
        """Return whether one edge meets one triangle; the toolkit calls every coplanar pair a hit."""
        is_hit, u, *_ = self._ipctk.edge_triangle_intersection(start, end, *corners)
        if not is_hit or np.isfinite(u):
            return bool(is_hit)
        tolerance = 1e-20 * float(np.sum((end - start) ** 2))
        if any(self._ipctk.point_triangle_distance(point, *corners) <= tolerance for point in (start, end)):
            return True
        sides = ((0, 1), (1, 2), (2, 0))
        return any(
            self._ipctk.edge_edge_distance(start, end, corners[i], corners[j]) <= tolerance for i, j in sides
        )


def _faces_of_edges(edges: np.ndarray, faces: np.ndarray) -> Int[np.ndarray, "edges 2"]:
    """Return the faces beside every edge; -1 where there is none."""
    sides = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    base = int(faces.max()) + 1
    keys = sides[:, 0].astype(np.int64) * base + sides[:, 1]
    order = np.argsort(keys, kind="stable")
    ends = np.sort(edges, axis=1)
    wanted = ends[:, 0].astype(np.int64) * base + ends[:, 1]
    first = np.searchsorted(keys[order], wanted)
    beside = np.full((len(edges), 2), -1)
    beside[:, 0] = order[first] % len(faces)
    second = np.minimum(first + 1, len(keys) - 1)
    is_shared = (first + 1 < len(keys)) & (keys[order][second] == wanted)
    beside[is_shared, 1] = order[second[is_shared]] % len(faces)
    return beside
