"""Options of a fit; importing this module does no work, for the command line's sake."""

from __future__ import annotations

import dataclasses
from typing import Literal

Unit = Literal["auto", "m", "dm", "cm", "mm", "in", "ft"]
Axis = Literal["auto", "x", "y", "z", "-x", "-y", "-z"]
Scale = Literal["body", "girth", "none"]

WELD_TOLERANCE = 1e-5  # of the bounding box's diagonal: ten micrometres on a shirt, more than text rounds off
_JOIN_GAP = 0.01  # [m] across which parts are joined: a seam allowance


@dataclasses.dataclass(frozen=True)
class FitOptions:
    """Settings of a fit, which replace what is recognised from the mesh.

    Attributes:
        units: Unit of the file, or metres per unit.
        up: Axis of the file that points up.
        front: Axis of the file that the wearer faces.
        keep_place: Do not move the garment along the body: its origin is between the feet, or the body's own. If
            these are within 2 cm of each other, it is not moved at all. With units, up and front given, nothing
            is refused.
        arms: Recognise the pose of the arms that the garment was modelled in, or take the body's rest pose.
        components: Keep separate parts, join their open edges, keep the largest, or refuse them. By default parts
            are joined if their edges lie along each other, as pieces of a pattern whose seams were left open.
        join_gap: Distance across which parts are sewn together [m].
        weld: Distance within which vertices of open edges become one, relative to the garment's size.
        edge_length: Remesh to this mean edge length [m] (extra `remesh`).
        pin: Vertices that follow the body: none, waist, vertices:0,5,9, part:NAME, region:y>0.2,x<0.1,
            loop:NUMBER or loop:top|bottom|left|right|front|back. If not given, the pins in the file, or else the
            waistband of a garment that does not hang from the shoulders.
        push_out: Move vertices that lie inside the body out of it.
        scale: Of a garment that was made for another body: cut it anew for this one (body), change all its
            lengths by the ratio of the girths (girth), or keep them (none).
    """

    units: Unit | float = "auto"
    up: Axis = "auto"
    front: Axis = "auto"
    keep_place: bool = False
    arms: Literal["auto", "rest"] = "auto"
    components: Literal["auto", "keep", "join", "largest", "refuse"] = "auto"
    join_gap: float = _JOIN_GAP
    weld: float = WELD_TOLERANCE
    edge_length: float | None = None
    pin: tuple[str, ...] = ()
    push_out: bool = True
    scale: Scale = "body"
