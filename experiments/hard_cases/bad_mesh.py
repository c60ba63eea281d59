"""The hard case of users' meshes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from eslr_jax.errors import MeshError
from hard_cases.build import Mesh, hanging_sheet, join_meshes, make_cloth, make_scene
from hard_cases.case import CaseScene, HardCase, Measure, Runs, Scenes
from hard_cases.measures import largest_stretch

_SIDE = 21  # vertices along the side of the sound cloth
_SIZE = 0.5  # [m], its side
_MIDDLE = _SIDE * 5 + 5  # a vertex inside it


def _bad_meshes() -> dict[str, Mesh]:
    """Return meshes that break simulators."""
    good = hanging_sheet(_SIDE, _SIDE, (_SIZE, _SIZE))
    positions, faces = good
    graded = positions.copy()
    spacing = 10 ** np.linspace(0, 1, _SIDE)[:-1]  # grows tenfold across the cloth
    x = np.concatenate([[0], np.cumsum(spacing)]) / spacing.sum() - 0.5
    graded[:, 0] = np.repeat(x, _SIDE) * _SIZE
    edge = faces[np.any(faces == _MIDDLE, axis=1)][0][:2]
    last = len(positions)  # number of the vertex that is added

    def with_vertex(vertex: int, offset: float, *more_faces: list[int]) -> Mesh:
        """Return the sound cloth with a vertex that lies before another one [m], and further faces."""
        added = positions[[vertex]] + np.array([0, 0, offset])
        return np.concatenate([positions, added]), np.concatenate([faces, *map(np.atleast_2d, more_faces)])

    two = join_meshes(good, (positions + np.array([0, 0, 0.1]), faces))
    return {
        "slivers of aspect 50": hanging_sheet(_SIDE, 11, (1e-3 * (_SIDE - 1), _SIZE)),  # 1 mm by 50 mm
        "spacing 1:10": (graded, faces),
        "two components": two,
        "two components, allowed": two,
        "duplicate vertices": with_vertex(0, 0.0, [last, 1, _SIDE]),
        "non-manifold edge": with_vertex(_MIDDLE, 0.02, [*edge, last]),
        "unreferenced vertex": with_vertex(0, 0.1),
        "12 vertices": hanging_sheet(3, 4, (0.3, 0.4)),
        "50k vertices": hanging_sheet(224, 224, (1.0, 1.0)),
    }


def _build_bad_mesh(options: Mapping[str, Any]) -> Scenes:
    scenes: Scenes = {}
    for label, mesh in _bad_meshes().items():
        upper = mesh[0][:, 1] > mesh[0][:, 1].max() - 1e-6
        allowed = label.endswith("allowed")
        try:
            garment = make_cloth(mesh, options, is_pinned=upper, allow_components=allowed)
        except MeshError as error:
            scenes[label] = error
            continue
        scenes[label] = CaseScene(make_scene(garment, mesh[0], 4 if len(mesh[0]) > 20_000 else 31))
    return scenes


def _measure_bad_mesh(runs: Runs) -> list[Measure]:
    return [Measure(f"{label}: accepted, stretch", largest_stretch(run), 1.25) for label, run in runs.items()]


BAD_MESH = HardCase(
    "bad_mesh",
    "users' meshes: each is simulated within bars, or refused with a named error",
    *(_build_bad_mesh, _measure_bad_mesh, "slivers of aspect 50"),
    may_refuse=True,
)
