"""Load bodies, garments, motions and models by name or by path."""

from __future__ import annotations

import dataclasses
import re
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from eslr_jax.assets.cache import cached_arrays, content_key
from eslr_jax.assets.catalog import find_asset
from eslr_jax.body.motion import Motion, shape_body
from eslr_jax.body.procedural import PROCEDURAL, make_procedural
from eslr_jax.body.rig import make_body, make_motion, skeleton_motion
from eslr_jax.body.timing import skip_start_pose
from eslr_jax.config import ModelConfig
from eslr_jax.errors import AssetError, ConfigError, MotionError
from eslr_jax.fit.fit import fit_garment
from eslr_jax.fit.options import FitOptions, Scale
from eslr_jax.fit.transfer import transfer_garment
from eslr_jax.fit.wearer import check_wearer, wearer_entry
from eslr_jax.geometry.coarse import add_coarse_edges
from eslr_jax.geometry.prepare import prepare_garment, to_device
from eslr_jax.geometry.refine import refine
from eslr_jax.geometry.validate import validate_body
from eslr_jax.io.asf import read_amc
from eslr_jax.io.body import read_body
from eslr_jax.io.bvh import read_bvh
from eslr_jax.io.garment import (
    GarmentFile,
    GarmentSource,
    garment_arrays,
    garment_from_arrays,
    is_garment_file,
    read_garment_npz,
    read_garment_source,
)
from eslr_jax.io.gltf_rig import GLTF_SUFFIXES, gltf_clip_names, read_gltf_body, read_gltf_motion
from eslr_jax.io.motion import read_motion_archive
from eslr_jax.io.npz import read_arrays
from eslr_jax.io.skeleton import Skeleton, SkeletonMotion
from eslr_jax.io.smpl import is_smpl_model, read_amass, read_smpl_body, read_smpl_pickle
from eslr_jax.io.weights import read_weights
from eslr_jax.types import Body, Garment

DEFAULT_MOTION = "cmu_016_32"
DEFAULT_MODEL = "eslr-small"
START_MODEL = "smooth-small"  # the network that was trained to give the solver an initial guess
Resolution = Literal["1k", "4k", "10k", "50k", "200k"]
_SAME_BODY = 1e-4  # [m] by which the bundled body may differ, read from another file
_REFINED = {"50k": "tq", "200k": "tqq"}  # sizes that are made from 4k vertices, see `geometry.refine`


def _is_path(name: str) -> bool:
    """Tell a path from a name: it has a separator or a suffix, or is a file.

    A folder is none, such as the one of a run that has the name of its garment.
    """
    return "/" in name or "\\" in name or Path(name).suffix != "" or Path(name).is_file()


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
    file, meshes = _split_name(text)
    suffix = Path(file).suffix.lower()
    is_bundled = not _is_path(text) or (suffix == ".npz" and not is_smpl_model(file))
    if is_bundled and units is not None:
        raise ConfigError(f"body {text} is in metres; leave out its unit")
    if not _is_path(text):
        return _closed(read_body(find_asset("body", text)), text)
    if suffix in GLTF_SUFFIXES:
        return make_body(read_gltf_body(file, meshes), units=units)
    if suffix == ".pkl" or (suffix == ".npz" and is_smpl_model(file)):
        return make_body(read_smpl_body(file), units=units)
    if suffix == ".npz":
        return _closed(read_body(file), Path(file).name)
    raise _unknown_suffix("body", file, (".npz", ".pkl", *GLTF_SUFFIXES))


def _unknown_suffix(content: str, file: str | Path, known: Iterable[str]) -> AssetError:
    """Return the error for a file of an unknown kind."""
    suffix = Path(file).suffix.lower()
    if suffix == ".fbx":
        return AssetError(
            f"{content} file {file}: FBX is not read; export it as glTF (in Blender: File > Export > glTF 2.0)"
        )
    return AssetError(
        f"{content} file {file} has the unknown suffix {suffix!r}; give one of {', '.join(known)}"
    )


