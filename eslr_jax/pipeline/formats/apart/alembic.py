"""Write the meshes of an Alembic file as arrays; run by `formats/alembic.py`.

    python alembic.py FILE OUT.npz NAMES FRAMES

NAMES are of the meshes to read, with commas, or nothing for all; FRAMES is how many samples of each. Positions
stay in the space of the transforms above them, and corners in the order of the file. It imports NumPy and its
library alone, so that it starts at once.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import Any

import alembic3d  # noqa: F401  # pyright: ignore[reportMissingImports]: makes the types known
import numpy as np
from alembic3d import Abc, AbcGeom  # pyright: ignore[reportMissingImports]

MAX_POINTS = 1 << 28  # frames times vertices of all meshes
MAX_DEPTH = 100  # of objects in each other


def find_meshes(parent: Any, carriers: tuple[Any, ...] = ()) -> Iterator[tuple[str, Any, tuple[Any, ...]]]:
    """Yield name and object of each mesh, and the transforms that carry it, the innermost first.

    Programs put a mesh alone below a transform, which has the name that people see.
    """
    if len(carriers) > MAX_DEPTH:
        sys.exit("its objects stand too deep in each other; export it again")
    for child in parent.children:
        header, above = child.getHeader(), carriers
        if AbcGeom.IXform.matches(header):
            transform = AbcGeom.IXform(parent, child.getName()).getSchema()
            above = (transform, *(carriers if transform.getInheritsXforms() else ()))
        elif AbcGeom.IPolyMesh.matches(header) or AbcGeom.ISubD.matches(header):
            is_alone = bool(carriers) and parent.getNumChildren() == 1
            yield (parent if is_alone else child).getName(), child, carriers
        if not AbcGeom.IFaceSet.matches(header):
            yield from find_meshes(child, above)


def array(values: Any) -> np.ndarray:
    """Return a copy of an array of the library's, which lives no longer than its sample."""
    # An empty one has no buffer.
    return np.array(memoryview(values)) if len(values) else np.zeros(0, np.int32)


def carried(carriers: tuple[Any, ...], time: float) -> np.ndarray:
    """Return the matrix [4, 4] that carries row vectors out of all transforms at a time [s]."""
    matrix = np.eye(4)
    for transform in carriers:
        if transform.getNumSamples():
            local = transform.getValue(Abc.ISampleSelector(time)).getMatrix()
            matrix = matrix @ np.array([list(row) for row in local])
    return matrix


def read_mesh(entry: Any) -> dict[str, np.ndarray]:
    """Return what a mesh keeps: its polygons, texture coordinates, and the faces of each part."""
    geometry = Abc.ICompoundProperty(entry.getProperties(), ".geom")
    arrays = {}
    for key, name in (("sizes", ".faceCounts"), ("corners", ".faceIndices")):
        polygons = Abc.IInt32ArrayProperty(geometry, name)
        arrays[key] = array(polygons.getValue(0))
        if not polygons.isConstant() and any(
            not np.array_equal(arrays[key], array(polygons.getValue(sample)))
            for sample in range(1, polygons.getNumSamples())
        ):
            sys.exit(f"the faces of {entry.getFullName()} change over time; a sequence keeps its topology")
    if "uv" in [header.getName() for header in geometry.propertyheaders]:
        arrays["uvs"] = array(AbcGeom.IV2fGeomParam(geometry, "uv").getExpandedValue().getVals())
    for child in entry.children:
        if AbcGeom.IFaceSet.matches(child.getHeader()):
            faces = Abc.ICompoundProperty(child.getProperties(), ".faceset")
            arrays[f"part/{child.getName()}"] = array(Abc.IInt32ArrayProperty(faces, ".faces").getValue(0))
    return arrays


def main(path: str, out: str, names: str, frames: str) -> None:
    """Read the meshes of some names, or all, and write them."""
    archive = Abc.IArchive(path)
    found = list(find_meshes(archive.getTop()))
    known = ", ".join(name for name, *_ in found) or "none"
    wanted = [name for name in names.split(",") if name]
    if lost := [name for name in wanted if name not in {name for name, *_ in found}]:
        sys.exit(f"no mesh is named {' or '.join(lost)}; it has {known}")
    chosen = [mesh for mesh in found if not wanted or mesh[0] in wanted]
    if not chosen:
        sys.exit("it has no polygon meshes; export the meshes, not curves, points or a rig")
    points = [
        Abc.IP3fArrayProperty(Abc.ICompoundProperty(entry.getProperties(), ".geom"), "P")
        for _, entry, _ in chosen
    ]
    for (_, entry, _), track in zip(chosen, points, strict=True):
        if not track.getNumSamples() or not len(track.getValue(0)):
            sys.exit(f"{entry.getFullName()} has no vertices; leave it out of the export")
    moving = [*points, *(transform for *_, carriers in chosen for transform in carriers)]
    longest = max(moving, key=lambda track: track.getNumSamples())
    count = min(longest.getNumSamples(), int(frames))
    times = [longest.getTimeSampling().getSampleTime(sample) for sample in range(count)]
    if count * sum(len(track.getValue(0)) for track in points) > MAX_POINTS:
        sys.exit(f"it holds more than {MAX_POINTS} points over time; name one mesh, or reduce it")
    arrays = {"names": np.array([name for name, *_ in chosen]), "times": np.array(times)}
    for number, ((_, entry, carriers), track) in enumerate(zip(chosen, points, strict=True)):
        arrays |= {f"{number}/{key}": values for key, values in read_mesh(entry).items()}
        samples = [array(track.getValue(Abc.ISampleSelector(time))) for time in times]
        if len({sample.shape for sample in samples}) > 1:
            sys.exit(f"the vertices of {entry.getFullName()} change over time; a sequence keeps its topology")
        arrays[f"{number}/positions"] = np.stack(samples)
        arrays[f"{number}/world"] = np.stack([carried(carriers, time) for time in times])
    np.savez(out, **arrays)


if __name__ == "__main__":
    main(*sys.argv[1:])
