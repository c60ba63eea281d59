"""Garments that are worn together: one mesh of several pieces, each outside those beneath it (host)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from eslr_jax.errors import MeshError
from eslr_jax.files.parsing import split_name
from eslr_jax.mesh.closest import nearest_places
from eslr_jax.mesh.skinning import smooth
from eslr_jax.mesh.topology import inverse_rest_frames, is_on_boundary, vertex_normals
from eslr_jax.pipeline.dressing.report import common_wearer
from eslr_jax.pipeline.formats.garment import GarmentFile
from eslr_jax.pipeline.formats.mesh import Faces, Positions, join_meshes, stack_tables

LAYER_GAP = 5e-3  # [m] left between two layers at rest: more than the thickness of the body's contact
_REACH = 0.05  # [m] beneath a layer from which cloth is moved over it; deeper, it belongs to another limb
_ROUNDS = 20
_SPREAD = 3  # smoothings that let the neighbours of a moved vertex follow


def wear_together(garments: Sequence[GarmentFile], files: Sequence[str]) -> GarmentFile:
    """Return one garment as it is, or several as an outfit whose parts have the names of assets or files.

    The innermost comes first; `FILE#NAME` is called NAME. See `combine_garments` for what is refused.
    """
    return garments[0] if len(garments) == 1 else combine_garments(garments, garment_names(files))


def garment_names(files: Sequence[str]) -> list[str]:
    """Return what garments are called in an outfit, see `wear_together`."""
    return [split_name(file)[1] or Path(file).stem for file in files]


def combine_garments(garments: Sequence[GarmentFile], names: Sequence[str]) -> GarmentFile:
    """Return garments that are worn together as one garment of several pieces.

    Where a garment lies beneath an earlier one in the rest pose, it is moved over it. It keeps its own lengths.

    Args:
        garments: Garments of one body, the innermost first.
        names: A name for each. They name the parts; a garment's own parts follow behind a slash.

    Returns:
        The outfit. `metadata["outfit"]` has the names and the numbers of vertices.

    Raises:
        MeshError: Two garments have the same name or were fitted to different bodies, or vertices of one stay
            beneath another.
    """
    if len(set(names)) < len(names):
        raise MeshError(f"an outfit of {', '.join(names)}: a garment can be worn once only")
    wearer = common_wearer(garments, names)
    placed: list[np.ndarray] = []
    for number, garment in enumerate(garments):
        positions = garment.rest_positions
        for inner, other in zip(placed, garments[:number], strict=True):
            positions = _move_over(positions, garment.faces, inner, other.faces)
        for inner, other, name in zip(placed, garments[:number], names[:number], strict=True):
            heights, _, _ = _heights(positions, inner, other.faces)
            if (beneath := int(np.sum(heights < 0))) > 0:
                raise MeshError(
                    f"{beneath} vertices of {names[number]} stay beneath {name}; change their order"
                )
        placed.append(positions)
    counts = [len(positions) for positions in placed]
    positions, faces = join_meshes(placed, [garment.faces for garment in garments])
    sewn = [g.rest_positions if g.sewn_positions is None else g.sewn_positions for g in garments]
    uvs = [np.zeros((len(g.faces), 3, 2)) if g.corner_uvs is None else g.corner_uvs for g in garments]
    has_uvs = any(garment.corner_uvs is not None for garment in garments)
    is_cut = any(garment.panel_corners is not None for garment in garments)
    corners = [
        _flat(s, g.faces) if g.panel_corners is None else g.panel_corners
        for s, g in zip(sewn, garments, strict=True)
    ]
    part_names, face_parts, fabrics = [], [], []
    for garment, name in zip(garments, names, strict=True):
        own, numbers = [name], np.zeros(len(garment.faces), np.int64)
        if garment.face_parts is not None:
            own, numbers = [f"{name}/{part}" for part in garment.part_names], garment.face_parts
        face_parts.append(len(part_names) + numbers)
        part_names += own
        given = dict.fromkeys(own, "cotton")
        for text in garment.metadata.get("fabrics", ()):
            part, separator, fabric = str(text).rpartition(":")
            given |= {f"{name}/{part}": fabric} if separator else dict.fromkeys(given, fabric)
        fabrics += [f"{part}:{fabric}" for part, fabric in given.items()]
    return GarmentFile(
        rest_positions=positions,
        faces=faces,
        skin_weights=stack_tables([garment.skin_weights for garment in garments]),
        skin_indices=stack_tables([garment.skin_indices for garment in garments]),
        is_pinned=np.concatenate([garment.is_pinned for garment in garments]),
        sewn_positions=np.concatenate(sewn),
        panel_corners=np.concatenate(corners) if is_cut else None,
        corner_uvs=np.concatenate(uvs) if has_uvs else None,
        face_parts=np.concatenate(face_parts),
        part_names=tuple(part_names),
        metadata={"outfit": dict(zip(names, counts, strict=True)), "fabrics": fabrics, **wearer},
    )


def _move_over(positions: Positions, faces: Faces, inner: np.ndarray, inner_faces: np.ndarray) -> Positions:
    """Return a layer with its vertices moved out over another one, and its faces off that one's vertices."""
    result = positions.copy()
    for _ in range(_ROUNDS):
        heights, normals, _ = _heights(result, inner, inner_faces)
        move = np.maximum(LAYER_GAP - heights, 0.0)[:, None] * normals
        # Vertices of the layer beneath may still look out between those of this one.
        under, outward, nearest = _heights(inner, result, faces)
        sunk = np.flatnonzero(np.isfinite(under) & (under > -0.5 * LAYER_GAP))
        lift = (under[sunk] + 0.5 * LAYER_GAP)[:, None] * outward[sunk]
        for corner in range(3):
            vertices = faces[nearest[sunk], corner]
            longer = np.linalg.norm(lift, axis=1) > np.linalg.norm(move[vertices], axis=1)
            move[vertices[longer]] = lift[longer]
        if np.abs(move).max(initial=0.0) < 1e-5:
            break
        is_moved = np.abs(move).max(axis=1, keepdims=True) > 0
        result += np.where(is_moved, move, smooth(move, faces, _SPREAD))
    return result


def _heights(
    points: Float[np.ndarray, "points 3"], positions: Positions, faces: Faces
) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, "points 3"], Int[np.ndarray, " points"]]:
    """Return how high points are over a layer [m], infinite where they are beside it, its normals and faces.

    Beside it are points whose nearest place on it is on a hem, or more than 5 cm away.
    """
    place = nearest_places(points, positions, faces, vertex_normals(positions, faces))
    hem = is_on_boundary(faces, len(positions))
    is_beside = np.all(hem[faces[place.faces]] | (place.weights < 1e-6), axis=1)
    is_beside |= np.linalg.norm(place.offsets, axis=1) > _REACH
    heights = np.einsum("px,px->p", place.offsets, place.normals)
    return np.where(is_beside, np.inf, heights), place.normals, place.faces


def _flat(positions: Positions, faces: Faces) -> Float[np.ndarray, "faces 3 2"]:
    """Return the corners of every face in its own plane [m]."""
    edges = np.linalg.inv(inverse_rest_frames(positions, faces)).swapaxes(1, 2)
    return np.concatenate([edges, np.zeros((len(faces), 1, 2))], axis=1)
