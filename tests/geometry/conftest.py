"""Small meshes that the geometry tests share."""

import itertools
from pathlib import Path

import numpy as np
import pytest

GARMENTS = Path(__file__).parents[2] / "data" / "garments"


def make_tube(around=12, along=10, *, radius=0.15, length=0.6, flare=0.0, twist=0.0, depth=1.0):
    """An open tube around y, faces outwards; `twist` turns the rings, so that two meshes of a tube differ."""
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)
    height = np.linspace(0, length, along)
    angle, height = np.meshgrid(angle, height, indexing="ij")
    angle = angle + twist * height
    size = radius + flare * (length - height)
    positions = np.stack([size * np.cos(angle), height, depth * size * np.sin(angle)], axis=-1).reshape(-1, 3)
    index = np.arange(around * along).reshape(around, along)
    a, b = index[:, :-1].ravel(), np.roll(index, -1, axis=0)[:, :-1].ravel()
    c, d = np.roll(index, -1, axis=0)[:, 1:].ravel(), index[:, 1:].ravel()
    return positions, np.concatenate([np.stack([a, c, b], 1), np.stack([a, d, c], 1)])


def make_sheet(rows=6, columns=7, *, jitter=0.0, seed=0):
    """A sheet in the xy plane, facing +z, 0.1 m squares, with inner vertices moved at random."""
    x, y = np.meshgrid(np.arange(columns) * 0.1, np.arange(rows) * 0.1)
    positions = np.stack([x, y, np.zeros_like(x)], axis=-1)
    random = np.random.default_rng(seed)
    positions[1:-1, 1:-1] += random.uniform(-jitter, jitter, (rows - 2, columns - 2, 3))
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    return positions.reshape(-1, 3), np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


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
    return {"tube": make_tube, "sheet": lambda: make_sheet(jitter=0.03), "octahedron": make_octahedron}[
        request.param
    ]()


@pytest.fixture(scope="session")
def builders():
    """The mesh builders, as attributes."""
    return type(
        "Builders",
        (),
        {
            "tube": staticmethod(make_tube),
            "sheet": staticmethod(make_sheet),
            "octahedron": staticmethod(make_octahedron),
            "permute": staticmethod(permute),
        },
    )


@pytest.fixture(scope="session")
def garment_folder():
    """The folder of the bundled garments."""
    return GARMENTS
