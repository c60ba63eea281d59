"""Vertices that follow the body: chosen by number, part, region or open edge, or by default the waistband."""

from __future__ import annotations

import re

import numpy as np
from jaxtyping import Bool, Float, Int

from eslr_jax.errors import ConfigError
from eslr_jax.geometry.topology import boundary_loops

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


def select_vertices(
    text: str,
    positions: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    *,
    vertex_map: Int[np.ndarray, " source_vertices"],
    face_parts: Int[np.ndarray, " faces"] | None,
    part_names: tuple[str, ...],
) -> Bool[np.ndarray, " vertices"]:
    """Return a mask of the vertices that a pin names.

    Args:
        text: One of `PIN_FORMS` but none and waist. Vertices are counted from zero, as in the file. Regions are
            in the body's frame [m]: left is +x, up is +y, front is +z. Open edges are numbered by their number
            of vertices, most first, or named by the side on which their middle lies.
        positions: Vertex positions in the body's rest pose [m], shape [vertices, 3].
        faces: Triangles, shape [faces, 3].
        vertex_map: Vertex of every vertex of the file, shape [source_vertices]; -1 where it was dropped.
        face_parts: Part of every face, shape [faces], or None.
        part_names: Names of the parts.

    Raises:
        ConfigError: The form is unknown, or nothing has that name or number.
    """
    kind, _, rest = text.partition(":")
    chosen = np.zeros(len(positions), bool)
    if kind == "vertices":
        chosen[_numbered(text, rest, vertex_map)] = True
    elif kind == "part":
        if face_parts is None or rest not in part_names:
            raise ConfigError(
                f"pin {text!r}: there is no such part; parts: {', '.join(part_names) or 'none'}"
            )
        chosen[faces[face_parts == part_names.index(rest)]] = True
    elif kind == "region":
        chosen = _region(text, rest, positions)
    elif kind == "loop":
        chosen[_loop(text, rest, positions, faces)] = True
    else:
        raise ConfigError(f"pin {text!r} is not understood; write {PIN_FORMS}")
    if not chosen.any():
        raise ConfigError(f"pin {text!r} holds no vertex; the garment spans {_span(positions)}")
    return chosen


def _numbered(text: str, rest: str, vertex_map: np.ndarray) -> np.ndarray:
    """Return the vertices with the given numbers in the file."""
    try:
        numbers = np.array([int(word) for word in rest.split(",")])
    except ValueError as error:
        raise ConfigError(f"pin {text!r}: write whole numbers with commas between") from error
    if numbers.min() < 0 or numbers.max() >= len(vertex_map):
        raise ConfigError(f"pin {text!r}: the file has vertices 0 to {len(vertex_map) - 1}")
    found = vertex_map[numbers]
    return found[found >= 0]


def _region(text: str, rest: str, positions: np.ndarray) -> np.ndarray:
    """Return the vertices for which every comparison holds."""
    chosen = np.ones(len(positions), bool)
    for part in rest.split(","):
        match = _COMPARISON.fullmatch(part)
        if match is None:
            raise ConfigError(f"pin {text!r}: {part!r} is not a comparison such as y>0.2")
        values, limit = positions[:, "xyz".index(match[1])], float(match[3])
        chosen &= values > limit if match[2] == ">" else values < limit
    return chosen


def _loop(text: str, rest: str, positions: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the vertices of an open edge, given its number or side."""
    loops = boundary_loops(faces)
    if not loops:
        raise ConfigError(f"pin {text!r}: the garment has no open edge")
    if rest in _SIDES:
        axis, sign = _SIDES[rest]
        return max(loops, key=lambda loop: sign * positions[loop, axis].mean())
    if not rest.isdigit() or int(rest) >= len(loops):
        sides = ", ".join(_SIDES)
        raise ConfigError(f"pin {text!r}: there are open edges 0 to {len(loops) - 1}; or name one of {sides}")
    return loops[int(rest)]


def _span(positions: np.ndarray) -> str:
    """Describe the extent along every axis."""
    low, high = positions.min(axis=0), positions.max(axis=0)
    return ", ".join(f"{axis} {a:.2f} to {b:.2f} m" for axis, a, b in zip("xyz", low, high, strict=True))
