"""What was recognised and done, in words."""

from __future__ import annotations

from typing import Any


def describe_fit(report: dict[str, Any]) -> str:
    """Return a fit's report, of `GarmentFile.metadata["fit"]`, as a few lines."""
    place, mesh, inside = report["placement"], report["mesh"], report["penetration"]
    moved = ", ".join(f"{100 * value:.1f}" for value in place["moved_m"])
    arms = place["arms_below_horizontal_deg"]
    posed = "as the body rests" if arms is None else f"{arms:.0f} degrees down"
    lines = [
        f"recognised: {place['metres_per_unit']:g} m per unit, {place['up']} up, {place['front']} front, "
        f"arms {posed}; moved by ({moved}) cm",
        f"mesh: {mesh['source_vertices']} vertices, {mesh['welded_vertices']} welded, "
        f"{mesh['loose_vertices']} loose, {mesh['dropped_faces']} faces dropped, {mesh['turned_faces']} turned, "
        f"{mesh['components']} parts; now {mesh['vertices']} vertices, {mesh['faces']} faces",
    ]
    if inside:
        before, after = inside["before"], inside["after"]
        lines.append(
            f"inside the body: {before['inside']} vertices, {before['depth_max_mm']:.1f} mm deep, before; "
            f"{after['inside']}, {after['depth_max_mm']:.1f} mm, after; moved by at most "
            f"{inside['push_out']['moved_max_mm']:.1f} mm"
        )
    if report["pinned"]:
        lines.append(f"pinned: {report['pinned']} vertices")
    return "\n".join(lines)
