"""Read and write moving meshes as Alembic, the exchange format of film; needs the extra `alembic`.

Vertices keep their order and their float32. Corners turn clockwise in Alembic: they are reversed both ways. It
knows no unit, no skeleton and no material: metres are written with Y up, every mesh as points, parts of a garment
as face sets. In a file with several meshes FILE#MESH,MESH names those to read.

A damaged file may crash the library, so that the script `apart/alembic.py` reads in a process of its own.
"""

from __future__ import annotations

import itertools
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from eslr_jax.errors import AssetError, MeshError
from eslr_jax.files.atomic import atomic_write
from eslr_jax.files.npz import read_arrays
from eslr_jax.pipeline.extras import require
from eslr_jax.pipeline.formats.animated import AnimatedMesh, identifiers, vertex_normals
from eslr_jax.pipeline.formats.mesh import MeshFile, cut_polygons, join_meshes, name_parts
from eslr_jax.pipeline.formats.mesh_sequence import DEFAULT_FPS, MeshSequence
from eslr_jax.pipeline.formats.registry import reader, writer
from eslr_jax.pose.skeleton import MAX_FRAMES, whole_rate

_UNEVEN = 0.01  # share of the time between samples by which times may be off


@writer("scene", [".abc"])
def write_alembic(path: Path, meshes: Sequence[AnimatedMesh], timestep: float) -> None:
    """Write meshes, each below a transform, atomically; frame k is the sample at k times the timestep [s].

    Raises:
        MissingExtraError: The extra is not installed.
    """
    require("alembic3d", extra="alembic", purpose="Alembic")
    from alembic3d import Abc, AbcCoreAbstract, AbcGeom  # pyright: ignore[reportMissingImports]

    rate = whole_rate(1.0 / timestep)
    with atomic_write(path) as temporary:
        archive = Abc.CreateArchiveWithInfo(str(temporary), rate, "eslr_jax", "metres, Y up")
        sampling = AbcCoreAbstract.TimeSampling(1.0 / rate, 0.0)
        for name, mesh in zip(identifiers([mesh.name for mesh in meshes]), meshes, strict=True):
            transform = AbcGeom.OXform(archive.getTop(), name)
            schema = AbcGeom.OPolyMesh(transform, f"{name}Shape").getSchema()
            schema.setTimeSampling(sampling)
            _set_samples(schema, mesh)
            del transform, schema  # an archive is written when nothing refers to it any more
        del archive


def _set_samples(schema: Any, mesh: AnimatedMesh) -> None:
    """Write a mesh: faces, texture coordinates and parts once; points, normals and velocities every frame."""
    import imath  # pyright: ignore[reportMissingImports]
    from alembic3d import AbcGeom  # pyright: ignore[reportMissingImports]

    def vectors(values: np.ndarray) -> Any:
        return imath.V3fArrayFromBuffer(np.ascontiguousarray(values, np.float32))

    def integers(values: np.ndarray) -> Any:
        return imath.IntArrayFromBuffer(np.ascontiguousarray(values, np.int32))

    faces, scopes = np.asarray(mesh.faces), AbcGeom.GeometryScope
    for frame, positions in enumerate(np.asarray(mesh.positions, np.float32)):
        sample = AbcGeom.OPolyMeshSchemaSample()
        sample.setPositions(vectors(positions))
        normals = vectors(vertex_normals(positions, faces))
        sample.setNormals(AbcGeom.ON3fGeomParamSample(normals, scopes.kVertexScope))
        if mesh.velocities is not None:
            sample.setVelocities(vectors(mesh.velocities[frame]))
        if frame == 0:
            sample.setFaceIndices(integers(faces[:, ::-1].reshape(-1)))
            sample.setFaceCounts(integers(np.full(len(faces), 3)))
            if mesh.corner_uvs is not None:
                corners = np.asarray(mesh.corner_uvs, np.float32)[:, ::-1].reshape(-1, 2)
                values, places = np.unique(corners, axis=0, return_inverse=True)
                # The library makes unsigned integers of floats, and of nothing else that NumPy has.
                indices = imath.UnsignedIntArray(
                    imath.DoubleArrayFromBuffer(places.astype(np.float64).ravel())
                )
                uvs = imath.V2fArrayFromBuffer(values), indices, scopes.kFacevaryingScope
                sample.setUVs(AbcGeom.OV2fGeomParamSample(*uvs))
        schema.set(sample)
    for name, has in zip(identifiers(list(mesh.parts)), mesh.parts.values(), strict=True):
        content = AbcGeom.OFaceSetSchemaSample()
        content.setFaces(integers(np.flatnonzero(has)))
        part = schema.createFaceSet(name).getSchema()
        part.setFaceExclusivity(AbcGeom.FaceSetExclusivity.kFaceSetExclusive)
        part.set(content)


