"""How a garment sits: skin that shows through it, skin that it left, and how far it slid (host)."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import ArrayLike, Float, Int
from numpy.typing import NDArray

from eslr_jax.mesh.closest import nearest_places
from eslr_jax.mesh.topology import boundary_loops, is_on_boundary, vertex_normals
from eslr_jax.pipeline.report.report import Parts
from eslr_jax.types import BodyMotion, Garment

_EVERY = 10  # frames
_COVER = 0.03  # [m] under cloth up to which skin counts as covered
_NEAR = 0.1  # [m] from cloth up to which skin stays covered
_OWN = 0.05  # [m] from skin in the rest pose up to which cloth is its own; other cloth there is a fold
_POKING = 0.015  # [m] in front of cloth up to which skin pokes through it; farther off it is another limb
_ALIKE = 0.5  # cosine between the normals of skin and cloth up to which the cloth is a fold or another limb's
_VISIBLE = 1e-3  # [m] in front of the cloth from which skin counts as showing


def wear_report(
    positions: Float[ArrayLike, "frames vertices 3"],
    garment: Garment,
    skinned: Float[ArrayLike, "frames vertices 3"],
    poses: BodyMotion,
    *,
    parts: Parts = (None, ()),
) -> dict[str, Any]:
    """Measure how a garment sits on a moving body.

    Skin is covered if a face of the cloth lies at most 3 cm in front of it in the rest pose. Covered skin shows
    through if it is later in front of the nearest face. Three kinds of faces don't count: faces at a hem, since
    skin passes under them; faces that are turned away by more than 60 degrees, which are folds or cover another
    limb; and faces that are far from the skin in the rest pose. Every tenth frame and the last one are measured.
    `skinned` is the garment carried by the joints [m]. Where skin shows most, the cloth's part is named.

    Returns:
        Plain values: `coverage`, the least share of covered skin that cloth is still within 10 cm of;
        `skin_through_mm` and `skin_through_share` of the covered skin with `worst_skin_through`, its frame, time,
        body vertex and part; `slide_m`, the farthest that the garment's centre is from its skinned place, with
        `worst_slide`; `edge_slide_m`, likewise of the edge that slid most, such as the neck's or waist's, with
        `worst_edge_slide`: its frame and time, and its height above the soles at rest [m]. Edges that hang free
        at rest don't count. `below_feet_at`, the first frame in which all cloth is below the body, or None.
    """
    is_real = np.asarray(garment.vertex_mask)
    cloth, carried = np.asarray(positions)[:, is_real], np.asarray(skinned)[:, is_real]
    areas = np.asarray(garment.vertex_areas)[is_real]
    is_face = np.asarray(garment.rest_areas) > 0
    faces = np.asarray(garment.faces)[is_face]
    body, skin_faces = np.asarray(poses.positions), np.asarray(poses.faces)
    timestep = float(poses.timestep)
    slides = np.linalg.norm(np.average(cloth - carried, axis=1, weights=areas), axis=-1)
    is_below = cloth[..., 1].max(axis=1) < body[..., 1].min(axis=1)
    farthest = int(slides.argmax())
    result: dict[str, Any] = {
        "slide_m": float(slides[farthest]),
        "worst_slide": {"frame": farthest, "time_s": farthest * timestep},
        "below_feet_at": int(is_below.argmax()) if is_below.any() else None,
    }
    rest = np.asarray(garment.rest_positions)[is_real]
    unposed = np.asarray(poses.rest_positions)
    result |= {"edge_slide_m": 0.0, "worst_edge_slide": None}
    for loop in boundary_loops(faces):
        _, _, apart, _ = nearest_places(rest[loop], unposed, skin_faces, vertex_normals(unposed, skin_faces))
        away = np.linalg.norm((cloth - carried)[:, loop].mean(axis=1), axis=-1)
        frame = int(away.argmax())
        if np.linalg.norm(apart, axis=1).mean() < _COVER and away[frame] > result["edge_slide_m"]:
            height = float(rest[loop, 1].mean() - unposed[:, 1].min())
            place = {"frame": frame, "time_s": frame * timestep, "height_m": height}
            result |= {"edge_slide_m": float(away[frame]), "worst_edge_slide": place}
    skin = np.unique(skin_faces[np.asarray(poses.is_obstacle)])
    hem = is_on_boundary(faces, cloth.shape[1])
    side, distance, _ = _sides(unposed[skin], vertex_normals(unposed, skin_faces)[skin], rest, faces, hem)
    covered = skin[(side < 0) & (distance < _COVER)]
    if not len(covered):
        unknown = ("coverage", "skin_through_mm", "skin_through_share", "worst_skin_through")
        return result | dict.fromkeys(unknown)
    frames = sorted({*range(0, len(cloth), _EVERY), len(cloth) - 1})
    through, shares, fronts = [], [], []
    for frame in frames:
        outward = vertex_normals(body[frame], skin_faces)[covered]
        side, distance, nearest = _sides(body[frame, covered], outward, cloth[frame], faces, hem)
        is_own = np.linalg.norm(rest[faces[nearest]].mean(axis=1) - unposed[covered], axis=1) < _OWN
        through.append(np.where(is_own & (distance < _POKING), np.maximum(side, 0.0), 0.0))
        shares.append(float(np.mean(distance < _NEAR)))
        fronts.append(nearest)
    depth = np.stack(through)
    row, column = np.unravel_index(int(depth.argmax()), depth.shape)
    worst = None
    if depth.max() > 0:
        (owners, names), face = parts, np.flatnonzero(is_face)[fronts[row][column]]
        worst = {
            "frame": frames[row],
            "time_s": frames[row] * timestep,
            "body_vertex": int(covered[column]),
            "part": names[owners[face]] if owners is not None and names else None,
        }
    return result | {
        "coverage": min(shares),
        "skin_through_mm": float(depth.max() * 1e3),
        "skin_through_share": float(np.mean(depth > _VISIBLE)),
        "worst_skin_through": worst,
    }


def _sides(
    points: NDArray, outward: NDArray, positions: NDArray, faces: Int[np.ndarray, "faces 3"], hem: NDArray
) -> tuple[NDArray, NDArray, NDArray]:
    """Return how far skin is in front of cloth [m], negative behind it, its distance [m], and the nearest face.

    How far it is in front is measured along the normals of skin and cloth, and the smaller value counts: skin
    beside a fold is distant, but not in front. The value is zero at a hem, where the two measures differ in sign,
    and where skin and cloth face different ways.
    """
    nearest, _, offset, normals = nearest_places(points, positions, faces, vertex_normals(positions, faces))
    distance = np.linalg.norm(offset, axis=1)
    is_other = hem[faces[nearest]].any(axis=1) | (np.einsum("px,px->p", outward, normals) <= _ALIKE)
    along = np.stack([np.einsum("px,px->p", offset, axis) for axis in (outward, normals)])
    is_other |= along.prod(axis=0) <= 0
    return np.where(is_other, 0.0, np.sign(along[0]) * np.abs(along).min(axis=0)), distance, nearest