def _closed(body: Body, name: str) -> Body:
    """Return the body if it has an inside; raise a MeshError if not."""
    positions, faces, is_obstacle = (
        np.asarray(leaf) for leaf in (body.rest_positions, body.faces, body.is_obstacle)
    )
    validate_body(positions, faces, is_obstacle, name=name)
    return body


def _split_name(text: str) -> tuple[str, list[str]]:
    """Split `FILE#NAME,NAME` into the file and the names."""
    file, _, names = text.partition("#")
    return file, [name for name in names.split(",") if name]


def load_garment(
    name: str | Path = "tshirt",
    *,
    vertices: Resolution = "1k",
    body: Body | None = None,
    fit: FitOptions | None = None,
    pad: bool = False,
    cache: bool = True,
    **options: Any,
) -> Garment:
    """Load a garment, fit it to the body if it is a mesh, and prepare it for simulation; warn of a doubtful fit.

    Args:
        name: Name of a bundled garment, or path of a file that `eslr fit` wrote. A mesh (obj, ply, stl, glb, npz)
            or one of HOOD's garments (`garments_dict.pkl#NAME`) is fitted first.
        vertices: Resolution of a bundled garment; 50k and 200k are subdivisions of its 4k mesh.
        body: Body that wears it, by default the bundled one. A mesh is fitted to this body, and a bundled garment
            is transferred to it.
        fit: Options of the fit; everything is recognised by default.
        pad: Pad to a bucket of sizes, so that garments of similar size share one compiled rollout.
        cache: Keep the result for the next time.
        options: Arguments of `prepare_stored` and of `prepare_garment`; those that a network asks for are its
            `ModelConfig.garment_options`.

    Raises:
        AssetError: There is no such garment, or the file can't be read.
        MeshError: The mesh can't be simulated, does not fit the body, or can't be carried to it.
    """
    stored = load_garment_file(name, vertices=vertices, body=body, fit=fit, cache=cache)
    warn_of_fit(Path(name).name, stored)
    return prepare_stored(stored, pad=pad, cache=cache, name=Path(name).name, **options)


def warn_of_fit(name: str, stored: GarmentFile) -> None:
    """Warn of what was doubtful when a garment was fitted."""
    for text in stored.fit_warnings:
        warnings.warn(f"{name}: {text}", stacklevel=3)


def load_garment_file(
    name: str | Path = "tshirt",
    *,
    vertices: Resolution = "1k",
    body: Body | None = None,
    fit: FitOptions | None = None,
    cache: bool = True,
    on_source: Callable[[GarmentSource], None] | None = None,
) -> GarmentFile:
    """Load a garment as arrays on the host, fitted to the body if it is a mesh, carried to it if it is bundled.

    Args:
        name: Garment; see `load_garment`, also for the other arguments.
        vertices: Resolution of a bundled garment; from 50k on it is a refined 4k.
        body: Body that is to wear it.
        fit: Options of the fit.
        cache: Keep the result for the next time.
        on_source: Function that is told of a mesh before it is fitted.
    """
    if not _is_path(str(name)):
        _refuse_fit(str(name), fit or FitOptions())
        stored = read_garment_npz(
            find_asset("garment", f"{name}_{'4k' if vertices in _REFINED else vertices}")
        )
        stored = _carried(stored, body, (fit or FitOptions()).scale, cache=cache)
        return _refined(stored, _REFINED[vertices]) if vertices in _REFINED else stored
    path = Path(str(name).partition("#")[0]) if ".pkl#" in str(name).lower() else Path(name)
    if path.is_file() and is_garment_file(path):
        stored = read_garment_npz(path)
        if body is not None:
            check_wearer(stored, body, str(name))
        return stored
    source = read_garment_source(name)
    if on_source is not None:
        on_source(source)
    rig, options = load_body() if body is None else body, fit or FitOptions()
    if not cache:
        return fit_garment(source, rig, options)
    key = content_key("fit", path.read_bytes(), str(name), options, rig.joint_names, *_body_arrays(rig))
    arrays = cached_arrays(key, lambda: garment_arrays(fit_garment(source, rig, options)))
    return garment_from_arrays(arrays, source.name)


