"""Load rigged bodies by name or by path."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from eslr_jax.errors import ConfigError
from eslr_jax.files.parsing import split_name
from eslr_jax.mesh.validate import validate_body
from eslr_jax.pipeline.assets.catalog import find_asset, is_path
from eslr_jax.pipeline.formats.bundled import read_body
from eslr_jax.pipeline.formats.registry import find_reader
from eslr_jax.pipeline.rigs.rig import make_body
from eslr_jax.pose.motion import shape_body
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
    text = str(name)
    file, meshes = split_name(text)
    found = find_reader("body", file)(file, meshes) if is_path(text) else read_body(find_asset("body", text))
    if not isinstance(found, Body):
        found = make_body(found, units=units)
    elif units is not None:
        raise ConfigError(f"body {text} is in metres; leave out its unit")
    else:
        rest, faces, is_obstacle = map(np.asarray, (found.rest_positions, found.faces, found.is_obstacle))
        validate_body(rest, faces, is_obstacle, name=Path(file).name)
    return shape_body(found, betas) if len(betas) else found
