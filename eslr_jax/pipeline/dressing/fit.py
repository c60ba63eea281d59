"""Make a garment that another program exported ready for simulation on a body."""

from __future__ import annotations

import dataclasses
import warnings
from typing import Any

import numpy as np

from eslr_jax.errors import ConfigError, MeshError
from eslr_jax.mesh.topology import face_areas, undirected_edges, vertex_components
from eslr_jax.mesh.validate import check_arrays, validate_mesh
from eslr_jax.pipeline.dressing import repair
from eslr_jax.pipeline.dressing.clearance import lay_to_rest
from eslr_jax.pipeline.dressing.options import FitOptions
from eslr_jax.pipeline.dressing.pins import choose_pins
from eslr_jax.pipeline.dressing.placement import find_placement
from eslr_jax.pipeline.dressing.postures import arm_postures, rest_posture
from eslr_jax.pipeline.dressing.remesh import remesh
from eslr_jax.pipeline.dressing.report import describe_cost, wearer_entry
from eslr_jax.pipeline.dressing.transfer import carry_shape
from eslr_jax.pipeline.formats.garment import GarmentFile, first_rows
from eslr_jax.pipeline.formats.mesh import MeshFile
from eslr_jax.pose.motion import chest_direction
from eslr_jax.types import Body

_MAX_COORDINATE = 1e6  # beyond it no unit makes a garment
_SEAM = 2e-3  # [m] between the edges of pieces that programs export with their seams open: .1 to 1 mm
_ALONG = 0.2  # of all edges' vertices that are as near to another piece: seams, and no single touch


def fit_garment(
    mesh: MeshFile, body: Body, options: FitOptions | None = None, *, made_for: Body | None = None
) -> GarmentFile:
    """Clean a garment's mesh, put it on the body, and give it skin weights and pins; warn if that takes long.

    Lengths, areas and angles stay those of the file, unless it is remeshed. Lowering arms and moving vertices
    out of the body change the rest positions, not the sewn shape.

    Args:
        mesh: Garment of `read_garment_source`.
        body: The body in its rest pose.
        options: Settings that replace what is recognised from the mesh.
        made_for: The body that it was modelled on, if that is another one: it is put on that body first and
            carried from there; see `transfer_garment`.

    Returns:
        The garment; `metadata["fit"]` reports what was recognised, done and doubted, `metadata["body"]` tells
        the body.

    Raises:
        MeshError: The mesh can't be repaired, does not fit the body, or can't be carried to it.
        ConfigError: An option contradicts the garment.
    """
    options = options or FitOptions()
    name = mesh.name
    check_arrays(mesh.positions, mesh.faces, name=name)
    largest = float(np.abs(mesh.positions).max())
    if largest > _MAX_COORDINATE:
        raise MeshError(
            f"{name}: coordinates up to {largest:.3g} are too large for a garment; check the file"
        )
    for option, value in (("weld", options.weld), ("join_gap", options.join_gap)):
        if not 0 <= value < np.inf:
            raise ConfigError(f"{option} = {value:g} is no distance; give 0 or more")
    if made_for is None and options.scale != "body":
        raise ConfigError(
            f"scale {options.scale} is for a garment of another body; give that body too (eslr fit --made-for)"
        )
    text = describe_cost(len(mesh.positions))
    if text and options.edge_length is None:  # else it is remeshed, and its size is chosen
        warnings.warn(text, stacklevel=2)
    worn_by = body if made_for is None else made_for
    clean, report = _clean(mesh, options)
    postures = arm_postures(worn_by) if options.arms == "auto" else [rest_posture(worn_by)]
    facing = chest_direction(worn_by)
    placement = find_placement(
        clean.positions, clean.faces, postures, options, is_metric=mesh.is_metric, facing=facing, name=name
    )
    posture = postures[placement.posture]
    clean = dataclasses.replace(clean, positions=placement.apply(clean.positions))
    clean, joined, doubts = _join(clean, options)
    thickness = repair.shell_thickness(clean.positions, clean.faces)
    if thickness is not None:
        doubts.append(
            f"it is a closed shell with two sides {1e3 * thickness:.1f} mm apart, which is stiff as foam; "
            "export a single layer (thin, without thickness)"
        )
    # Faces are turned that disagree with neighbours, and parts that face the body.
    turn = repair.consistent_orientation(clean.positions, clean.faces)
    is_turned = turn ^ posture.is_turned_in(clean.positions, _turn(clean.faces, turn))
    faces = _turn(clean.faces, is_turned)
    report |= joined | {"turned_faces": int(is_turned.sum())}

    sewn, parts, uvs, lost = clean.positions, mesh.face_parts, mesh.corner_uvs, []
    file_pins = np.zeros(len(sewn), bool)
    if options.edge_length is None:
        vertex_map, joined_rows, face_source = clean.vertex_map, None, clean.face_source
        if mesh.is_pinned is not None:
            held = vertex_map[mesh.is_pinned]
            file_pins[held[held >= 0]] = True
        if mesh.rows is not None:
            vertex_map, joined_rows = vertex_map[mesh.rows], first_rows(mesh.rows, len(vertex_map))
        uvs = None if uvs is None else _turn(uvs[face_source], is_turned)
    else:
        lost = _lost_pins(mesh, options)
        sewn, faces, nearest = remesh(sewn, faces, options.edge_length)
        vertex_map, joined_rows, face_source = np.arange(len(sewn)), None, clean.face_source[nearest]
        file_pins, uvs = np.zeros(len(sewn), bool), None
    parts = None if parts is None else parts[face_source]
    validate_mesh(sewn, faces, name=name, allow_components=options.components != "refuse")
    report |= {"vertices": len(sewn), "faces": len(faces)}

    placed, worn_in, transfer = sewn, posture, {}
    if made_for is not None:
        placed, sewn, worn_in, carried = carry_shape(
            sewn, faces, posture, made_for, body, scale=options.scale
        )
        transfer = {"transfer": carried}
    worn, penetration = lay_to_rest(placed, faces, worn_in, body, is_pushed=options.push_out)
    garment = GarmentFile(
        **worn,
        faces=faces,
        is_pinned=file_pins,
        sewn_positions=sewn,
        corner_uvs=uvs,
        face_parts=parts,
        part_names=mesh.part_names,
        vertex_map=vertex_map,
        joined_rows=joined_rows,
    )
    is_pinned, pinned_by, falling = choose_pins(options.pin, garment, body)
    return dataclasses.replace(
        garment,
        is_pinned=is_pinned,
        metadata={
            "name": name,
            **wearer_entry(body),
            "fit": {
                "placement": {
                    "what": placement.describe(),
                    "metres_per_unit": placement.factor,
                    "up": placement.up,
                    "front": placement.front,
                    "origin": placement.origin,
                    "moved_m": [round(float(value), 4) for value in placement.translation],
                    "arms_below_horizontal_deg": posture.arm_angle,
                    "cost": round(placement.cost, 3),
                    "confidence": round(placement.confidence, 3),
                },
                "mesh": report,
                "penetration": penetration,
                "pinned": int(is_pinned.sum()),
                "pinned_by": pinned_by,
                "warnings": [*placement.warnings, *doubts, *lost, *falling],
                **transfer,
            },
        },
    )


