"""A report in words: what is good, and what a person would see as wrong."""

from __future__ import annotations

from typing import Any, NamedTuple

_STRETCH = 1.5  # of one face in a hundred, from which cloth looks stretched
_TORN = 2.0  # of a single face, from which it looks torn
_PENETRATION_MM = 5.0
_THROUGH_MM = 1.0  # of skin in front of cloth
_UNTANGLED_MM = 20.0  # behind other cloth, up to which self-contact pulls it back: `contact.crossing`
_SLID_M = 0.25
_LEFT = 0.75  # of the covered skin that cloth should still be near


class Words(NamedTuple):
    """Lines for a person."""

    good: list[str]
    warnings: list[str]


def describe_report(report: dict[str, Any]) -> Words:
    """Put a run's report into words.

    It has the values of `trajectory_report` and of `wear_report`, the `tolerance` that was asked for, and the
    share of frames within it, `within_tolerance`.
    """
    good, warnings = words = Words([], [])
    if report["error"] is not None:
        warnings.append(report["error"])
    if report["tolerance"] is not None:
        tolerance, late = 100 * report["tolerance"], 100 * (1 - report["within_tolerance"])
        if late:
            warnings.append(
                f"{late:.1f} % of the frames ended before they were within a gap of {tolerance:g} %"
            )
        else:
            good.append(f"within a gap of {tolerance:g} % on every frame")

    depth, through, pairs = (
        report[name] for name in ("penetration_max_mm", "skin_through_mm", "crossing_pairs")
    )
    if depth is not None and depth > _PENETRATION_MM:
        place = _where(report["worst_penetration"])
        warnings.append(f"cloth is up to {depth:.1f} mm inside the body, {place}")
    elif depth is not None:
        good.append(f"no vertex {f'deeper than {depth:.2g} mm ' if depth else ''}inside the body")
    if through is not None and through > _THROUGH_MM:
        share = f"{100 * report['skin_through_share']:.2f} % of the covered skin"
        place = _where(report["worst_skin_through"])
        warnings.append(f"skin shows through the cloth, by up to {through:.1f} mm, {place}; {share}")
    elif through is not None:
        good.append("no skin shows through the cloth")
    if pairs:
        share = f"in {100 * report['crossing_share']:.0f} % of the frames that were looked at"
        place = _where(report["worst_crossing"])
        warnings.append(f"cloth passes through cloth: {pairs} pairs of faces intersect, {place}; {share}")
    elif pairs is not None:
        good.append("no cloth passes through cloth")

    slide, frame, coverage = report["slide_m"], report["below_feet_at"], report["coverage"]
    if frame is not None:
        warnings.append(f"the garment fell off: in frame {frame} it is below the feet")
    elif slide > _SLID_M:
        place = _where(report["worst_slide"])
        warnings.append(f"the garment slid or fell: its centre is {slide:.2f} m from its place, {place}")
    elif coverage is not None and coverage < _LEFT:
        warnings.append(f"the garment left skin that it covered: {100 * (1 - coverage):.0f} % of it")
    else:
        good.append("the garment stays where it was put on")

    most, largest = report["p99_principal_stretch"], report["max_principal_stretch"]
    text = f"cloth is stretched by {100 * (most - 1):.0f} % (99 % of it), {100 * (largest - 1):.0f} % at most"
    if most > _STRETCH or largest > _TORN:
        warnings.append(f"{text}, {_where(report['worst_stretch'])}")
    else:
        good.append(text)
    return words


def describe_start(crossing: dict[str, Any] | None, *, is_put_on: bool) -> str | None:
    """Return a warning where cloth begins deeper behind cloth than self-contact pulls it back; else None.

    `crossing` is of `report.start_crossing`; `is_put_on`: the garment begins on the body's rest pose.
    """
    if crossing is None or crossing["depth_mm"] <= _UNTANGLED_MM:
        return None
    x, y, z = crossing["position_m"]
    place = _where(crossing["place"], "on the rest pose" if is_put_on else None)
    other = "begin with another frame (--start), lift the arms (--arm-abduction), or "
    return (
        f"cloth begins {crossing['depth_mm']:.0f} mm behind cloth that it passes through, at {x:.2f} {y:.2f} "
        f"{z:.2f} m, {place}, with {crossing['crossing_pairs']} pairs of faces. What is deeper than "
        f"{_UNTANGLED_MM:.0f} mm may stay: {'' if is_put_on else other}mend the garment there"
    )


def _where(place: dict[str, Any], moment: str | None = None) -> str:
    """Return a place as text; `moment` stands for its frame."""
    text = moment or f"frame {place['frame']} ({place['time_s']:.2f} s)"
    if place.get("part"):
        text += f", part {place['part']}"
    for key, word in (("vertex", "vertex"), ("body_vertex", "body vertex")):
        if key in place:
            text += f", {word} {place[key]}"
    return text