def check_resolution(names: Sequence[str], vertices: Resolution) -> None:
    """Check that a resolution other than the usual one is asked for bundled garments.

    Args:
        names: Garments by name or path.
        vertices: Resolution of those that are bundled.

    Raises:
        ConfigError: All of them are files, which have their own.
    """
    if vertices != "1k" and all(map(_is_path, names)):
        raise ConfigError(
            f"--vertices {vertices} is for bundled garments, and the mesh of a file stays as it is; leave "
            "it out, or remesh the file: eslr fit --edge-length"
        )


def _refuse_fit(name: str, options: FitOptions) -> None:
    """Raise a ConfigError if a bundled garment is given an option of a fit, except its scale."""
    usual = vars(FitOptions()) | {"scale": options.scale}
    given = [field for field, value in vars(options).items() if value != usual[field]]
    if given:
        names = ", ".join(f"--{field.replace('_', '-')}" for field in given)
        raise ConfigError(f"{name} is bundled: it is carried to a body, not fitted; leave out {names}")


def _carried(stored: GarmentFile, body: Body | None, scale: Scale, *, cache: bool) -> GarmentFile:
    """Return a bundled garment on a body: as stored on the bundled body, transferred to any other."""
    if body is None:
        return stored
    own = load_body()
    if (
        body.joint_names == own.joint_names
        and body.rest_positions.shape == own.rest_positions.shape
        and np.allclose(body.rest_positions, own.rest_positions, atol=_SAME_BODY)
    ):
        return dataclasses.replace(stored, metadata=stored.metadata | wearer_entry(own))  # its run keeps it
    if not cache:
        return transfer_garment(stored, own, body, scale=scale)
    bends = () if body.pose_directions is None else (np.asarray(body.pose_directions),)
    arrays = [array for _, array in sorted(garment_arrays(stored).items())]
    key = content_key(
        "transfer", scale, body.joint_names, *arrays, *_body_arrays(own), *_body_arrays(body), *bends
    )
    carried = cached_arrays(key, lambda: garment_arrays(transfer_garment(stored, own, body, scale=scale)))
    return garment_from_arrays(carried, "garment")


def _refined(stored: GarmentFile, scheme: str) -> GarmentFile:
    """Return a bundled garment on a finer mesh; vertices between pinned ones are pinned."""
    count = len(stored.rest_positions)
    finer = refine(stored.faces, count, scheme)
    rows = np.repeat(np.arange(count), stored.skin_indices.shape[1])
    dense = np.zeros((count, stored.skin_indices.max() + 1))
    np.add.at(dense, (rows, stored.skin_indices.ravel()), stored.skin_weights.ravel())
    weights = finer.linear @ dense
    chosen = np.argsort(-weights, axis=1)[:, : stored.skin_indices.shape[1]]
    weights = np.take_along_axis(weights, chosen, axis=1)
    return GarmentFile(
        rest_positions=finer.smooth @ stored.rest_positions,
        faces=finer.faces,
        skin_weights=weights / weights.sum(axis=1, keepdims=True),
        skin_indices=chosen,
        is_pinned=finer.linear @ stored.is_pinned > 0.99,
        sewn_positions=None if stored.sewn_positions is None else finer.smooth @ stored.sewn_positions,
        face_parts=None if stored.face_parts is None else stored.face_parts[finer.parents],
        part_names=stored.part_names,
        metadata=stored.metadata,
    )


