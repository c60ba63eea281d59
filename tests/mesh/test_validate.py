"""Every way in which a mesh can be broken is told by its place."""

import numpy as np
import pytest

from eslr_jax import MeshError
from eslr_jax.mesh.validate import validate_mesh, validate_orientation
from eslr_jax.pipeline.assets import asset_names, load_garment_file

SHEET_FACES = np.array([[0, 1, 3], [1, 4, 3], [1, 2, 4], [2, 5, 4]])
SHEET = np.array([[x, y, 0.0] for y in (0.0, 0.3) for x in (0.0, 0.3, 0.6)])


def more(faces, positions=()):
    """Return the sheet with further faces and vertices."""
    return np.concatenate([SHEET, np.reshape(positions, (-1, 3))]), np.concatenate([SHEET_FACES, faces])


TWO_SHEETS = np.concatenate([SHEET, SHEET + np.eye(3)[2]]), np.concatenate([SHEET_FACES, SHEET_FACES + 6])
BROKEN = [  # a mesh, and what its message names
    (np.zeros((0, 3)), SHEET_FACES[:0], "0 vertices, 0 faces"),
    (SHEET, SHEET_FACES[:0], "6 vertices, 0 faces"),
    (SHEET[:, :2], SHEET_FACES, r"\(6, 2\)"),
    (SHEET, np.array([[0, 1, 4, 3]]), "triangulate"),
    (SHEET, SHEET_FACES.astype(float), "float64"),
    (np.where(np.arange(6)[:, None] == 4, np.nan, SHEET), SHEET_FACES, "vertex 4 is not finite"),
    (SHEET, np.array([[0, 1, 3], [1, 9, 3]]), r"face 1 \(1, 9, 3\).* outside 0..5"),
    (SHEET, np.array([[0, -1, 3]]), r"face 0 \(0, -1, 3\).* outside"),
    (*more([[1, 6, 2]], [0.9, 0, 0]), r"face 4 \(1, 6, 2\) has no area"),
    (*more([[0, 0, 3]]), r"face 4 \(0, 0, 3\) has no area"),
    (*more([[3, 0, 1]]), "faces 0 and 4 are the same"),
    (*more([[1, 4, 6]], [0.3, 0.1, 0.3]), r"edge \(1, 4\) belongs to 3 faces \(1, 2, 4\)"),
    (*more([[5, 6, 7]], [[0.7, 0.7, 0], [0.5, 0.7, 0]]), "2 fans .* vertex 5"),
    (SHEET, np.array([[0, 1, 3], [1, 4, 3], [1, 4, 2], [2, 5, 4]]), "wind in opposite"),
    (*more(SHEET_FACES[:0], [0.1, 0.1, 0.1]), "no face.*vertex 6"),
    (
        np.concatenate([SHEET, SHEET[5:] + 1e-8]),
        np.array([[0, 1, 3], [1, 4, 3], [1, 2, 4], [2, 6, 4], [5, 4, 6]]),
        "vertices 5 and 6 coincide",
    ),
    (*TWO_SHEETS, "2 separate components .sizes 6, 6;"),
    (SHEET * 100, SHEET_FACES, "in cm: scale by 0.01"),
    (SHEET * 1000, SHEET_FACES, "in mm: scale by 0.001"),
    (SHEET * 39.37 * 1.5, SHEET_FACES, "in in: scale by 0.0254"),
    (SHEET / 1000, SHEET_FACES, "scale by about 1000"),
    (SHEET * 0, SHEET_FACES, "in metres"),
]


@pytest.mark.parametrize(("positions", "faces", "named"), BROKEN)
def test_broken_mesh_is_named_in_one_line(positions, faces, named):
    with pytest.raises(MeshError, match=f"^scarf: .*{named}") as caught:
        validate_mesh(positions, faces, name="scarf")
    assert "\n" not in str(caught.value)


def test_sound_meshes_pass(mesh):
    validate_mesh(*mesh)
    validate_orientation(*mesh)
    validate_mesh(mesh[0].astype(np.float32), mesh[1].astype(np.uint32))


def test_components_may_be_allowed():
    validate_mesh(*TWO_SHEETS, allow_components=True)


def test_inside_out_mesh_is_named(builders):
    for positions, faces in (builders.tube(), builders.tube(flare=0.3), builders.octahedron()):
        validate_orientation(positions, faces)
        with pytest.raises(MeshError, match="point inside; flip"):
            validate_orientation(positions, faces[:, ::-1])


def test_open_sheet_has_no_inside(builders):
    positions, faces = builders.sheet(jitter=0.05)
    validate_orientation(positions, faces)
    validate_orientation(positions, faces[:, ::-1])


def test_bundled_garments_are_not_inside_out():
    for name in {name.rsplit("_", 1)[0] for name in asset_names("garment")}:
        garment = load_garment_file(name)
        validate_orientation(garment.rest_positions, garment.faces, name=name)
        with pytest.raises(MeshError, match="inside"):
            validate_orientation(garment.rest_positions, garment.faces[:, ::-1], name=name)
