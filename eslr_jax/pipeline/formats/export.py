"""Export a simulated run to the formats of other programs."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Literal

import numpy as np

from eslr_jax.errors import AssetError
from eslr_jax.files.parsing import split_name
from eslr_jax.pipeline.formats.animated import AnimatedMesh
from eslr_jax.pipeline.formats.garment import GarmentFile, first_rows, split_outfit
from eslr_jax.pipeline.formats.palette import garment_color
from eslr_jax.pipeline.formats.registry import WRITERS, find_writer, names_of, suffixes_of
from eslr_jax.pipeline.formats.trajectory import TrajectoryFile

Content = Literal["garment", "body", "both"]


def export_trajectory(
    run: TrajectoryFile,
    path: str | Path,
    *,
    garment: GarmentFile | None = None,
    format: str | None = None,
    content: Content | None = None,
) -> Path:
    """Write a run in another program's format.

    Args:
        run: The trajectory, from `read_trajectory`.
        path: Path of the file; of a new folder for `obj` and `ply`, which are one file per frame.
        garment: The garment that was simulated. It tells the vertex order of the garment's own file, so that a
            point cache lies on that file, and its texture coordinates. A vertex that the fit dropped is laid on
            the next one of the file, and a warning tells of it where a point cache shows it. So does one of an
            outfit, whose garments stand in a point cache one after another.
        format: Name of a format in `registry.names_of(*WRITERS)`; by default what the suffix of `path` says.
        content: What to write; by default both meshes to formats that hold several, and the garment to others.

    Returns:
        The path that was written.

    Raises:
        AssetError: The format is unknown, the run has no body, or the file can't be written.
        MissingExtraError: The format needs an extra that is not installed.
    """
    path = Path(path).expanduser()
    suffix = path.suffix.lower()
    chosen = suffix[1:] if format is None else format
    kind, write = find_writer(chosen) or ("", None)
    if write is None or (format is None and kind == "frames"):
        cause = (
            f"can't tell the format of {path}" if format is None else f"{format} is no format to export to"
        )
        raise AssetError(f"{cause}; name one with --format: {names_of(*WRITERS)}")
    if suffix[1:] != chosen and suffix in suffixes_of(*WRITERS):
        raise AssetError(f"{path} has the suffix of another format than {chosen}; name it .{chosen}")
    content = content or ("both" if kind == "scene" and run.body is not None else "garment")
    if content == "both" and kind != "scene":
        raise AssetError(f"{chosen} holds one mesh; export garment and body to a file each")
    both = _meshes(run, garment)
    meshes = [mesh for name, mesh in both.items() if content in (name, "both")]
    if not meshes:
        raise AssetError("this run has no body; export the garment")
    if garment is not None and content != "body":
        if kind == "scene" and len(garment.outfit) > 1:
            cloth = both["garment"]
            uvs = cloth.corner_uvs  # zeros are none
            meshes[:1] = [
                AnimatedMesh(
                    name,
                    cloth.positions[:, rows],
                    cloth.faces[is_own] - rows.start,
                    garment_color(number),
                    corner_uvs=None if uvs is None or not uvs[is_own].any() else uvs[is_own],
                    velocities=None if cloth.velocities is None else cloth.velocities[:, rows],
                    parts={part: has[is_own] for part, has in cloth.parts.items() if has[is_own].any()},
                )
                for number, (name, rows, is_own) in enumerate(split_outfit(cloth.faces, garment.outfit))
            ]
        if kind == "point cache":
            _warn_of_order(garment)
    write(path, meshes, run.timestep)
    return path


def _meshes(run: TrajectoryFile, garment: GarmentFile | None) -> dict[str, AnimatedMesh]:
    """Return the garment in the vertex order of its file, and the body if there is one."""
    faces, uvs, places = run.faces, None, np.arange(run.positions.shape[1])
    parts: dict[str, np.ndarray] = {}
    if garment is not None:
        if not np.array_equal(garment.faces, faces):
            raise AssetError("the garment file is not the one of this run; simulate again")
        uvs, order = garment.corner_uvs, garment.vertex_map
        if garment.face_parts is not None:
            parts = {name: garment.face_parts == part for part, name in enumerate(garment.part_names)}
        if order is not None and order.max(initial=-1) < len(places):
            first = first_rows(order, len(places))
            if (first[faces] >= 0).all():
                # Dropped vertices have no faces that are left: the next one will do, and the count is the file's.
                kept = np.flatnonzero(order >= 0)
                following = np.searchsorted(kept, np.arange(len(order)))
                places, faces = order[kept[np.minimum(following, len(kept) - 1)]], first[faces]
    name = Path(split_name(str(run.metadata.get("garment") or "garment"))[0]).stem or "garment"
    cloth = AnimatedMesh(
        name,
        run.positions[:, places],
        faces,
        corner_uvs=uvs,
        velocities=run.velocities[:, places],
        parts=parts,
    )
    return {"garment": cloth} if run.body is None else {"garment": cloth, "body": run.body}


def _warn_of_order(garment: GarmentFile) -> None:
    """Warn if a point cache does not lie on a garment's file, or has places for dropped vertices."""
    if len(garment.outfit) > 1:
        warnings.warn(
            f"the cache holds {', '.join(garment.outfit)} one after another, as they are simulated, not as in "
            "their files; lay it on a mesh of eslr export --format obj",
            stacklevel=3,
        )
        return
    order = np.array([], int) if garment.vertex_map is None else garment.vertex_map
    if (count := int(np.sum(order < 0))) > 0:
        warnings.warn(
            f"{count} of the {len(order)} vertices of the garment's file were dropped by the fit; the cache "
            "keeps the order of the file, and lays each of them on the next vertex that was kept",
            stacklevel=3,
        )
