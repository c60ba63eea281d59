"""Small meshes that the geometry tests share."""

from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from cloth import grid_faces, make_sheet


def make_tube(around=12, along=10, *, radius=0.15, length=0.6, flare=0.0, twist=0.0, depth=1.0):
    """An open tube around y, faces outwards; `twist` turns the rings, so that two meshes of a tube differ."""
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)
    height, angle = np.meshgrid(np.linspace(0, length, along), angle, indexing="ij")
    angle = angle + twist * height
    size = radius + flare * (length - height)
    positions = np.stack([size * np.cos(angle), height, depth * size * np.sin(angle)], axis=-1)
    return positions.reshape(-1, 3), grid_faces(along, around, is_closed=True)


def make_icosahedron():
    """A closed icosahedron with corners 0.3 m from the origin, faces outwards."""
    solid = trimesh.creation.icosphere(subdivisions=0, radius=0.3)
    return np.array(solid.vertices), np.array(solid.faces)


def permute(positions, faces, seed=0):
    """Renumber vertices and shuffle faces; returns also the old vertex of every new one."""
    random = np.random.default_rng(seed)
    old = random.permutation(len(positions))
    new = np.argsort(old)
    faces = new[faces][random.permutation(len(faces))]
    return positions[old], np.array([np.roll(face, random.integers(3)) for face in faces]), old


MESHES = {
    "tube": make_tube(),
    "sheet": make_sheet(spacing=0.1),
    "icosahedron": make_icosahedron(),
    "permuted": permute(*make_tube(7, 5))[:2],
}


@pytest.fixture(params=MESHES)
def mesh(request):
    """Positions and faces of one small mesh after another."""
    return MESHES[request.param]


@pytest.fixture(scope="session")
def builders():
    """The mesh builders, as attributes."""
    sheet = partial(make_sheet, spacing=0.1, jitter=0)
    return SimpleNamespace(tube=make_tube, sheet=sheet, icosahedron=make_icosahedron, permute=permute)
