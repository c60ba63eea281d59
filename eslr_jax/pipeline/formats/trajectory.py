"""Read and write the trajectory of a garment, with the body that it moved on, as one npz file.

Layout, in SI units, Y up, float32: `format`, `metadata` (JSON text), `timestep`, `positions`, `velocities`
[frames, vertices, 3] and `faces` [faces, 3]. Optional parts, whole or absent:

- `friction_loads` [frames, vertices], and `residuals` [frames];
- the body: `body_positions` [frames, body_vertices, 3], `body_faces` and `body_rest_positions`;
- the body's skin: `body_skin_weights`, `body_skin_indices`, `body_joint_transforms`, ...
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from eslr_jax.errors import AssetError
from eslr_jax.files.npz import check_layout, read_arrays, write_arrays
from eslr_jax.pipeline.formats.animated import MESH_LAYOUT, AnimatedMesh, Skin
from eslr_jax.pipeline.formats.palette import SKIN_COLOR

FORMAT = "eslr-trajectory-3"
_REQUIRED = ("format", "positions", "velocities", "faces", "timestep", "metadata")
# Fields of the body and of its skin -> arrays.
_BODY = {name: f"body_{name}" for name in ("positions", "faces", "rest_positions")}
_SKIN = {field.name: f"body_{field.name}" for field in dataclasses.fields(Skin)}
_LAYOUT = {
    "timestep": ("f", ""),
    **{name: MESH_LAYOUT[name] for name in ("positions", "velocities", "faces")},
    "friction_loads": ("f", "frames vertices"),
    "residuals": ("f", "frames"),
}
_LAYOUT |= {  # the body has other vertices and faces
    f"body_{name}": tuple(re.sub("vertices|faces", r"body_\g<0>", words) for words in layout)
    for name, layout in MESH_LAYOUT.items()
    if name in (*_BODY, *_SKIN)
}
_REMEDY = "write it again"


@dataclasses.dataclass(frozen=True)
class TrajectoryFile:
    """What a trajectory file holds."""

    positions: np.ndarray  # [frames, vertices, 3] [m]
    velocities: np.ndarray  # [frames, vertices, 3] [m/s]
    faces: np.ndarray  # [faces, 3]
    timestep: float  # time between frames [s]
    metadata: dict[str, Any] = dataclasses.field(default_factory=dict)  # garment, motion, ...: values of JSON
    body: AnimatedMesh | None = None  # with its rest positions
    friction_loads: np.ndarray | None = None  # [frames, vertices], normal force that friction acts with [N]
    residuals: np.ndarray | None = None  # [frames], force norm over weight that each frame ended with

    @property
    def num_frames(self) -> int:
        """Number of frames, the first one included."""
        return len(self.positions)


def write_trajectory(path: str | Path, trajectory: TrajectoryFile) -> None:
    """Write a trajectory, atomically.

    Raises:
        AssetError: The arrays disagree, the metadata is no JSON, or the file can't be written.
    """
    try:
        text = json.dumps(dict(trajectory.metadata), allow_nan=False)
    except (TypeError, ValueError) as error:
        raise AssetError(
            f"metadata of trajectory {path} can't be written as JSON: {error}; use plain values"
        ) from error
    arrays: dict[str, Any] = {
        "format": FORMAT,
        "metadata": text,
        "timestep": np.float64(trajectory.timestep),
        "positions": trajectory.positions,
        "velocities": trajectory.velocities,
        "faces": trajectory.faces,
    }
    for name in ("friction_loads", "residuals"):
        if (values := getattr(trajectory, name)) is not None:
            arrays[name] = values
    body = trajectory.body
    for part, names in ((body, _BODY), (None if body is None else body.skin, _SKIN)):
        if part is not None:
            arrays |= {name: getattr(part, field) for field, name in names.items()}
    result = {name: _stored(name, np.asarray(value)) for name, value in arrays.items()}
    _check(result, path)
    write_arrays(path, result)


def _stored(name: str, array: np.ndarray) -> np.ndarray:
    if name == "timestep" or array.dtype.kind not in "fiu":
        return array
    return array.astype(np.int32 if "i" in _LAYOUT.get(name, "f")[0] else np.float32)


def read_trajectory(path: str | Path) -> TrajectoryFile:
    """Read what `write_trajectory` wrote.

    Raises:
        AssetError: The file is missing, truncated, damaged, or no trajectory.
    """
    arrays = read_arrays(path, content="trajectory")
    _check(arrays, path)
    try:
        metadata = json.loads(str(arrays["metadata"]))
    except (ValueError, RecursionError) as error:
        raise AssetError(f"trajectory {path} has damaged metadata ({error}); {_REMEDY}") from error
    if not isinstance(metadata, dict):
        raise AssetError(f"trajectory {path} has metadata that is no table; {_REMEDY}")
    body = skin = None
    if "body_skin_weights" in arrays:
        values: dict[str, Any] = {field: arrays[name] for field, name in _SKIN.items()}
        values["parents"] = tuple(int(parent) for parent in values["parents"])
        values["joint_names"] = tuple(str(name) for name in values["joint_names"])
        skin = Skin(**values)
    if "body_positions" in arrays:
        values = {field: arrays[name] for field, name in _BODY.items()}
        body = AnimatedMesh("body", **values, color=SKIN_COLOR, skin=skin)
    track = (arrays["positions"], arrays["velocities"], arrays["faces"], float(arrays["timestep"]))
    return TrajectoryFile(*track, metadata, body, arrays.get("friction_loads"), arrays.get("residuals"))


def _check(arrays: Mapping[str, np.ndarray], path: str | Path) -> None:
    missing = [name for name in _REQUIRED if name not in arrays]
    if missing:
        raise AssetError(
            f"{path} is no trajectory: it has no {', '.join(missing)}; give a file that `eslr simulate` wrote"
        )
    if str(arrays["format"]) != FORMAT:
        raise AssetError(f"{path} has format {str(arrays['format'])[:40]!r}, not {FORMAT!r}; {_REMEDY}")
    for names in (_BODY, _SKIN):
        lost = [name for name in names.values() if name not in arrays]
        if 0 < len(lost) < len(names):
            raise AssetError(f"trajectory {path} lacks {', '.join(lost)} beside the rest; {_REMEDY}")
    if "body_skin_weights" in arrays and "body_positions" not in arrays:
        raise AssetError(f"trajectory {path} has the skin of a body that is not there; {_REMEDY}")
    check_layout(arrays, _LAYOUT, what=f"trajectory {path}", remedy=_REMEDY)
    if not len(arrays["positions"]) or not 0 < arrays["timestep"] < np.inf:
        raise AssetError(
            f"trajectory {path} has {len(arrays['positions'])} frames at a timestep of {arrays['timestep']} s; "
            "it needs one or more, and a positive timestep"
        )
