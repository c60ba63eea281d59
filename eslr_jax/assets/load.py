"""Load bodies, garments, motions and models by name or by path."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from eslr_jax.assets.catalog import asset_names, find_asset
from eslr_jax.body.motion import Motion
from eslr_jax.config import ModelConfig
from eslr_jax.errors import AssetError, MotionError
from eslr_jax.geometry.prepare import prepare_garment
from eslr_jax.geometry.skinning import transfer_skin_weights
from eslr_jax.geometry.validate import validate_mesh, validate_orientation
from eslr_jax.io.body import read_body
from eslr_jax.io.garment import read_garment_npz
from eslr_jax.io.mesh import read_mesh
from eslr_jax.io.motion import read_motion_archive
from eslr_jax.io.weights import read_weights
from eslr_jax.types import Body, Garment

Resolution = Literal["1k", "4k", "10k"]

_SKIN_SMOOTHING = 3  # Laplacian steps over transferred skin weights, as for the bundled shirts


def _is_path(name: str) -> bool:
    """Tell a path from a name: it has a separator or a suffix, or exists."""
    return "/" in name or "\\" in name or Path(name).suffix != "" or Path(name).exists()


def load_body(name: str | Path = "anny") -> Body:
    """Load a rigged body.

    Args:
        name: Name of a bundled body, or path of an npz file in its format.

    Raises:
        AssetError: There is no such body, or the file is damaged.
    """
    return read_body(name if _is_path(str(name)) else find_asset("body", str(name)))


def load_garment(
    name: str | Path = "tshirt",
    *,
    vertices: Resolution = "1k",
    body: Body | None = None,
    pad: bool = False,
    **options: Any,
) -> Garment:
    """Load a garment and prepare it for simulation.

    Args:
        name: Name of a bundled garment, or path of a mesh (obj, ply, stl, glb) in the body's rest pose, or of
            an npz file in the bundled format.
        vertices: Resolution of a bundled garment.
        body: Body whose skin weights a mesh file takes over; the bundled one by default.
        pad: Pad to a bucket of sizes, so that garments of similar size share one compiled rollout.
        options: Passed on to `prepare_garment`.

    Raises:
        AssetError: There is no such garment, or the file can't be read.
        MeshError: The mesh can't be simulated.
    """
    label = Path(name).name
    if _is_path(str(name)) and Path(name).suffix != ".npz":
        positions, faces = read_mesh(name)
        body = load_body() if body is None else body
        body_rest, body_faces = np.asarray(body.rest_positions), np.asarray(body.faces)
        validate_mesh(positions, faces, name=label)
        validate_orientation(positions, faces, body_rest, body_faces)
        weights, indices = transfer_skin_weights(
            positions,
            body_rest,
            body_faces,
            np.asarray(body.skin_weights),
            np.asarray(body.skin_indices),
            smoothing_steps=_SKIN_SMOOTHING,
            faces=faces,
        )
        is_pinned = None
    else:
        path = Path(name) if _is_path(str(name)) else find_asset("garment", f"{name}_{vertices}")
        stored = read_garment_npz(path)
        positions, faces, is_pinned = stored.rest_positions, stored.faces, stored.is_pinned
        weights, indices = stored.skin_weights, stored.skin_indices
    return prepare_garment(
        positions,
        faces,
        skin_weights=weights,
        skin_indices=indices,
        is_pinned=is_pinned,
        pad=pad,
        name=label,
        **options,
    )


@lru_cache(maxsize=4)
def _motion_archive(path: Path, modified: float):
    del modified  # part of the key: a changed file is read again
    return read_motion_archive(path)


def load_motion(name: str | Path = "cmu_016_32") -> Motion:
    """Load a motion.

    Args:
        name: Name of a bundled clip, or path of an npz archive with one clip, or `path#clip`.

    Raises:
        AssetError: There is no such motion, or the file is damaged.
        MotionError: The file holds no usable motion.
    """
    text = str(name)
    if _is_path(text):
        file, _, clip = text.partition("#")
        if not Path(file).exists():
            raise AssetError(f"motion file {file} doesn't exist; check the path")
        clips = _motion_archive(Path(file), Path(file).stat().st_mtime)
        if not clip and len(clips) > 1:
            raise MotionError(f"{file} holds {len(clips)} clips; name one, as in {file}#{next(iter(clips))}")
        clip = clip or next(iter(clips))
        if clip not in clips:
            raise MotionError(f"{file} has no clip {clip!r}; it has {', '.join(clips)}")
    else:
        path, clip = find_asset("motion", text), text
        clips = _motion_archive(path, path.stat().st_mtime)
    return Motion(clip, *clips[clip])


def load_model(name: str | Path) -> tuple[dict[str, Any], ModelConfig]:
    """Load a trained network.

    Args:
        name: Name of a bundled model, or path of an exported npz file.

    Returns:
        Its weights and its architecture.

    Raises:
        AssetError: There is no such model, or the file is damaged.
        CheckpointError: The file is for another architecture or a newer version.
    """
    path = Path(name) if _is_path(str(name)) else find_asset("model", str(name))
    params, config, _ = read_weights(path)
    return params, config


def default_model() -> str:
    """Return the name of the model that `eslr simulate` uses when none is named."""
    return asset_names("model")[0]
