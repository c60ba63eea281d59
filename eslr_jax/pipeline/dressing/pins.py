"""Vertices that follow the body: those of the file, those that a user names, or what holds the garment up.

What does not hang from the shoulders is held by its waistband, and a cape by its neckline.
"""

from __future__ import annotations

import dataclasses
import re

import numpy as np
from jaxtyping import Bool
from scipy.spatial import KDTree

from eslr_jax.errors import ConfigError
from eslr_jax.mesh.topology import boundary_loops, vertex_components
from eslr_jax.pipeline.dressing.postures import body_middle, shoulder_height
from eslr_jax.pipeline.formats.garment import GarmentFile
from eslr_jax.pipeline.formats.mesh import Faces, Positions
from eslr_jax.types import Body

WAISTBAND = 0.03  # [m] width of the band below the loop that is held, as an elastic waistband
_OPEN = np.deg2rad(150.0)  # a gap in the cloth around the neck, from which on it slips off the shoulders
_CROTCH = 0.45  # of the body's height: a loop below it goes around legs
_PART_SHARE = 0.02  # of the vertices; a smaller part is a button or a label
_COMPARISON = re.compile(r"\s*([xyz])\s*([<>])\s*(-?(?:\d+\.?\d*|\.\d+)(?:e-?\d+)?)\s*")
_SIDES = {
    "top": (1, 1),
    "bottom": (1, -1),
    "left": (0, 1),
    "right": (0, -1),
    "front": (2, 1),
    "back": (2, -1),
}
PIN_FORMS = (
    "none, waist, vertices:0,5,9, part:NAME, region:y>0.2,x<0.1, loop:NUMBER or "
    "loop:top|bottom|left|right|front|back"
)


@dataclasses.dataclass(frozen=True)
class Waist:
    """What holds a garment up."""

    is_held: Bool[np.ndarray, " vertices"]  # vertices of waistbands and open necklines
    reason: str  # why they are held, or why nothing is
    is_falling: bool  # a part hangs neither from the shoulders nor from a waistband


def choose_pins(
    texts: tuple[str, ...], garment: GarmentFile, body: Body
) -> tuple[Bool[np.ndarray, " vertices"], str, list[str]]:
    """Return the vertices to pin, where the pins come from, and a warning if nothing holds the garment.

    Pins are written as `PIN_FORMS` has them; without any, those that the garment has hold, of its file, or else
    what holds it up in the body's rest pose.

    Raises:
        ConfigError: A pin is unknown, or it contradicts another.
    """
    waist = find_waist(garment.rest_positions, garment.faces, body)
    file_pins, is_pinned = garment.is_pinned, garment.is_pinned.copy()
    if "none" in texts:
        if len(texts) > 1:
            raise ConfigError("pin 'none' holds nothing; leave out the other pins")
        is_pinned[:], pinned_by = False, "--pin none"
    elif texts:
        if "waist" in texts and not waist.is_held.any():
            raise ConfigError(f"pin 'waist' holds no vertex: {waist.reason}")
        for text in texts:
            is_pinned |= waist.is_held if text == "waist" else select_vertices(text, garment)
        pinned_by = f"--pin {' '.join(texts)}{' and the file' if file_pins.any() else ''}"
    elif file_pins.any():
        pinned_by = "the file"
    else:
        is_pinned, pinned_by = waist.is_held, waist.reason
    falls = (waist.is_held.any() or waist.is_falling) and not is_pinned.any()
    remedy = "give eslr fit --pin, such as --pin loop:top, or --components join to sew its parts together"
    return is_pinned, pinned_by, [f"nothing holds the garment up: {waist.reason}; {remedy}"] if falls else []


def select_vertices(text: str, garment: GarmentFile) -> Bool[np.ndarray, " vertices"]:
    """Return a mask of the vertices that a pin names, one of `PIN_FORMS` but none and waist.

    Vertices are counted from zero, as in the garment's source. Regions are in the body's frame [m]: left is +x,
    up is +y, front is +z. Open edges are numbered by their number of vertices, most first, or named by the side
    on which their middle lies.

    Raises:
        ConfigError: The form is unknown, or nothing has that name or number.
    """
    kind, _, rest = text.partition(":")
    positions, faces, part_names = garment.rest_positions, garment.faces, garment.part_names
    chosen = np.zeros(len(positions), bool)
    if kind == "vertices":
        try:
            numbers = np.array([int(word) for word in rest.split(",")])
        except ValueError as error:
            raise ConfigError(f"pin {text!r}: write whole numbers with commas between") from error
        vertex_map = np.arange(len(positions)) if garment.vertex_map is None else garment.vertex_map
        if numbers.min() < 0 or numbers.max() >= len(vertex_map):
            raise ConfigError(f"pin {text!r}: the file has vertices 0 to {len(vertex_map) - 1}")
        found = vertex_map[numbers]
        chosen[found[found >= 0]] = True
    elif kind == "part":
        if garment.face_parts is None or rest not in part_names:
            raise ConfigError(
                f"pin {text!r}: there is no such part; parts: {', '.join(part_names) or 'none'}"
            )
        chosen[faces[garment.face_parts == part_names.index(rest)]] = True
    elif kind == "region":
        chosen[:] = True
        for part in rest.split(","):
            match = _COMPARISON.fullmatch(part)
            if match is None:
                raise ConfigError(f"pin {text!r}: {part!r} is not a comparison such as y>0.2")
            values, limit = positions[:, "xyz".index(match[1])], float(match[3])
            chosen &= values > limit if match[2] == ">" else values < limit
    elif kind == "loop":
        chosen[_loop(text, rest, positions, boundary_loops(faces))] = True
    else:
        raise ConfigError(f"pin {text!r} is not understood; write {PIN_FORMS}")
    if not chosen.any():
        spans = zip("xyz", positions.min(axis=0), positions.max(axis=0), strict=True)
        extent = ", ".join(f"{axis} {low:.2f} to {high:.2f} m" for axis, low, high in spans)
        raise ConfigError(f"pin {text!r} holds no vertex; the garment spans {extent}")
    return chosen


