"""Load garments by name or by path, fitted or carried to a body, and prepare them for simulation."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from eslr_jax.errors import ConfigError
from eslr_jax.files.parsing import parsing
from eslr_jax.mesh.coarse import add_coarse_edges
from eslr_jax.mesh.prepare import prepare_garment
from eslr_jax.numerics import to_device
from eslr_jax.pipeline.assets.cache import cached, content_key
from eslr_jax.pipeline.assets.catalog import find_asset, is_path
from eslr_jax.pipeline.assets.motions import load_body
from eslr_jax.pipeline.dressing.fit import fit_garment
from eslr_jax.pipeline.dressing.options import FitOptions, Scale
from eslr_jax.pipeline.dressing.remesh import refine
from eslr_jax.pipeline.dressing.report import check_wearer, wearer_entry
from eslr_jax.pipeline.dressing.sewing import sew_pattern
from eslr_jax.pipeline.dressing.transfer import transfer_garment
from eslr_jax.pipeline.fabrics import garment_material
from eslr_jax.pipeline.formats.garment import (
    GarmentFile,
    garment_arrays,
    garment_from_arrays,
    garment_path,
    is_garment_file,
    read_garment_npz,
    read_garment_source,
)
from eslr_jax.pipeline.formats.pattern import read_pattern
from eslr_jax.pipeline.formats.registry import suffixes_of
from eslr_jax.simulation.archive import read_tree, write_tree
from eslr_jax.types import Body, Garment

# Of the bundled body, on which patterns for GarmentCode's mean body stretch little: 1.69 m tall, bust and hips
# .98 m, waist .72 m, where that one has 1.72, 1.00, 1.03 and .84 m (its mean_all_tpose.yaml). At these girths its
# shoulders are too broad.
MEAN_SHAPE = (-1.6, 0.0, 1.0, 0.0)
Resolution = Literal["1k", "4k", "10k", "50k", "200k"]
_SAME_BODY = 1e-4  # [m] by which the bundled body may differ, read from another file
_REFINED = {"50k": "tq", "200k": "tqq"}  # sizes that are made from 4k vertices, see `refine`


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
        name: Name of a bundled garment, or path of a fitted one: of `eslr fit`, or `garment.npz` of a run.
            A mesh (obj, ply, stl, glb, npz) or one of HOOD's garments (`garments_dict.pkl#NAME`) is fitted first,
            and a sewing pattern (json) sewn.
        vertices: Resolution of a bundled garment or a pattern; 50k and 200k are subdivisions of its 4k mesh.
        body: Body that wears it, by default the bundled one. A mesh is fitted to this body, and a bundled garment
            is transferred to it.
        fit: Options of the fit; everything is recognised by default.
        pad: Pad to a bucket of sizes, so that garments of similar size share one compiled rollout.
        cache: Keep the result for the next time.
        options: Arguments of `prepare_stored` and of `prepare_garment`; those that a network asks for are its
            `Network.garment_options`.

    Returns:
        The garment on the body's rest pose. The origin of its `rest_positions` is the body's: that of the bundled
        body is at the hips, 0.82 m above the soles, while the poses of `pose_body` stand on a floor at y = 0. Its
        `material` has the file's fabrics, or is None, for cotton.

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
) -> GarmentFile:
    """Load a garment as arrays on the host, fitted to the body if it is a mesh, carried to it if it is bundled.

    Arguments are those of `load_garment`.
    """
    if not is_path(str(name)):
        options = fit or FitOptions()
        usual = vars(FitOptions()) | {"scale": options.scale}
        given = [field for field, value in vars(options).items() if value != usual[field]]
        if given:
            names = ", ".join(f"--{field.replace('_', '-')}" for field in given)
            raise ConfigError(f"{name} is bundled: it is carried to a body, not fitted; leave out {names}")
        stored = read_garment_npz(
            find_asset("garment", f"{name}_{'4k' if vertices in _REFINED else vertices}")
        )
        stored = _carried(stored, body, options.scale, cache=cache)
        return _refined(stored, _REFINED[vertices]) if vertices in _REFINED else stored
    path = garment_path(name)
    if path.is_file() and is_garment_file(path):
        stored = read_garment_npz(path)
        if body is not None:
            check_wearer(stored, body, str(name))
        return stored
    if path.suffix.lower() in suffixes_of("pattern"):
        return sew_pattern_file(path, body, num_vertices=int(vertices[:-1]) * 1000, cache=cache)
    source = read_garment_source(name)
    rig, options = load_body() if body is None else body, fit or FitOptions()
    parts = ("fit", path.read_bytes(), str(name), options, rig.joint_names, *_body_arrays(rig))
    return _kept(lambda: fit_garment(source, rig, options), source.name, parts, cache=cache)


def _kept(make: Callable[[], GarmentFile], name: str, parts: Iterable[Any], *, cache: bool) -> GarmentFile:
    """Return a garment that was made of these parts before, or make it; see `content_key`."""
    if not cache:
        return make()
    return garment_from_arrays(cached(content_key(*parts), lambda: garment_arrays(make())), name)


def sew_pattern_file(
    path: str | Path,
    body: Body | None = None,
    *,
    made_for: Body | None = None,
    num_vertices: int = 1000,
    pin: tuple[str, ...] = (),
    cache: bool = True,
) -> GarmentFile:
    """Read a sewing pattern, sew it, and put it on a body, by default the bundled one; see `sew_pattern`.

    By default it is made for GarmentCode's mean body, for which the bundled body stands, in `MEAN_SHAPE`.
    """
    rig = load_body() if body is None else body
    source = load_body(betas=MEAN_SHAPE) if made_for is None else made_for
    if all(np.array_equal(*pair) for pair in zip(_body_arrays(rig), _body_arrays(source), strict=True)):
        source = rig

    def sew() -> GarmentFile:
        name = Path(path).name
        return sew_pattern(read_pattern(path), rig, source, num_vertices=num_vertices, pin=pin, name=name)

    with parsing(path, "pattern") as file:
        given = file.read_bytes()
    bodies = (rig.joint_names, *_body_arrays(rig), source.joint_names, *_body_arrays(source))
    return _kept(sew, str(path), ("sew", given, num_vertices, pin, *bodies), cache=cache)


def check_resolution(names: Sequence[str], vertices: Resolution) -> None:
    """Raise a ConfigError if only files, which have a resolution of their own, are asked for in another one."""
    own = [
        name for name in names if is_path(name) and garment_path(name).suffix not in suffixes_of("pattern")
    ]
    if vertices != "1k" and len(own) == len(names):
        raise ConfigError(
            f"--vertices {vertices} is for bundled garments, and the mesh of a file stays as it is; leave "
            "it out, or remesh the file: eslr fit --edge-length"
        )


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
    bends = () if body.pose_directions is None else (np.asarray(body.pose_directions),)
    arrays = [array for _, array in sorted(garment_arrays(stored).items())]
    parts = ("transfer", scale, body.joint_names, *arrays, *_body_arrays(own), *_body_arrays(body), *bends)
    return _kept(lambda: transfer_garment(stored, own, body, scale=scale), "garment", parts, cache=cache)


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

    Returns:
        The garment, with the material of the file's fabrics if it has some.

    Raises:
        MeshError: The mesh can't be simulated.
        ConfigError: The file has a fabric that is unknown.
    """
    options.setdefault("allow_components", not stored.metadata.keys().isdisjoint(("fit", "outfit", "sewing")))

    def make() -> Garment:
        return prepare_garment(
            stored.rest_positions,
            stored.faces,
            skin_weights=stored.skin_weights,
            skin_indices=stored.skin_indices,
            is_pinned=stored.is_pinned,
            sewn_positions=stored.sewn_positions,
            panel_corners=stored.panel_corners,
            pad=pad,
            name=name,
            **options,
        )

    own = [array for key, array in sorted(garment_arrays(stored).items()) if key != "metadata"]
    key = content_key("prepare", pad, sorted(options.items()), *own)
    read = partial(read_tree, kind=Garment, content="garment", remedy="make it again")
    write = partial(write_tree, content="garment")
    garment = cached(key, make, write=write, read=read) if cache else make()
    if has_coarse_edges:
        garment = add_coarse_edges(garment)
    if stored.metadata.get("fabrics"):
        garment = garment.replace(material=garment_material((), garment, stored))
    return to_device(garment)


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
