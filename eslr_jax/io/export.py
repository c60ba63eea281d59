"""Export a simulated run to the formats of other programs."""

from __future__ import annotations

import os
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from eslr_jax.errors import AssetError
from eslr_jax.io.animated import AnimatedMesh, check_meshes, split_seams
from eslr_jax.io.atomic import atomic_write, ensure_output_dir
from eslr_jax.io.garment import GarmentFile, first_rows, split_outfit
from eslr_jax.io.gltf import write_animated_glb
from eslr_jax.io.mesh_sequence import frame_name, obj_text
from eslr_jax.io.npz import write_arrays
from eslr_jax.io.palette import SKIN_COLOR, garment_color
from eslr_jax.io.parsing import split_name
from eslr_jax.io.point_cache import write_mdd, write_pc2
from eslr_jax.io.trajectory import TrajectoryFile
from eslr_jax.io.usd import write_usd

Format = Literal["glb", "usd", "usda", "usdc", "obj", "ply", "pc2", "mdd", "npz"]
Content = Literal["garment", "body", "both"]
_SCENES = ("glb", "usd", "usda", "usdc")  # formats that hold several meshes


def export_trajectory(
    run: TrajectoryFile,
    path: str | Path,
    *,
    garment: GarmentFile | None = None,
    format: Format | None = None,
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
        format: Format of the file; by default what the suffix of `path` says.
        content: What to write; by default both meshes to glb and usd, and the garment to all others.

    Returns:
        The path that was written.

    Raises:
        AssetError: The format is unknown, the run has no body, or the file can't be written.
        MissingExtraError: USD is not installed.
    """
    path = Path(path).expanduser()
    chosen = format or _format_of(path)
    content = content or ("both" if chosen in _SCENES and run.body is not None else "garment")
    if content == "both" and chosen not in _SCENES:
        raise AssetError(f"{chosen} holds one mesh; export garment and body to a file each")
    both = _meshes(run, garment)
    meshes = [mesh for kind, mesh in both.items() if content in (kind, "both")]
    if chosen in _SCENES and content != "body" and garment is not None and len(garment.outfit) > 1:
        meshes[:1] = _garments(both["garment"], garment.outfit)
    if not meshes:
        raise AssetError("this run has no body; export the garment")
    check_meshes(meshes, run.timestep)
    if chosen in ("pc2", "mdd") and content == "garment" and garment is not None:
        _warn_of_order(garment)
    if chosen in ("usd", "usda", "usdc"):
        if path.suffix.lower() != f".{chosen}":
            raise AssetError(f"{path}: USD goes by the name of its file; name it .{chosen}")
        write_usd(path, meshes, run.timestep)
    elif chosen == "glb":
        write_animated_glb(path, meshes, run.timestep)
    elif chosen == "pc2":
        write_pc2(path, meshes[0].positions)
    elif chosen == "mdd":
        write_mdd(path, meshes[0].positions, run.timestep)
    elif chosen == "npz":
        _write_npz(path, meshes[0], run.timestep)
    else:
        write_sequence(path, meshes[0], chosen)
    return path


def _format_of(path: Path) -> Format:
    """Return the format that a file's suffix names."""
    suffix = path.suffix.lower().removeprefix(".")
    if suffix in get_args(Format) and suffix not in ("obj", "ply"):
        return suffix  # pyright: ignore[reportReturnType]
    known = ", ".join(get_args(Format))
    raise AssetError(f"can't tell the format of {path}; name one with --format: {known}")


def _meshes(run: TrajectoryFile, garment: GarmentFile | None) -> dict[str, AnimatedMesh]:
    """Return the garment in the vertex order of its file, and the body if there is one.

    Raises:
        AssetError: The garment is not the one that was simulated.
    """
    faces, uvs, places = run.faces, None, np.arange(run.positions.shape[1])
    if garment is not None:
        if not np.array_equal(garment.faces, faces):
            raise AssetError("the garment file is not the one of this run; simulate again")
        uvs, order = garment.corner_uvs, garment.vertex_map
        if order is not None and order.max(initial=-1) < len(places):
            first = first_rows(order, len(places))
            if (first[faces] >= 0).all():
                # Dropped vertices have no faces that are left: the next one will do, and the count is the file's.
                kept = np.flatnonzero(order >= 0)
                following = np.searchsorted(kept, np.arange(len(order)))
                places, faces = order[kept[np.minimum(following, len(kept) - 1)]], first[faces]
    name = Path(split_name(str(run.metadata.get("garment") or "garment"))[0]).stem or "garment"
    cloth = AnimatedMesh(
        name, run.positions[:, places], faces, corner_uvs=uvs, velocities=run.velocities[:, places]
    )
    if run.body is None:
        return {"garment": cloth}
    body = AnimatedMesh(
        "body",
        run.body.positions,
        run.body.faces,
        SKIN_COLOR,
        rest_positions=run.body.rest_positions,
        skin=run.body.skin,
    )
    return {"garment": cloth, "body": body}


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


def _garments(cloth: AnimatedMesh, outfit: dict[str, int]) -> list[AnimatedMesh]:
    """Return the garments of an outfit as a mesh each, in a colour each; zeros are no texture coordinates."""
    uvs = cloth.corner_uvs
    return [
        AnimatedMesh(
            name,
            cloth.positions[:, rows],
            cloth.faces[is_own] - rows.start,
            garment_color(number),
            corner_uvs=None if uvs is None or not uvs[is_own].any() else uvs[is_own],
            velocities=None if cloth.velocities is None else cloth.velocities[:, rows],
        )
        for number, (name, rows, is_own) in enumerate(split_outfit(cloth.faces, outfit))
    ]


def _write_npz(path: Path, mesh: AnimatedMesh, timestep: float) -> None:
    """Write a mesh sequence as an archive that `read_mesh_sequence` reads."""
    arrays = {
        "positions": np.asarray(mesh.positions, np.float32),
        "faces": np.asarray(mesh.faces, np.int32),
        "timestep": np.array(timestep, np.float64),
        "name": np.array(mesh.name),
    }
    if mesh.corner_uvs is not None:
        arrays["corner_uvs"] = np.asarray(mesh.corner_uvs, np.float32)
    write_arrays(path, arrays)


def write_sequence(folder: str | Path, mesh: AnimatedMesh, kind: Literal["obj", "ply"]) -> None:
    """Write one mesh file per frame into a new folder, which appears when it is complete.

    Args:
        folder: Path of the folder, which must be empty or not exist.
        mesh: The mesh in motion.
        kind: Format of the files.

    Raises:
        AssetError: The folder holds files already, or it can't be written.
    """
    target = Path(folder).expanduser()
    if target.is_file() or (target.is_dir() and any(target.iterdir())):
        raise AssetError(f"{target} exists already; name a new folder for the sequence")
    ensure_output_dir(target.parent)
    parts = target.with_name(f".{target.name}.part")
    shutil.rmtree(parts, ignore_errors=True)  # of an export that was killed
    make: Callable[[np.ndarray], bytes] = _obj_writer(mesh) if kind == "obj" else _ply_writer(mesh)
    try:
        ensure_output_dir(parts)
        for frame, positions in enumerate(np.asarray(mesh.positions, np.float32)):
            name = frame_name(mesh.name, frame, len(mesh.positions), f".{kind}")
            with atomic_write(parts / name) as temporary:
                temporary.write_bytes(make(positions))
        if target.is_dir():
            target.rmdir()
        os.replace(parts, target)
    except OSError as error:
        raise AssetError(f"can't write {target}: {error.strerror}; choose another folder") from error
    finally:
        shutil.rmtree(parts, ignore_errors=True)


def _obj_writer(mesh: AnimatedMesh) -> Callable[[np.ndarray], bytes]:
    """Return the function from a frame's positions to an OBJ file."""
    uvs = uv_faces = None
    if mesh.corner_uvs is not None:
        corners = np.asarray(mesh.corner_uvs, np.float64).reshape(-1, 2)
        uvs, inverse = np.unique(corners, axis=0, return_inverse=True)
        uv_faces = inverse.reshape(-1, 3)
    return lambda positions: obj_text(mesh.name, positions, mesh.faces, uvs=uvs, uv_faces=uv_faces).encode()


def _ply_writer(mesh: AnimatedMesh) -> Callable[[np.ndarray], bytes]:
    """Return the function from a frame's positions to a binary PLY file; seams are split, at the end."""
    faces, vertices, uvs = split_seams(
        np.asarray(mesh.faces), np.asarray(mesh.positions).shape[1], mesh.corner_uvs
    )
    fields = ["x", "y", "z"] + (["s", "t"] if uvs is not None else [])
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(vertices)}",
        *(f"property float {name}" for name in fields),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    header = ("\n".join(lines) + "\n").encode()
    table = np.empty(len(faces), [("count", "u1"), ("corners", "<i4", 3)])
    table["count"], table["corners"] = 3, faces

    def make(positions: np.ndarray) -> bytes:
        columns = [positions[vertices]] + ([uvs] if uvs is not None else [])
        return header + np.concatenate(columns, axis=1).astype("<f4").tobytes() + table.tobytes()

    return make