def _loop(text: str, rest: str, positions: np.ndarray, loops: list[np.ndarray]) -> np.ndarray:
    """Return the vertices of an open edge, given its number or side."""
    if not loops:
        raise ConfigError(f"pin {text!r}: the garment has no open edge")
    if rest in _SIDES:
        axis, sign = _SIDES[rest]
        return max(loops, key=lambda loop: sign * positions[loop, axis].mean())
    if not rest.isdigit() or int(rest) >= len(loops):
        sides = ", ".join(_SIDES)
        raise ConfigError(f"pin {text!r}: there are open edges 0 to {len(loops) - 1}; or name one of {sides}")
    return loops[int(rest)]


def find_waist(positions: Positions, faces: Faces, body: Body) -> Waist:
    """Find what holds up the parts of a garment in the body's rest pose.

    A part that reaches above the shoulder joints hangs from them, unless it leaves more than 150 degrees around
    the neck open, as a cape does: its upper 3 cm are then held, as by a clasp. The others have a waistband:
    their highest boundary loop around the trunk, and the cloth up to 3 cm from it.
    """
    shoulders = shoulder_height(body)
    count, component = vertex_components(faces, len(positions))
    loops = [loop for loop in boundary_loops(faces) if _is_around_trunk(positions[loop], body)]
    is_held, falling, is_open, heights = np.zeros(len(positions), bool), False, False, []
    for part in range(count):
        own = np.flatnonzero(component == part)
        top = positions[own, 1].max()
        if len(own) < _PART_SHARE * len(positions):
            continue
        if top > shoulders:
            over = positions[own[positions[own, 1] > shoulders]]
            angle = np.sort(_angles(over, body, shoulders))
            if np.diff(np.append(angle, angle[0] + 2 * np.pi)).max() > _OPEN:
                is_held[own[positions[own, 1] > top - WAISTBAND]] = is_open = True
            continue
        around = [loop for loop in loops if component[loop[0]] == part]
        if not around:
            falling = True
            continue
        loop = max(around, key=lambda ring: positions[ring, 1].mean())
        gaps, _ = KDTree(positions[loop]).query(positions[own])
        is_held[own[gaps <= WAISTBAND]] = True
        heights.append(float(positions[loop, 1].mean()) - float(np.asarray(body.rest_positions)[:, 1].min()))
    if heights:
        places = " and ".join(f"{height:.2f} m" for height in heights)
        reason = f"waistband at {places} above the floor, since no cloth reaches above the shoulder joints"
    elif is_open:
        reason = "neckline, since the cloth on the shoulders is open around the neck"
    elif falling:
        reason = "no cloth reaches above the shoulder joints, and no open edge goes around the trunk"
    else:
        reason = "it hangs from the shoulders"
    return Waist(is_held, reason, falling)


def _angles(points: np.ndarray, body: Body, height: float) -> np.ndarray:
    """Return where points are around the middle of the trunk at a height [rad]."""
    rest, middle = np.asarray(body.rest_positions, np.float64), body_middle(body)
    is_inner = np.abs(rest[:, 0] - middle[0]) < 0.1 * np.ptp(rest[:, 1])
    near = rest[(np.abs(rest[:, 1] - height) < 0.03) & is_inner]
    center = near.mean(axis=0) if len(near) else middle
    return np.arctan2(*(points - center)[:, [0, 2]].T)


def _is_around_trunk(ring: np.ndarray, body: Body) -> bool:
    """Tell whether a closed curve winds around the middle of the body above the crotch."""
    heights, height = np.asarray(body.rest_positions, np.float64)[:, 1], ring[:, 1].mean()
    if height < heights.min() + _CROTCH * np.ptp(heights):
        return False
    angle = _angles(ring, body, height)
    turns = np.diff(np.append(angle, angle[0]))
    return abs(np.sum((turns + np.pi) % (2 * np.pi) - np.pi)) > np.pi