def prepare_stored(
    stored: GarmentFile,
    *,
    pad: bool = False,
    cache: bool = True,
    name: str = "garment",
    has_coarse_edges: bool = False,
    **options: Any,
) -> Garment:
    """Prepare a garment file for simulation.

    Args:
        stored: Garment of `load_garment_file`.
        pad: Pad to a bucket of sizes.
        cache: Keep the result for the next time.
        name: Name of the garment in messages.
        has_coarse_edges: Add the coarse edges that a hierarchical network reads.
        options: Arguments of `prepare_garment`.

    Raises:
        MeshError: The mesh can't be simulated.
    """
    options.setdefault("allow_components", not stored.metadata.keys().isdisjoint(("fit", "outfit")))

    def make() -> dict[str, np.ndarray]:
        garment = prepare_garment(
            stored.rest_positions,
            stored.faces,
            skin_weights=stored.skin_weights,
            skin_indices=stored.skin_indices,
            is_pinned=stored.is_pinned,
            sewn_positions=stored.sewn_positions,
            pad=pad,
            name=name,
            **options,
        )
        leaves = {field.name: getattr(garment, field.name) for field in dataclasses.fields(Garment)}
        return {name: np.asarray(leaf) for name, leaf in leaves.items() if leaf is not None}

    own = [array for key, array in sorted(garment_arrays(stored).items()) if key != "metadata"]
    key = content_key("prepare", pad, sorted(options.items()), *own)
    garment = Garment(**(cached_arrays(key, make) if cache else make()))
    return to_device(add_coarse_edges(garment) if has_coarse_edges else garment)


def _body_arrays(body: Body) -> list[np.ndarray]:
    """Return the arrays of a body that a fit depends on."""
    names = (
        "rest_positions",
        "faces",
        "skin_weights",
        "skin_indices",
        "is_obstacle",
        "joint_rest_positions",
        "parents",
    )
    return [np.asarray(getattr(body, name)) for name in names]


@lru_cache(maxsize=4)
def _motion_archive(path: Path, modified: float):
    del modified  # part of the key: a changed file is read again
    return read_motion_archive(path)


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
        up: Axis that points up in a BVH file; by default the one along which the figure stands.

    Raises:
        AssetError: There is no such motion, or the file is damaged.
        MotionError: The file holds no usable motion, or none that this body can follow; or `up` is given for
            another format.
        MissingExtraError: The file needs an extra that is not installed.
    """
    text = str(name)
    file, _, clip = text.partition("#")
    is_bvh = Path(file).suffix.lower() == ".bvh"
    if up != "auto" and not is_bvh:
        raise MotionError(
            f"motion {text} has its own up axis, which only a BVH file lacks; leave out --motion-up"
        )
    if text in PROCEDURAL:
        if joint_map:
            raise MotionError(f"{text} is computed from the body's own joints; leave out the map of joints")
        return make_procedural(text, load_body() if body is None else body)
    if _is_archived(text):
        motion = _bundled_motion(text)
        if body is None or (_is_made_for(motion, body, is_bundled=not _is_path(text)) and not joint_map):
            return motion
        # An archive holds no skeleton, so that of the bundled body is used.
        return make_motion(skeleton_motion(motion, load_body()), body, joint_map=joint_map)
    whole = read_skeleton_motion(file, clip)
    source, skipped = skip_start_pose(whole)
    if skipped:
        warnings.warn(skipped, stacklevel=2)
    motion = make_motion(
        source, load_body() if body is None else body, joint_map=joint_map, up=up if is_bvh else "y"
    )
    return dataclasses.replace(motion, start=(len(whole.positions) - len(source.positions)) / source.fps)


def own_motion(body: str) -> str:
    """Return the animation in a body's file, or a bundled walk if it has none."""
    file, _ = _split_name(body)
    suffix = Path(file).suffix.lower()
    if suffix in GLTF_SUFFIXES and gltf_clip_names(file):
        return file
    return DEFAULT_MOTION


