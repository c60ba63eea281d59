"""From a garment as a program exported it to one that can be simulated on a body."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from eslr_jax.errors import MeshError
from eslr_jax.fit.clearance import push_out
from eslr_jax.fit.options import FitOptions
from eslr_jax.fit.pins import select_vertices
from eslr_jax.fit.placement import Placement, find_placement
from eslr_jax.fit.postures import Posture, arm_postures, rest_posture, unpose
from eslr_jax.fit.remesh import remesh
from eslr_jax.geometry.repair import (
    Cleaned,
    consistent_orientation,
    join_components,
    largest_component,
    weld,
)
from eslr_jax.geometry.skinning import transfer_skin_weights
from eslr_jax.geometry.topology import face_areas, face_cross_products, vertex_components
from eslr_jax.geometry.validate import check_arrays, validate_mesh
from eslr_jax.io.garment import GarmentFile, GarmentSource
from eslr_jax.types import Body

_SMOOTHING = 3  # Laplacian steps over transferred skin weights, as for the bundled shirts
_LOOSE_SMOOTHING = 20  # for skirts, or the two legs tear them, as for the bundled dresses
_LOOSE = 0.05  # [m] from the body; with a tenth of the vertices farther away a garment is loose
_MAX_COORDINATE = 1e6  # beyond which no unit makes a garment


def fit_garment(source: GarmentSource, body: Body, options: FitOptions | None = None) -> GarmentFile:
    """Clean a garment's mesh, put it on the body, and give it skin weights and pins.

    Lengths, areas and angles stay those of the file, remeshing apart: turning arms down and taking vertices out
    of the body change the rest positions, not the sewn shape.

    Args:
        source: Of `read_garment_source`.
        body: The body in its rest pose.
        options: What is not left to recognition.

    Returns:
        The garment; `metadata["fit"]` says what was recognised and done.

    Raises:
        MeshError: The mesh can't be repaired, or does not fit the body.
        ConfigError: An option contradicts the garment.
    """
    options = options or FitOptions()
    mesh, name = source.mesh, source.name
    check_arrays(mesh.positions, mesh.faces, name=name)
    largest = float(np.abs(mesh.positions).max())
    if largest > _MAX_COORDINATE:
        raise MeshError(f"{name}: coordinates up to {largest:.3g} are no garment's; check the file")
    clean, report = _clean(mesh.positions, mesh.faces, options)
    postures = arm_postures(body) if options.arms == "auto" else [rest_posture(body)]
    placement = find_placement(
        clean.positions,
        clean.faces,
        postures,
        units="m" if source.is_metric and options.units == "auto" else options.units,
        up="y" if source.is_metric and options.up == "auto" else options.up,
        front=options.front,
        keep_place=options.keep_place,
        name=name,
    )
    posture = postures[placement.posture]
    clean, joined = _join(dataclasses.replace(clean, positions=placement.apply(clean.positions)), options)
    is_turned = _turned_faces(clean, posture)
    sewn, vertex_map, face_source = clean.positions, clean.vertex_map, clean.face_source
    faces = _turn(clean.faces, is_turned)
    report |= joined | {"turned_faces": int(is_turned.sum())}
    if options.edge_length is not None:
        sewn, faces, nearest = remesh(sewn, faces, options.edge_length)
        vertex_map, face_source = np.arange(len(sewn)), face_source[nearest]
    validate_mesh(sewn, faces, name=name, allow_components=options.components != "refuse")
    report |= {"vertices": len(sewn), "faces": len(faces)}

    clear, penetration = push_out(sewn, faces, posture) if options.push_out else (sewn, {})
    weights, indices = _skin_weights(clear, faces, posture, body)
    rest = clear
    if posture.arm_angle is not None:
        rest = unpose(clear, weights, indices, posture.transforms)
        rest = push_out(rest, faces, postures[0])[0] if options.push_out else rest
    parts = None if mesh.face_parts is None else mesh.face_parts[face_source]
    is_pinned = np.zeros(len(rest), bool)
    if source.is_pinned is not None and options.edge_length is None:
        held = vertex_map[source.is_pinned]
        is_pinned[held[held >= 0]] = True
    for text in options.pin:
        is_pinned |= select_vertices(
            text, rest, faces, vertex_map=vertex_map, face_parts=parts, part_names=mesh.part_names
        )
    uvs = None
    if mesh.corner_uvs is not None and options.edge_length is None:
        uvs = _turn(mesh.corner_uvs[face_source], is_turned)
    return GarmentFile(
        rest_positions=rest,
        faces=faces,
        skin_weights=weights,
        skin_indices=indices,
        is_pinned=is_pinned,
        sewn_positions=sewn,
        corner_uvs=uvs,
        face_parts=parts,
        part_names=mesh.part_names,
        vertex_map=vertex_map,
        metadata={
            "name": name,
            "fit": {
                "placement": _describe(placement, posture),
                "mesh": report,
                "penetration": penetration,
                "pinned": int(is_pinned.sum()),
            },
        },
    )


def _clean(positions: np.ndarray, faces: np.ndarray, options: FitOptions) -> tuple[Cleaned, dict[str, Any]]:
    """Weld open edges and say what became of the mesh."""
    clean = weld(positions, faces.astype(np.int64), tolerance=options.weld)
    if not face_areas(clean.positions, clean.faces).sum() > 0:
        raise MeshError(
            "no face with an area is left once coincident vertices are one; check the mesh, or the weld distance"
        )
    num_used = len(np.unique(faces))
    report = {
        "source_vertices": len(positions),
        "source_faces": len(faces),
        "loose_vertices": len(positions) - num_used,
        "welded_vertices": num_used - len(clean.positions),
        "dropped_faces": len(faces) - len(clean.faces),
        "components": vertex_components(clean.faces, len(clean.positions))[0],
    }
    return clean, report


def _join(clean: Cleaned, options: FitOptions) -> tuple[Cleaned, dict[str, Any]]:
    """Do with separate parts what the options say; positions are in metres."""
    if options.components not in ("join", "largest"):
        return clean, {}
    if options.components == "join":
        step = join_components(clean.positions, clean.faces, options.join_gap)
    else:
        step = largest_component(clean.positions, clean.faces)
    onward = np.append(step.vertex_map, -1)[clean.vertex_map]  # -1 stays -1
    left = vertex_components(step.faces, len(step.positions))[0]
    return (
        Cleaned(step.positions, step.faces, onward, clean.face_source[step.face_source]),
        {"components_left": left},
    )


def _turned_faces(clean: Cleaned, posture: Posture) -> np.ndarray:
    """Return the faces to turn: those that disagree with their neighbours, and parts that face the body."""
    turn = consistent_orientation(clean.positions, clean.faces)
    crosses = face_cross_products(clean.positions, _turn(clean.faces, turn))
    _, nearest = posture.tree.query(clean.positions[clean.faces].mean(axis=1))
    outward = np.einsum("fx,fx->f", crosses, posture.normals[posture.touchable[nearest]])
    _, component = vertex_components(clean.faces, len(clean.positions))
    owner = component[clean.faces[:, 0]]
    return turn ^ (np.bincount(owner, weights=outward) < 0)[owner]


def _turn(rows: np.ndarray, is_turned: np.ndarray) -> np.ndarray:
    """Reverse the corners of the marked rows."""
    result = rows.copy()
    result[is_turned] = rows[is_turned][:, ::-1]
    return result


def _skin_weights(
    positions: np.ndarray, faces: np.ndarray, posture: Posture, body: Body
) -> tuple[np.ndarray, np.ndarray]:
    """Take skin weights over from the body in the garment's pose."""
    is_loose = np.quantile(posture.heights(positions), 0.9) > _LOOSE
    return transfer_skin_weights(
        positions,
        posture.positions,
        posture.faces,
        np.asarray(body.skin_weights, np.float64),
        np.asarray(body.skin_indices),
        smoothing_steps=_LOOSE_SMOOTHING if is_loose else _SMOOTHING,
        faces=faces,
    )


def _describe(placement: Placement, posture: Posture) -> dict[str, Any]:
    """Return a placement as plain values."""
    return {
        "metres_per_unit": placement.factor,
        "up": placement.up,
        "front": placement.front,
        "moved_m": [round(float(value), 4) for value in placement.translation],
        "arms_below_horizontal_deg": posture.arm_angle,
        "cost": round(placement.cost, 3),
    }
