"""What a fitted garment's file tells: how it was fitted, in words, and to which body (host)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from eslr_jax.errors import AssetError, MeshError
from eslr_jax.pipeline.dressing.clearance import MAX_DEPTH
from eslr_jax.pipeline.formats.garment import GarmentFile
from eslr_jax.types import Body

LARGE = 30_000  # vertices from which the cost is told before it is paid
_SAME_JOINT = 1e-3  # [m] by which a joint of one body may differ, read from two files
_REMEDY = "give the mesh or the bundled garment that it was made from, which is put on this body"


def describe_fit(report: dict[str, Any]) -> str:
    """Return the report in `GarmentFile.metadata["fit"]` as a few lines."""
    if "pinned_by" not in report:
        return "fitted by an older version; fit the mesh again for a report"
    place, mesh, inside = report["placement"], report["mesh"], report["penetration"]
    moved = ", ".join(f"{100 * value:.1f}" for value in place["moved_m"])
    arms = place["arms_below_horizontal_deg"]
    posed = "as the body rests" if arms is None else f"{arms:.0f} degrees down"
    lines = [
        f"recognised: {place['what']}, arms {posed}; moved by ({moved}) cm; confidence {place['confidence']:.0%}",
        f"mesh: {mesh['source_vertices']} vertices, {mesh['welded_vertices']} welded, "
        f"{mesh['loose_vertices']} loose, {mesh['dropped_faces']} faces dropped, {mesh['turned_faces']} turned, "
        f"{mesh['components']} pieces; now {mesh['vertices']} vertices, {mesh['faces']} faces",
    ]
    if "components_left" in mesh:
        lines.append(f"pieces: {mesh['components']}, of which {mesh['components_left']} are left")
    if inside:
        before, after = inside["before"], inside["after"]
        lines.append(
            f"inside the body: {before['inside']} vertices, {before['depth_max_mm']:.1f} mm deep, before; "
            f"{after['inside']}, {after['depth_max_mm']:.1f} mm, after; moved by at most "
            f"{inside['push_out']['moved_max_mm']:.1f} mm"
        )
        if after.get("deeper"):  # older files lack it
            lines.append(
                f"deeper than {1e3 * MAX_DEPTH:.0f} mm inside: {after['deeper']} vertices, which stay there"
            )
    if "transfer" in report:
        lines.append(f"carried to the body: {describe_transfer(report['transfer'])}")
    lines.append(f"pinned: {report['pinned']} vertices ({report['pinned_by']})")
    return "\n".join([*lines, *(f"warning: {text}" for text in report["warnings"])])


def describe_sewing(report: dict[str, Any]) -> str:
    """Return the report in `GarmentFile.metadata["sewing"]` as a few lines."""
    return "\n".join(
        [
            f"sewn: {report['panels']} panels along {len(report['seams'])} seams, all closed; "
            f"{report['vertices']} vertices, {report['faces']} faces",
            f"before it settles: 99 % of it stretches by less than {report['p99_principal_stretch']:.2f}; "
            f"{report['crossing_pairs']} pairs of faces cross, {report['inside']} vertices are inside the body",
            f"pinned: {report['pinned']} vertices ({report['pinned_by']})",
            *(f"warning: {text}" for text in report["warnings"]),
        ]
    )


def describe_transfer(report: dict[str, Any]) -> str:
    """Return what a transfer did as one line, without the names of garment and body."""
    cut = {
        "body": "cut anew for it",
        "girth": "all lengths scaled by its girth",
        "none": "lengths kept as they were",
    }[report["scale"]]
    return f"{cut}; its girth is {report['girth']:.2f} and its length {report['length']:.2f} of what it was"


def describe_cost(num_vertices: int) -> str | None:
    """Return what a garment of this size costs, or None if it is not large.

    Times are of two CPU cores: a fit takes about 0.3 ms a vertex, a frame of the solver about 0.05 ms an
    iteration and thousand vertices.
    """
    if num_vertices < LARGE:
        return None
    return (
        f"{num_vertices:,} vertices are many: fitting takes about {num_vertices * 3e-4:.0f} s, and every frame "
        f"about {num_vertices / 1000:.0f} times as long as with 1,000; eslr fit --edge-length 0.01 gives "
        "about 10,000 for a shirt"
    )


def wearer_entry(body: Body) -> dict[str, Any]:
    """Return the entry of a garment's metadata that tells its body: the joints, and where they rest [m]."""
    joints = np.asarray(body.joint_rest_positions, np.float64).round(5).tolist()
    return {"body": {"joint_names": list(body.joint_names), "joint_rest_positions": joints}}


def check_wearer(garment: GarmentFile, body: Body, name: str) -> None:
    """Check that a garment was fitted to this body; a file that tells no body passes.

    Raises:
        MeshError: It was fitted to another body: one with other joints, or of another shape.
        AssetError: What the file tells of its body is damaged.
    """
    if "body" not in garment.metadata:
        return
    names, joints = _joints(garment, name)
    own = list(body.joint_names)
    if names != own:
        strangers = [joint for joint in (*names, *own) if (joint in names) != (joint in own)]
        which = ", ".join(strangers[:3]) or "in another order"
        raise MeshError(f"{name} was fitted to another body, with other joints ({which}); {_REMEDY}")
    away = np.linalg.norm(joints - np.asarray(body.joint_rest_positions), axis=1)
    if away.max(initial=0.0) > _SAME_JOINT:
        joint = int(away.argmax())
        raise MeshError(
            f"{name} was fitted to another body, of another shape (its joint {own[joint]} is "
            f"{1e3 * away[joint]:.0f} mm away); give the shape that it was fitted to, or {_REMEDY}"
        )


def common_wearer(garments: Sequence[GarmentFile], names: Sequence[str]) -> dict[str, Any]:
    """Return the entry of an outfit's metadata that tells its body; empty if no garment has one.

    Raises:
        MeshError: Two garments were fitted to different bodies.
        AssetError: What a garment tells of its body is damaged.
    """
    known = [pair for pair in zip(garments, names, strict=True) if "body" in pair[0].metadata]
    if not known:
        return {}
    own, places = _joints(*known[0])
    for garment, name in known[1:]:
        theirs, others = _joints(garment, name)
        if own != theirs or np.linalg.norm(places - others, axis=1).max(initial=0.0) > _SAME_JOINT:
            raise MeshError(f"{name} was fitted to another body than {known[0][1]}; fit both to the same one")
    return {"body": known[0][0].metadata["body"]}


def _joints(garment: GarmentFile, name: str) -> tuple[list[str], np.ndarray]:
    """Return the names of a garment's joints, and where they rest [m], shape [joints, 3]."""
    try:
        entry = garment.metadata["body"]
        names = [str(joint) for joint in entry["joint_names"]]
        joints = np.array(entry["joint_rest_positions"], np.float64)
        if joints.shape != (len(names), 3) or not np.isfinite(joints).all():
            raise ValueError(joints.shape)
    except (KeyError, TypeError, ValueError) as error:
        raise AssetError(f"garment file {name} has damaged metadata; fit the garment again") from error
    return names, joints