def _is_made_for(motion: Motion, body: Body, *, is_bundled: bool) -> bool:
    """Tell whether a clip can move this body without retargeting; a user's archive by its joint names."""
    if motion.joint_names != body.joint_names:
        return False
    rest = np.asarray(body.joint_rest_positions)
    return not is_bundled or np.allclose(rest, np.asarray(load_body().joint_rest_positions), atol=1e-4)


def motion_skeleton(name: str) -> Skeleton:
    """Return the skeleton whose joints a body follows in a motion.

    A bundled clip, and an archive in its format, holds no skeleton: it is for that of the bundled body.

    Args:
        name: See `load_motion`.

    Raises:
        AssetError: There is no such motion, or the file is damaged.
        MotionError: The motion is computed for every body, or it is for another skeleton than its archive has.
        MissingExtraError: The file needs an extra that is not installed.
    """
    if name in PROCEDURAL:
        raise MotionError(f"motion {name} is computed on the joints of any body; it needs no joint map")
    if _is_archived(name):
        return skeleton_motion(_bundled_motion(name), load_body()).skeleton
    file, _, clip = name.partition("#")
    return read_skeleton_motion(file, clip).skeleton


def _is_archived(text: str) -> bool:
    """Tell a clip of the bundled format, by its name or in a user's archive, from a motion with its skeleton."""
    file = text.partition("#")[0]
    return not _is_path(text) or (Path(file).suffix.lower() == ".npz" and not _is_amass(file))


def _is_amass(file: str) -> bool:
    """Tell an archive of AMASS from one in the bundled format."""
    return "poses" in read_arrays(file, content="motion", names=("poses",))


def read_skeleton_motion(file: str | Path, clip: str = "") -> SkeletonMotion:
    """Read a motion with the skeleton of its file.

    Args:
        file: .bvh, .amc with its .asf, .npz of AMASS, .pkl of HOOD or VTO, .gltf, .glb or .vrm.
        clip: Which of several animations.

    Raises:
        AssetError: The file is missing, damaged, or of an unknown kind.
        MotionError: The file holds no usable motion.
        MissingExtraError: The file needs an extra that is not installed.
    """
    suffix = Path(file).suffix.lower()
    if suffix in GLTF_SUFFIXES:
        return read_gltf_motion(file, clip)
    readers = {".bvh": read_bvh, ".amc": read_amc, ".npz": read_amass, ".pkl": read_smpl_pickle}
    if suffix not in readers:
        raise _unknown_suffix("motion", file, (*readers, *GLTF_SUFFIXES))
    return readers[suffix](file)


def _bundled_motion(text: str) -> Motion:
    """Load a clip by name, or from an archive in the bundled format."""
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
        name: Name of a bundled model, or path of an exported npz file. `NAME:STEPS` changes the number of
            refinement steps per frame, for less error or less time.

    Returns:
        Its weights and its architecture.

    Raises:
        AssetError: There is no such model, it can't take so many refinement steps, or the file is damaged.
        CheckpointError: The file is for another architecture or a newer version.
    """
    (params, config, _), steps = _read_model(str(name))
    if steps is not None:
        try:
            config = dataclasses.replace(config, refinement_steps=steps)
        except ValueError as error:
            raise AssetError(f"model {name}: {error}") from error
    return params, config


def model_record(name: str | Path) -> dict[str, Any]:
    """Return how a network was trained, as its file tells; the argument is that of `load_model`."""
    return _read_model(str(name))[0][2]


def _read_model(name: str) -> tuple[tuple[dict[str, Any], ModelConfig, dict[str, Any]], int | None]:
    """Return weights, architecture and training record of a model, and the refinement steps asked for."""
    parts = re.fullmatch(r"(.+):(\d+)", name)
    model = parts[1] if parts else name
    path = Path(model) if _is_path(model) else find_asset("model", model)
    return read_weights(path), int(parts[2]) if parts else None


def default_model() -> str:
    """Return the name of the model that `eslr simulate` uses when none is named."""
    return DEFAULT_MODEL