def _clean(mesh: MeshFile, options: FitOptions) -> tuple[repair.Cleaned, dict[str, Any]]:
    clean = repair.weld(mesh.positions, mesh.faces.astype(np.int64), tolerance=options.weld)
    if not face_areas(clean.positions, clean.faces).sum() > 0:
        raise MeshError(
            "no face with an area is left after welding coincident vertices; check the mesh, or give eslr fit a "
            "smaller --weld"
        )
    num_used = len(np.unique(mesh.faces))
    return clean, {
        "source_vertices": len(mesh.positions),
        "source_faces": len(mesh.faces),
        "loose_vertices": len(mesh.positions) - num_used,
        "welded_vertices": num_used - len(clean.positions),
        "dropped_faces": len(mesh.faces) - len(clean.faces),
        "components": vertex_components(clean.faces, len(clean.positions))[0],
    }


def _join(clean: repair.Cleaned, options: FitOptions) -> tuple[repair.Cleaned, dict[str, Any], list[str]]:
    """Join or drop separate parts as the options say; positions are in metres. Return report and warnings."""
    chosen, doubts = options.components, []
    if chosen == "auto":
        gaps = (min(_SEAM, options.join_gap), options.join_gap)
        shares = repair.shares_along_seams(clean.positions, clean.faces, gaps)
        is_open, is_near = (share > _ALONG for share in shares)
        chosen = "join" if is_open else "keep"
        if is_near:
            pieces = vertex_components(clean.faces, len(clean.positions))[0]
            doubts = [
                f"{pieces} pieces whose edges lie within {100 * options.join_gap:g} cm of each other are not "
                "sewn; give eslr fit --components join, or --components keep if they are apart"
            ]
    if chosen not in ("join", "largest"):
        return clean, {}, doubts
    if chosen == "join":
        step = repair.join_components(clean.positions, clean.faces, options.join_gap)
    else:
        step = repair.largest_component(clean.positions, clean.faces)
    if options.components == "auto" and undirected_edges(step.faces)[2].max() > 2:
        return clean, {}, doubts  # an edge of three pieces, such as a pocket's on a seam
    onward = np.append(step.vertex_map, -1)[clean.vertex_map]  # -1 stays -1
    left = vertex_components(step.faces, len(step.positions))[0]
    joined = dataclasses.replace(step, vertex_map=onward, face_source=clean.face_source[step.face_source])
    return joined, {"components_left": left}, []


def _turn(rows: np.ndarray, is_turned: np.ndarray) -> np.ndarray:
    """Reverse the corners of the marked rows."""
    result = rows.copy()
    result[is_turned] = rows[is_turned][:, ::-1]
    return result


def _lost_pins(mesh: MeshFile, options: FitOptions) -> list[str]:
    """Return a warning of pins of the file, whose vertices remeshing replaces; raise if a number names them."""
    counted = [text for text in options.pin if text.startswith("vertices:")]
    if counted:
        raise ConfigError(
            f"pin {counted[0]!r} counts vertices of the file, which edge_length replaces by others; name a part, "
            "a region or a loop"
        )
    if "none" in options.pin or mesh.is_pinned is None or not mesh.is_pinned.any():
        return []
    return [
        "the pins of the file are lost with edge_length, which replaces its vertices; name a part, a region or a "
        "loop"
    ]
