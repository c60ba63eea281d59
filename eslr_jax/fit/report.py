"""The report of a fit in words, and what a large mesh will cost."""

from __future__ import annotations

from typing import Any

from eslr_jax.fit.clearance import MAX_DEPTH

LARGE = 30_000  # vertices from which the cost is told before it is paid


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
