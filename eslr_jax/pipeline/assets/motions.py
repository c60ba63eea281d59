"""Load bodies and motions by name or by path."""

from __future__ import annotations

import dataclasses
import json
import warnings
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Literal

import numpy as np

from eslr_jax.errors import AssetError, ConfigError, MotionError
from eslr_jax.files.npz import read_arrays
from eslr_jax.files.parsing import parsing, split_name
from eslr_jax.mesh.validate import validate_body
from eslr_jax.pipeline.assets.catalog import find_asset, is_path
from eslr_jax.pipeline.formats.bundled import pick_clip, read_body, read_motion_archive
from eslr_jax.pipeline.formats.gltf_rig import GLTF_SUFFIXES, gltf_clip_names
from eslr_jax.pipeline.formats.registry import find_reader
from eslr_jax.pipeline.rigs.procedural import PROCEDURAL, make_procedural
from eslr_jax.pipeline.rigs.rig import make_body, make_motion, skeleton_motion
from eslr_jax.pose.motion import Motion, shape_body
from eslr_jax.pose.skeleton import SkeletonMotion
from eslr_jax.pose.timing import skip_start_pose
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


DEFAULT_MOTION = "cmu_016_32"


def load_motion(
    name: str | Path = DEFAULT_MOTION,
    *,
    body: Body | None = None,
    joint_map: Mapping[str, str] | None = None,
    up: Literal["auto", "y", "z"] = "auto",
) -> Motion:
    """Load a motion, for the bundled body or carried over to another one.

    A T-pose before the motion of a file is skipped with a warning.

    Args:
        name: Name of a bundled clip, or turn, jump or swing, which are computed; or path of a motion: .bvh,
            AMASS (.npz), HOOD or VTO (.pkl), an animated character (.gltf, .glb, .vrm), or an archive in
            the bundled format. `FILE#CLIP` picks one of several clips.
        body: The body that is to move; the bundled one by default.
        joint_map: Changes to the map from the body's joints to the motion's; "" keeps a joint still.
        up: Axis that points up in a BVH file or one of SMPL; by default the one along which the figure stands.

    Raises:
        AssetError: There is no such motion, or the file is damaged.
        MotionError: The file holds no usable motion, or none that this body can follow; or `up` is given for
            another format.
        MissingExtraError: The file needs an extra that is not installed.
    """
    text = str(name)
    file, clip = split_name(text)
    has_up = Path(file).suffix.lower() not in (".bvh", ".npz", ".pkl") or _is_archived(text)
    if up != "auto" and has_up:
        raise MotionError(
            f"motion {text} has its own up axis, which only BVH and SMPL's motions lack; leave out --motion-up"
        )
    if text in PROCEDURAL:
        if joint_map:
            raise MotionError(f"{text} is computed from the body's own joints; leave out the map of joints")
        return make_procedural(text, load_body() if body is None else body)
    if _is_archived(text):
        motion = _bundled_motion(text)
        if body is None or (_is_made_for(motion, body, is_bundled=not is_path(text)) and not joint_map):
            return motion
        # An archive holds no skeleton, so that of the bundled body is used.
        return make_motion(skeleton_motion(motion, load_body()), body, joint_map=joint_map)
    whole = find_reader("motion", file)(file, clip)
    source, skipped = skip_start_pose(whole)
    if skipped:
        warnings.warn(skipped, stacklevel=2)
    motion = make_motion(
        source, load_body() if body is None else body, joint_map=joint_map, up="y" if has_up else up
    )
    return dataclasses.replace(motion, start=(len(whole.positions) - len(source.positions)) / source.fps)


def own_motion(body: str) -> str:
    """Return the animation in a body's file, or a bundled walk if it has none."""
    file, _ = split_name(body)
    suffix = Path(file).suffix.lower()
    if suffix in GLTF_SUFFIXES and gltf_clip_names(file):
        return file
    return DEFAULT_MOTION


def moving_skeleton(name: str) -> SkeletonMotion:
    """Return the moving skeleton whose joints a body follows in a motion.

    A bundled clip, and an archive in its format, holds no skeleton: it is for that of the bundled body. A motion
    that is computed for every body has none, and is refused; the rest is as of `load_motion`.
    """
    if name in PROCEDURAL:
        raise MotionError(f"motion {name} is computed on the joints of any body; it needs no joint map")
    if _is_archived(name):
        return skeleton_motion(_bundled_motion(name), load_body())
    file, clip = split_name(name)
    return find_reader("motion", file)(file, clip)


def read_joint_map(path: str | Path) -> dict[str, str]:
    """Read a joint map: a JSON object from joints of the body to joints of the motion, "" for a still one.

    Raises:
        AssetError: The file is missing or holds something else.
    """
    with parsing(path, "joint map", max_bytes=1 << 22) as file:
        values = json.loads(file.read_text(encoding="utf-8-sig"))
    if not isinstance(values, dict) or not all(isinstance(value, str) for value in values.values()):
        raise AssetError(
            f'joint map {path} is no JSON object of names; write it like {{"LeftArm": "left_shoulder"}}'
        )
    return values


def _is_archived(text: str) -> bool:
    """Tell a clip of the bundled format, by its name or in a user's archive, from a motion with its skeleton."""
    if not is_path(text):
        return True
    file, _ = split_name(text)
    if Path(file).suffix.lower() != ".npz":
        return False
    return "joint_names" in read_arrays(file, content="motion", names=("joint_names",))  # not of AMASS


def _is_made_for(motion: Motion, body: Body, *, is_bundled: bool) -> bool:
    """Tell whether a clip can move this body without retargeting; a user's archive by its joint names."""
    if motion.joint_names != body.joint_names:
        return False
    rest = np.asarray(body.joint_rest_positions)
    return not is_bundled or np.allclose(rest, np.asarray(load_body().joint_rest_positions), atol=1e-4)


def _bundled_motion(text: str) -> Motion:
    """Load a clip by name, or from an archive in the bundled format."""
    if not is_path(text):
        return _bundled_clips(find_asset("motion", text))[text]
    file, clip = split_name(text)
    clips = read_motion_archive(file)
    return clips[pick_clip(file, list(clips), clip)]


_bundled_clips = lru_cache(maxsize=4)(read_motion_archive)  # several of a file are loaded one after the other
