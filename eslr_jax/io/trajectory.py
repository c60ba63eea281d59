"""A simulated garment with the body that it moved on, in one npz file.

Layout: `positions`, `velocities` [frames, vertices, 3], `faces` [faces, 3], `timestep`, `metadata` (JSON
text) and `format`; with a body also `body_positions` [frames, body_vertices, 3] and `body_faces`
[body_faces, 3], and what finding its contacts again takes: `body_rest_positions` [body_vertices, 3] and
`contact_faces` [contact_faces, 3], those of the body that were searched, and `contact_boundary` [boundary_vertices],
the body vertices where it goes on with others. SI units, Y up, float32.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from eslr_jax.errors import AssetError
from eslr_jax.io.npz import read_arrays, write_arrays

FORMAT = "eslr-trajectory-1"
_REQUIRED = ("format", "positions", "velocities", "faces", "timestep", "metadata")


@dataclasses.dataclass(frozen=True)
class TrajectoryFile:
    """What a trajectory file holds."""

    positions: np.ndarray  # [frames, vertices, 3], [m]
    velocities: np.ndarray  # [frames, vertices, 3], [m/s]
    faces: np.ndarray  # [faces, 3]
    body_positions: np.ndarray | None  # [frames, body_vertices, 3], [m]; None without a body
    body_faces: np.ndarray | None  # [body_faces, 3]
    timestep: float  # seconds between frames
    metadata: dict[str, Any]  # JSON-compatible: garment, motion, versions, ...
    body_rest_positions: np.ndarray | None = None  # [body_vertices, 3], [m]; None in files of older versions
    contact_faces: np.ndarray | None = None  # [contact_faces, 3], body faces in the cloth's reach; likewise
    contact_boundary: np.ndarray | None = (
        None  # [boundary_vertices], body vertices at their boundary; likewise
    )

    @property
    def num_frames(self) -> int:
        """Number of frames, the start included."""
        return self.positions.shape[0]


def write_trajectory(
    path: str | Path,
    *,
    positions: np.ndarray,
    velocities: np.ndarray,
    faces: np.ndarray,
    timestep: float,
    body_positions: np.ndarray | None = None,
    body_faces: np.ndarray | None = None,
    body_rest_positions: np.ndarray | None = None,
    contact_faces: np.ndarray | None = None,
    contact_boundary: np.ndarray | None = None,
    metadata: Mapping[str, Any] | None = None,
) -> None:
    """Write a trajectory, atomically.

    Args:
        path: The file, usually `*.npz`.
        positions: Garment vertex positions [m], shape [frames, vertices, 3].
        velocities: Garment vertex velocities [m/s], shape [frames, vertices, 3].
        faces: Garment triangles, shape [faces, 3].
        timestep: Time between frames [s].
        body_positions: Body vertex positions [m], shape [frames, body_vertices, 3]; None without a body.
        body_faces: Body triangles, shape [body_faces, 3].
        body_rest_positions: Body vertex positions at rest [m], shape [body_vertices, 3].
        contact_faces: Body triangles that the simulation searched for contacts, shape [contact_faces, 3].
        contact_boundary: Body vertices where the body goes on with other triangles, shape [boundary_vertices].
        metadata: Anything JSON can hold.

    Raises:
        AssetError: If the arrays disagree, the metadata is no JSON, or the file can't be written.
    """
    try:
        text = json.dumps(dict(metadata or {}), allow_nan=False)
    except (TypeError, ValueError) as error:
        raise AssetError(
            f"metadata of trajectory {path} can't be written as JSON: {error}; use plain values"
        ) from error
    arrays = {
        "format": np.array(FORMAT),
        "positions": np.asarray(positions, np.float32),
        "velocities": np.asarray(velocities, np.float32),
        "faces": np.asarray(faces, np.int32),
        "timestep": np.array(timestep, np.float64),
        "metadata": np.array(text),
    }
    if body_positions is not None:
        arrays["body_positions"] = np.asarray(body_positions, np.float32)
    if body_faces is not None:
        arrays["body_faces"] = np.asarray(body_faces, np.int32)
    if body_rest_positions is not None:
        arrays["body_rest_positions"] = np.asarray(body_rest_positions, np.float32)
    if contact_faces is not None:
        arrays["contact_faces"] = np.asarray(contact_faces, np.int32)
    if contact_boundary is not None:
        arrays["contact_boundary"] = np.asarray(contact_boundary, np.int32)
    _check(arrays, path)
    write_arrays(path, arrays)


def read_trajectory(path: str | Path) -> TrajectoryFile:
    """Read what `write_trajectory` wrote.

    Args:
        path: The file.

    Returns:
        Arrays, timestep and metadata.

    Raises:
        AssetError: If the file is missing, truncated, damaged, or no trajectory.
    """
    arrays = read_arrays(path, content="trajectory")
    _check(arrays, path)
    try:
        metadata = json.loads(str(arrays["metadata"]))
    except (ValueError, RecursionError) as error:
        raise AssetError(f"trajectory {path} has damaged metadata ({error}); write it again") from error
    if not isinstance(metadata, dict):
        raise AssetError(f"trajectory {path} has metadata that is no table; write it again")
    return TrajectoryFile(
        positions=arrays["positions"],
        velocities=arrays["velocities"],
        faces=arrays["faces"],
        body_positions=arrays.get("body_positions"),
        body_faces=arrays.get("body_faces"),
        timestep=float(arrays["timestep"]),
        metadata=metadata,
        body_rest_positions=arrays.get("body_rest_positions"),
        contact_faces=arrays.get("contact_faces"),
        contact_boundary=arrays.get("contact_boundary"),
    )


def _check(arrays: Mapping[str, np.ndarray], path: str | Path) -> None:
    """Raise AssetError unless the arrays form a trajectory."""
    missing = [name for name in _REQUIRED if name not in arrays]
    if missing:
        raise AssetError(
            f"{path} is no trajectory: it has no {', '.join(missing)}; give a file that `eslr simulate` wrote"
        )
    if str(arrays["format"]) != FORMAT:
        raise AssetError(f"{path} has format {str(arrays['format'])[:40]!r}, not {FORMAT!r}; write it again")
    if (
        arrays["timestep"].shape != ()
        or arrays["timestep"].dtype.kind != "f"
        or not 0 < arrays["timestep"] < np.inf
    ):
        raise AssetError(
            f"trajectory {path} has timestep {arrays['timestep']}; it must be a positive number of seconds"
        )
    _check_mesh(arrays, "positions", "faces", path)
    if arrays["velocities"].shape != arrays["positions"].shape or arrays["velocities"].dtype.kind != "f":
        raise AssetError(
            f"trajectory {path} has velocities of shape {arrays['velocities'].shape} for positions of shape "
            f"{arrays['positions'].shape}; they must agree"
        )
    if ("body_positions" in arrays) != ("body_faces" in arrays):
        raise AssetError(
            f"trajectory {path} has only one of body_positions and body_faces; give both or neither"
        )
    if "body_positions" in arrays:
        _check_mesh(arrays, "body_positions", "body_faces", path)
        if len(arrays["body_positions"]) != len(arrays["positions"]):
            raise AssetError(
                f"trajectory {path} has {len(arrays['positions'])} garment frames and "
                f"{len(arrays['body_positions'])} body frames; they must agree"
            )
    if ("body_rest_positions" in arrays) != ("contact_faces" in arrays):
        raise AssetError(
            f"trajectory {path} has only one of body_rest_positions and contact_faces; give both or neither"
        )
    if "contact_faces" in arrays:
        rest = arrays["body_rest_positions"]
        if "body_positions" not in arrays or rest.shape != arrays["body_positions"].shape[1:]:
            raise AssetError(
                f"trajectory {path} has body_rest_positions of shape {rest.shape}; they must be those of its body"
            )
        _check_mesh(
            {**arrays, "body_rest_positions": rest[None]}, "body_rest_positions", "contact_faces", path
        )
    boundary = arrays.get("contact_boundary")
    if boundary is not None and (boundary.ndim != 1 or boundary.dtype.kind not in "iu"):
        raise AssetError(
            f"trajectory {path} has contact_boundary of shape {boundary.shape} and type {boundary.dtype}; "
            "it must be [boundary_vertices] of integers"
        )


def _check_mesh(arrays: Mapping[str, np.ndarray], positions: str, faces: str, path: str | Path) -> None:
    """Raise AssetError unless two arrays form an animated triangle mesh."""
    points, triangles = arrays[positions], arrays[faces]
    if points.ndim != 3 or points.shape[0] == 0 or points.shape[2] != 3 or points.dtype.kind != "f":
        raise AssetError(
            f"trajectory {path} has {positions} of shape {points.shape} and type {points.dtype}; "
            "it must be [frames, vertices, 3] of floats"
        )
    if triangles.ndim != 2 or triangles.shape[1] != 3 or triangles.dtype.kind not in "iu":
        raise AssetError(
            f"trajectory {path} has {faces} of shape {triangles.shape} and type {triangles.dtype}; "
            "it must be [faces, 3] of integers"
        )
    if triangles.size and not (triangles.min() >= 0 and triangles.max() < points.shape[1]):
        raise AssetError(
            f"trajectory {path} has {faces} that name vertex {triangles.max()} or {triangles.min()} "
            f"of {points.shape[1]}; write it again"
        )
