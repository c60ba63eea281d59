"""Garments built by hand from rings of points: in metres, Y up, facing Z, the feet at the origin.

They are sized for the bundled body, which is 1.84 m tall, as its rest pose stands on the floor.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from cloth import grid_faces

Shape = tuple[np.ndarray, np.ndarray]  # positions [vertices, 3] [m], faces [faces, 3]


def rings(levels, around=48, rows=40) -> Shape:
    """Return an open tube through elliptic rings (height, half width, half depth, centre z), top first."""
    levels = np.array(levels, float)
    share = np.linspace(0, 1, rows)
    places = np.linspace(0, 1, len(levels))
    height, width, depth, center = (np.interp(share, places, column)[:, None] for column in levels.T)
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)[None]
    parts = [width * np.sin(angle), height + 0 * angle, center + depth * np.cos(angle)]
    return np.stack(parts, axis=-1).reshape(-1, 3), grid_faces(rows, around, is_closed=True)


def skirt(hem=0.60, flare=0.28) -> Shape:
    """A skirt from the waist, flared."""
    return rings([(1.10, 0.175, 0.12, 0.045), (0.96, 0.21, 0.15, 0.02), (hem, flare, 0.75 * flare, 0.03)])


def tube_dress() -> Shape:
    """A dress without straps, from the armpits to the knees."""
    upper = [(1.36, 0.185, 0.13, 0.05), (1.16, 0.17, 0.125, 0.05)]
    return rings([*upper, (0.94, 0.215, 0.14, 0.02), (0.55, 0.24, 0.18, 0.03)], rows=50)


def poncho() -> Shape:
    """A cone with a hole for the neck, over shoulders and arms."""
    return rings([(1.60, 0.12, 0.12, 0.03), (1.54, 0.24, 0.17, 0.03), (0.95, 0.78, 0.60, 0.03)], around=64)


def cape(rows=36, columns=40) -> Shape:
    """A sheet that lies on the shoulders and hangs behind the back, open in front."""
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, columns)[None]
    share = np.linspace(0, 1, rows)[:, None]
    height = np.interp(share, [0, 0.15, 1], [1.575, 1.50, 0.60])
    width = np.interp(share, [0, 0.15, 1], [0.11, 0.22, 0.30])
    depth = np.interp(share, [0, 0.15, 1], [0.07, 0.14, 0.20])
    positions = np.stack([width * np.sin(angle), height + 0 * angle, 0.02 - depth * np.cos(angle)], axis=-1)
    return positions.reshape(-1, 3), grid_faces(rows, columns)[:, ::-1]


def shorts(hem=0.66, waist=1.10, spacing=0.02) -> Shape:
    """Two leg tubes that meet in a seam at the crotch, and one tube from there to the waist."""
    crotch, outside, inside = 0.80, 26, 10
    bend = np.linspace(0, np.pi, outside)  # from the front over the left side to the back
    seam = np.zeros((outside + inside, 3))
    seam[:outside] = np.stack([0.205 * np.sin(bend), 0 * bend, 0.03 + 0.15 * np.cos(bend)], axis=1)
    seam[outside:, 2] = np.linspace(-0.12, 0.18, inside + 2)[1:-1]
    spread = np.pi / 3
    inner = np.linspace(np.pi + spread, 2 * np.pi - spread, inside + 2)[1:-1]
    bend = np.concatenate([np.linspace(-spread, np.pi + spread, outside), inner])
    center = 0.115 + 0.09 * (0.98 - hem)  # the bundled body stands with its feet apart
    cuff = np.stack([center + 0.11 * np.sin(bend), 0 * bend, 0.03 + 0.13 * np.cos(bend)], axis=1)
    left = _loft(seam, cuff, crotch, hem, spacing)
    left[1:, :, 0] = np.maximum(left[1:, :, 0], 0.006)
    legs = grid_faces(*left.shape[:2], is_closed=True)
    around = np.concatenate([seam[:outside], seam[outside - 2 : 0 : -1] * [-1, 1, 1]])
    bend = np.linspace(0, 2 * np.pi, len(around), endpoint=False)
    band = np.stack([0.178 * np.sin(bend), 0 * bend, 0.045 + 0.122 * np.cos(bend)], axis=1)
    trunk = _loft(band, around, waist, crotch, spacing)
    count = left[..., 0].size
    positions = np.concatenate([part.reshape(-1, 3) for part in (left, left * [-1, 1, 1], trunk)])
    faces = [legs, legs[:, ::-1] + count, grid_faces(*trunk.shape[:2], is_closed=True) + 2 * count]
    mesh = trimesh.Trimesh(positions, np.concatenate(faces), process=False)
    mesh.merge_vertices(digits_vertex=7)
    return np.array(mesh.vertices), np.array(mesh.faces)


def _loft(upper, lower, top, bottom, spacing) -> np.ndarray:
    """Return rows of points between two rings of as many points at two heights."""
    share = np.linspace(0, 1, max(4, round((top - bottom) / spacing)))[:, None, None]
    rows = (1 - share) * upper + share * lower
    rows[:, :, 1] = (top + share * (bottom - top))[:, :, 0]
    return rows


def trousers() -> Shape:
    """Long trousers."""
    return shorts(hem=0.12)


def write_obj(path: Path, shape: Shape, *, scale=1.0, axes=None) -> Path:
    """Write a shape as another program would: `axes` turns it, and `scale` is the units in a metre."""
    positions, faces = shape
    positions = scale * positions @ (np.eye(3) if axes is None else axes).T
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in positions]
    path.write_text("\n".join(lines + [f"f {a} {b} {c}" for a, b, c in faces + 1]) + "\n")
    return path
