"""Small meshes that the geometry tests share."""

import itertools
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from cloth import grid_faces

GARMENTS = Path(__file__).parents[2] / "data" / "garments"


def make_tube(around=12, along=10, *, radius=0.15, length=0.6, flare=0.0, twist=0.0, depth=1.0):
    """An open tube around y, faces outwards; `twist` turns the rings, so that two meshes of a tube differ."""
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)
    height, angle = np.meshgrid(np.linspace(0, length, along), angle, indexing="ij")
    angle = angle + twist * height
    size = radius + flare * (length - height)
    positions = np.stack([size * np.cos(angle), height, depth * size * np.sin(angle)], axis=-1)
    return positions.reshape(-1, 3), grid_faces(along, around, is_closed=True)


def make_sheet(rows=6, columns=7, *, jitter=0.0, seed=0):
    """A sheet in the xy plane, facing +z, 0.1 m squares, with inner vertices moved at random."""
    x, y = np.meshgrid(np.arange(columns) * 0.1, np.arange(rows) * 0.1)
    positions = np.stack([x, y, np.zeros_like(x)], axis=-1)
    random = np.random.default_rng(seed)
    positions[1:-1, 1:-1] += random.uniform(-jitter, jitter, (rows - 2, columns - 2, 3))
    return positions.reshape(-1, 3), grid_faces(rows, columns)[:, ::-1]


def make_octahedron(size=0.3):
    """A closed octahedron, faces outwards."""
    positions = size * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
    faces = []
    for x, y, z in itertools.product((0, 1), (2, 3), (4, 5)):
        is_odd = (x + y + z) % 2  # 0 + 2 + 4 is even and runs counter-clockwise
        faces.append((x, z, y) if is_odd else (x, y, z))
    return positions, np.array(faces)


def permute(positions, faces, seed=0):
    """Renumber vertices and shuffle faces; returns also the old vertex of every new one."""
    random = np.random.default_rng(seed)
    old = random.permutation(len(positions))
    new = np.argsort(old)
    faces = new[faces][random.permutation(len(faces))]
    return positions[old], np.array([np.roll(face, random.integers(3)) for face in faces]), old


@pytest.fixture(params=["tube", "sheet", "octahedron", "permuted"])
def mesh(request):
    """Positions and faces of one small mesh after another."""
    if request.param == "permuted":
        return permute(*make_tube(7, 5))[:2]
    if request.param == "sheet":
        return make_sheet(jitter=0.03)
    return make_tube() if request.param == "tube" else make_octahedron()


@pytest.fixture(scope="session")
def builders():
    """The mesh builders, as attributes."""
    return SimpleNamespace(tube=make_tube, sheet=make_sheet, octahedron=make_octahedron, permute=permute)


@pytest.fixture(scope="session")
def garment_folder():
    """The folder of the bundled garments."""
    return GARMENTS
