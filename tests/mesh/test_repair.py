"""Meshes as programs export them become one clean surface."""

import numpy as np
import pytest
from cloth import grid_faces

from eslr_jax import MeshError
from eslr_jax.mesh.topology import face_areas, vertex_components
from eslr_jax.mesh.validate import validate_mesh, validate_orientation
from eslr_jax.pipeline.assets import asset_names, load_garment_file
from eslr_jax.pipeline.dressing.repair import consistent_orientation, join_components, largest_component, weld


def grid(columns, rows, spacing=0.1):
    x, y = np.meshgrid(np.arange(columns) * spacing, np.arange(rows) * spacing)
    positions = np.stack([x.ravel(), y.ravel(), 0.02 * np.sin(9 * x.ravel())], axis=1)
    return positions, grid_faces(rows, columns)[:, ::-1]


def cut_along_seam(positions, faces, is_right):
    """Give the faces on the right their own copies of the vertices they share with the left."""
    shared = np.intersect1d(faces[is_right], faces[~is_right])
    copy = np.arange(len(positions))
    copy[shared] = len(positions) + np.arange(len(shared))
    faces = faces.copy()
    faces[is_right] = copy[faces[is_right]]
    return np.concatenate([positions, positions[shared]]), faces, shared


def test_weld_undoes_a_seam_exactly_and_maps_vertices():
    positions, faces = grid(6, 5)
    is_right = positions[faces].mean(axis=1)[:, 0] > 0.25
    cut, cut_faces, shared = cut_along_seam(positions, faces, is_right)
    noisy = cut + 1e-8 * np.arange(len(cut))[:, None]
    clean = weld(noisy, cut_faces)
    np.testing.assert_array_equal(clean.faces, faces)
    np.testing.assert_allclose(clean.positions, positions, atol=1e-6)
    np.testing.assert_array_equal(clean.vertex_map, [*range(len(positions)), *shared])
    assert vertex_components(clean.faces, len(clean.positions))[0] == 1


def test_weld_of_triangle_soup():
    positions, faces = grid(5, 4)
    clean = weld(positions[faces].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3))
    validate_mesh(clean.positions, clean.faces)
    assert len(clean.positions) == len(positions)


def test_weld_leaves_layers_that_touch():
    positions, faces = grid(5, 5)
    both = np.concatenate([positions, positions * [1, 1, 0] + [0, 0, 0.5]])
    both[25 + 12] = both[12]  # the middle of one layer lies on the other's
    clean = weld(both, np.concatenate([faces, faces + 25]))
    assert len(clean.positions) == 50


def test_weld_drops_loose_vertices_and_repeated_and_collapsed_faces():
    positions, faces = grid(4, 4)
    positions = np.concatenate([[[9.0, 9.0, 9.0]], positions])
    faces = np.concatenate([faces + 1, faces[:1, [1, 2, 0]] + 1, [[3, 3, 4]]])
    clean = weld(positions, faces)
    assert clean.vertex_map[0] == -1
    np.testing.assert_array_equal(clean.faces, faces[:18] - 1)
    np.testing.assert_array_equal(clean.face_source, np.arange(18))


def test_parts_are_joined_across_a_gap():
    positions, faces = grid(6, 5)
    is_right = positions[faces].mean(axis=1)[:, 0] > 0.25
    cut, cut_faces, _ = cut_along_seam(positions, faces, is_right)
    cut[np.unique(cut_faces[is_right])] += [0.004, 0, 0]
    assert vertex_components(cut_faces, len(cut))[0] == 2
    joined = join_components(cut, cut_faces, 0.005)
    validate_mesh(joined.positions, joined.faces)
    assert len(joined.positions) == len(positions)
    apart = join_components(cut, cut_faces, 0.003)
    assert len(apart.positions) == len(cut)


def test_parts_with_different_edges_are_joined_without_holes():
    left, left_faces = grid(3, 5)
    right, right_faces = grid(3, 9, spacing=0.05)
    right = right * [1, 1, 0] + [left[:, 0].max(), 0, left[2, 2]]
    positions = np.concatenate([left, right])
    joined = join_components(positions, np.concatenate([left_faces, right_faces + len(left)]), 0.06)
    validate_mesh(joined.positions, joined.faces)


def test_largest_part_is_kept():
    positions, faces = grid(4, 4)
    small, small_faces = grid(2, 2)
    kept = largest_component(np.concatenate([small + 5, positions]), np.concatenate([small_faces, faces + 4]))
    np.testing.assert_array_equal(kept.faces, faces)
    np.testing.assert_array_equal(kept.vertex_map[:4], -1)


@pytest.mark.parametrize("share", [0.1, 0.4])
def test_turned_faces_are_found(share):
    positions, faces = grid(9, 8)
    flipped = np.random.default_rng(1).random(len(faces)) < share
    broken = faces.copy()
    broken[flipped] = broken[flipped][:, ::-1]
    turn = consistent_orientation(positions, broken)
    np.testing.assert_array_equal(turn, flipped)
    validate_mesh(positions, np.where(turn[:, None], broken[:, ::-1], broken))


def test_each_part_keeps_the_side_of_most_of_its_area():
    positions, faces = grid(5, 4)
    both = np.concatenate([faces, faces[:, ::-1] + len(positions)])
    both[0] = both[0][::-1]
    both[-1] = both[-1][::-1]
    turn = consistent_orientation(np.concatenate([positions, positions + 3]), both)
    assert np.flatnonzero(turn).tolist() == [0, len(both) - 1]


def test_surface_with_one_side_is_left_as_it_is():
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    width = np.array([-0.2, 0.2])[:, None]
    radius = 1 + width * np.cos(angle / 2)
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle), width * np.sin(angle / 2)], axis=-1)
    low, high = np.arange(12), np.arange(12, 24)
    after, above = np.append(low[1:], 12), np.append(high[1:], 0)
    faces = np.concatenate([np.stack([low, after, high], 1), np.stack([after, above, high], 1)])
    assert not consistent_orientation(ring.reshape(-1, 3), faces).any()
    assert face_areas(ring.reshape(-1, 3), faces).min() > 0


# --- every way in which a mesh can be broken is told by its place -------------------------------------------

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
    for positions, faces in (builders.tube(), builders.tube(flare=0.3), builders.icosahedron()):
        validate_orientation(positions, faces)
        with pytest.raises(MeshError, match="point inside; flip"):
            validate_orientation(positions, faces[:, ::-1])


def test_open_sheet_has_no_inside(builders):
    positions, faces = builders.sheet(jitter=0.4)
    validate_orientation(positions, faces)
    validate_orientation(positions, faces[:, ::-1])


def test_bundled_garments_are_not_inside_out():
    for name in {name.rsplit("_", 1)[0] for name in asset_names("garment")}:
        garment = load_garment_file(name)
        validate_orientation(garment.rest_positions, garment.faces, name=name)
        with pytest.raises(MeshError, match="inside"):
            validate_orientation(garment.rest_positions, garment.faces[:, ::-1], name=name)
