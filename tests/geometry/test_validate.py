"""Every way in which a mesh can be broken gets its own message, with the place and the remedy."""

import numpy as np
import pytest

from eslr_jax.errors import MeshError
from eslr_jax.geometry.validate import validate_mesh, validate_orientation

SHEET_FACES = np.array([[0, 1, 3], [1, 4, 3], [1, 2, 4], [2, 5, 4]])
SHEET = np.array([[x, y, 0.0] for y in (0.0, 0.3) for x in (0.0, 0.3, 0.6)])


def with_nan(positions):
    positions = positions.copy()
    positions[4, 1] = np.nan
    return positions


BROKEN = {
    "empty": (np.zeros((0, 3)), SHEET_FACES[:0], "empty mesh .0 vertices, 0 faces."),
    "no faces": (SHEET, SHEET_FACES[:0], "empty mesh .6 vertices, 0 faces."),
    "flat positions": (SHEET[:, :2], SHEET_FACES, r"positions have shape \(6, 2\)"),
    "quads": (SHEET, np.array([[0, 1, 4, 3]]), r"faces have shape \(1, 4\).*triangulate"),
    "float faces": (SHEET, SHEET_FACES.astype(float), "dtype float64; give integer"),
    "nan": (with_nan(SHEET), SHEET_FACES, "vertex 4 is not finite"),
    "index": (SHEET, np.array([[0, 1, 3], [1, 9, 3]]), r"face 1 \(1, 9, 3\) names a vertex outside 0..5"),
    "negative index": (SHEET, np.array([[0, -1, 3]]), r"face 0 \(0, -1, 3\) names a vertex outside"),
    "zero area": (
        np.concatenate([SHEET, [[0.9, 0, 0]]]),
        np.concatenate([SHEET_FACES, [[1, 6, 2]]]),
        r"face 4 \(1, 6, 2\) has no area",
    ),
    "repeated corner": (SHEET, np.concatenate([SHEET_FACES, [[0, 0, 3]]]), r"face 4 \(0, 0, 3\) has no area"),
    "duplicate face": (
        SHEET,
        np.concatenate([SHEET_FACES, [[3, 0, 1]]]),
        "faces 0 and 4 are the same triangle",
    ),
    "non-manifold edge": (
        np.concatenate([SHEET, [[0.3, 0.1, 0.3]]]),
        np.concatenate([SHEET_FACES, [[1, 4, 6]]]),
        r"edge \(1, 4\) belongs to 3 faces \(1, 2, 4\)",
    ),
    "bow tie": (
        np.concatenate([SHEET, [[0.7, 0.7, 0], [0.5, 0.7, 0]]]),
        np.concatenate([SHEET_FACES, [[5, 6, 7]]]),
        "2 fans of faces meet only at vertex 5",
    ),
    "orientation": (
        SHEET,
        np.array([[0, 1, 3], [1, 4, 3], [1, 4, 2], [2, 5, 4]]),
        "faces . and . wind in opposite",
    ),
    "loose vertex": (
        np.concatenate([SHEET, [[0.1, 0.1, 0.1]]]),
        SHEET_FACES,
        "1 vertices belong to no face.*vertex 6",
    ),
    "duplicate vertex": (
        np.concatenate([SHEET, SHEET[5:] + 1e-8]),
        np.array([[0, 1, 3], [1, 4, 3], [1, 2, 4], [2, 6, 4], [5, 4, 6]]),
        "vertices 5 and 6 coincide.*merge vertices",
    ),
    "components": (
        np.concatenate([SHEET, SHEET + np.array([0, 0, 0.3])]),
        np.concatenate([SHEET_FACES, SHEET_FACES + 6]),
        r"2 separate components \(sizes 6, 6; vertex \d+ is not connected",
    ),
    "centimetres": (SHEET * 100, SHEET_FACES, "in cm: scale by 0.01"),
    "millimetres": (SHEET * 1000, SHEET_FACES, "in mm: scale by 0.001"),
    "inches": (SHEET * 39.37 * 1.5, SHEET_FACES, "in in: scale by 0.0254"),
    "kilometres": (SHEET / 1000, SHEET_FACES, "scale by about 1000"),
    "point": (SHEET * 0, SHEET_FACES, "positions must be in metres"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_mesh_is_named(name):
    positions, faces, message = BROKEN[name]
    with pytest.raises(MeshError, match=message) as caught:
        validate_mesh(positions, faces, name="scarf")
    text = str(caught.value)
    assert text.startswith("scarf: ")
    assert "\n" not in text


def test_sound_meshes_pass(mesh):
    validate_mesh(*mesh)
    validate_orientation(*mesh)
    validate_mesh(mesh[0].astype(np.float32), mesh[1].astype(np.uint32))


def test_components_may_be_allowed():
    positions, faces, _ = BROKEN["components"]
    validate_mesh(positions, faces, allow_components=True)


def test_inside_out_mesh_is_named(builders):
    for positions, faces in (builders.tube(), builders.tube(flare=0.3), builders.octahedron()):
        validate_orientation(positions, faces)
        with pytest.raises(MeshError, match="point inside; flip"):
            validate_orientation(positions, faces[:, ::-1])


def test_open_sheet_has_no_inside(builders):
    positions, faces = builders.sheet(jitter=0.05)
    validate_orientation(positions, faces)
    validate_orientation(positions, faces[:, ::-1])


def test_bundled_garments_are_sound(garment_folder):
    for path in sorted(garment_folder.glob("*_1k.npz")):
        with np.load(path) as arrays:
            positions, faces = arrays["rest_positions"], arrays["faces"]
        validate_mesh(positions, faces, name=path.stem)
        validate_orientation(positions, faces, name=path.stem)
        with pytest.raises(MeshError, match="inside"):
            validate_orientation(positions, faces[:, ::-1], name=path.stem)