@reader("garment", [".abc"])
def read_alembic_garment(path: Path, names: str = "") -> MeshFile:
    """Read the first sample of all meshes, or of some, as one garment, whose parts are face sets or meshes."""
    arrays = _read(path, names, 1)
    meshes = [_mesh(arrays, number, path) for number in range(len(arrays["names"]))]
    positions, faces, uvs, parts = zip(*meshes, strict=True)
    own = [str(name) for name, own in zip(arrays["names"], faces, strict=True) for _ in own]
    face_parts, part_names = name_parts([list(itertools.chain(*parts)), own])
    return MeshFile(
        *join_meshes([moving[0] for moving in positions], faces),
        corner_uvs=None if any(one is None for one in uvs) else np.concatenate(uvs),
        face_parts=face_parts,
        part_names=part_names,
        name=names.replace(",", "_") or path.stem,
    )


@reader("mesh sequence", [".abc"])
def read_alembic_sequences(path: Path, names: str = "", fps: float | None = None) -> list[MeshSequence]:
    """Read all meshes, or those of some names, at the times of the file; `fps` stands for its own rate [1/s]."""
    arrays = _read(path, names, MAX_FRAMES + 1)
    times = arrays["times"]
    if len(times) > MAX_FRAMES:
        raise AssetError(f"{path} has more than {MAX_FRAMES} samples; cut it")
    steps = np.diff(times)
    if fps is None and len(steps):
        step = float(np.median(steps))
        if step <= 0 or np.abs(steps - step).max() > _UNEVEN * step:
            raise AssetError(
                f"{path} has samples at uneven times, as for motion blur; export one sample a frame"
            )
        fps = whole_rate(1.0 / step)
    sequences = []
    for number, name in enumerate(map(str, arrays["names"])):
        positions, faces, _, _ = _mesh(arrays, number, path)
        label = path.name if len(arrays["names"]) == 1 else f"{path.name}#{name}"
        sequences.append(MeshSequence(label, positions, faces, DEFAULT_FPS if fps is None else fps, name))
    return sequences


def _read(path: Path, names: str, frames: int) -> dict[str, np.ndarray]:
    """Return the arrays of `apart/alembic.py`, whose `sys.exit` is what a person must know of the file."""
    require("alembic3d", extra="alembic", purpose="Alembic")
    script = Path(__file__).with_name("apart") / "alembic.py"
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "arrays.npz"
        # -P: Python would look for its own modules beside the script first.
        command = [sys.executable, "-P", script, path, out, names, str(frames)]
        done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, errors="replace")
        if done.returncode == 0:
            return read_arrays(out, content="alembic")
    last = (done.stderr.strip().splitlines() or [""])[-1]
    if done.returncode == 1 and "Traceback (most recent call last)" not in done.stderr:
        raise AssetError(f"{path}: {last}")
    cause = last[:200] if done.returncode == 1 else "its reader crashed"
    raise AssetError(f"{path} is damaged or no alembic file ({cause}); export it again")


def _mesh(
    arrays: dict[str, np.ndarray], number: int, path: Path
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, list[str]]:
    """Return a mesh's positions in the world [frames, vertices, 3], faces, texture coordinates and parts."""
    own = {key.partition("/")[2]: values for key, values in arrays.items() if key.startswith(f"{number}/")}
    sizes, world = own["sizes"].astype(np.int64), own["world"]
    corners = own["corners"].astype(np.int64)
    if sizes.min(initial=3) < 3 or sizes.sum() != len(corners):
        raise MeshError(f"{path}: {arrays['names'][number]} has polygons without corners; export it again")
    positions = own["positions"].astype(np.float64) @ world[:, :3, :3] + world[:, 3:, :3]
    polygons = np.repeat(np.arange(len(sizes)), sizes)
    backwards = (2 * np.cumsum(sizes) - sizes - 1)[polygons] - np.arange(len(corners))
    triangles, owner, starts = cut_polygons(positions[0], sizes, corners[backwards])
    if (folded := np.flatnonzero(starts < 0)).size:
        raise MeshError(
            f"{path}: polygon {folded[0]} of {arrays['names'][number]} crosses itself, or is too concave to be "
            "cut; triangulate the mesh"
        )
    rows = {len(corners): backwards, positions.shape[1]: corners[backwards]}.get(len(own.get("uvs", ())))
    parts = np.full(len(sizes), "", object)
    for key, faces in own.items():
        if key.startswith("part/"):
            parts[faces] = key.removeprefix("part/")
    return (
        positions,
        corners[backwards][triangles],
        None if rows is None else own["uvs"].astype(np.float64)[rows][triangles],
        list(parts[owner]),
    )
