"""Load rigged bodies by name or by path."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from eslr_jax.assets.catalog import find_asset
from eslr_jax.assets.names import is_path
from eslr_jax.body.motion import shape_body
from eslr_jax.body.rig import make_body
from eslr_jax.errors import ConfigError
from eslr_jax.geometry.validate import validate_body
from eslr_jax.io.bundled import read_body
from eslr_jax.io.parsing import split_name
from eslr_jax.io.registry import find_reader
from eslr_jax.types import Body


def load_body(name: str | Path = "anny", *, units: str | None = None, betas: Sequence[float] = ()) -> Body:
    """Load a rigged body; warn if the unit of its file is a guess.

    Args:
        name: Name of a bundled body, or path of one: a SMPL, SMPL-H or SMPL-X model (.npz, .pkl), a skinned
            character (.gltf, .glb, .vrm), or an npz file in the bundled format. `FILE#MESH,MESH` picks
            the meshes of a character that make up the body.
        units: Unit of the file: m, dm, cm, mm, in, ft, or metres per unit; by default recognised.
        betas: Shape coefficients [standard deviations] of a body with shapes, such as a SMPL model.

    Raises:
        AssetError: There is no such body, the file is damaged, or its unit is unknown.
        ConfigError: The body has fewer shapes than betas, or a unit is given and it is always in metres.
        MissingExtraError: The file needs an extra that is not installed.
        MeshError: A body is inside out, or in the bundled format not closed.
    """
    body = _read_body(str(name), units)
    return shape_body(body, betas) if len(betas) else body


def _read_body(text: str, units: str | None) -> Body:
    """Return a body by name or file, in its average shape."""
    file, meshes = split_name(text)
    if is_path(text):
        found = find_reader("body", file)(file, meshes)
        name = Path(file).name
    else:
        found, name = read_body(find_asset("body", text)), text
    if not isinstance(found, Body):
        return make_body(found, units=units)
    if units is not None:
        raise ConfigError(f"body {text} is in metres; leave out its unit")
    return _closed(found, name)


def _closed(body: Body, name: str) -> Body:
    """Return the body if it has an inside; raise a MeshError if not."""
    positions, faces, is_obstacle = (
        np.asarray(leaf) for leaf in (body.rest_positions, body.faces, body.is_obstacle)
    )
    validate_body(positions, faces, is_obstacle, name=name)
    return body
