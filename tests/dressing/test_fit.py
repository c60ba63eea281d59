"""A user's garment on the body: recognised, cleaned, taken out, skinned, pinned."""

import dataclasses

import numpy as np
import pytest
import trimesh
from garment_files import TO_Z_UP, bundled, cut_apart, dent, scanned_tshirt, source
from garment_shapes import rings

from eslr_jax import ConfigError, MeshError, prepare_garment
from eslr_jax.mesh.topology import boundary_loops
from eslr_jax.pipeline.dressing.fit import fit_garment
from eslr_jax.pipeline.dressing.options import FitOptions
from eslr_jax.pipeline.dressing.postures import arm_postures
from eslr_jax.pipeline.dressing.report import describe_fit
from eslr_jax.pipeline.formats.garment import read_garment_source

GIVEN = {"units": "m", "up": "y", "front": "z", "keep_place": True, "arms": "rest"}  # nothing to recognise


def count_parts(garment):
    return trimesh.Trimesh(garment.rest_positions, garment.faces, process=False).body_count


@pytest.fixture(scope="module")
def shirt():
    return bundled("tshirt_1k")


@pytest.mark.parametrize(("name", "scale", "axes", "unit"), [
    ("dress_1k", 100.0, TO_Z_UP, 0.01),
    ("pants_1k", 1000.0, np.eye(3), 0.001),
    ("longsleeve_1k", 1 / 0.0254, TO_Z_UP, 0.0254),
])  # fmt: skip
@pytest.mark.parametrize("stands_on_floor", [False, True])
def test_units_and_axes_are_recognised_exactly(body, name, scale, axes, unit, stands_on_floor):
    garment = bundled(name)
    shift = [0.0, float(body.rest_positions[:, 1].min()) * stands_on_floor, 0.0]
    fitted = fit_garment(source((garment.rest_positions - shift) @ axes.T * scale, garment.faces), body)
    assert fitted.metadata["fit"]["placement"]["metres_per_unit"] == unit
    np.testing.assert_allclose(fitted.sewn_positions, garment.rest_positions, atol=1e-6)
    np.testing.assert_array_equal(fitted.faces, garment.faces)


@pytest.mark.parametrize("name", ["tank_1k", "shorts_1k"])
def test_garment_anywhere_is_moved_onto_the_body(body, name):
    garment = bundled(name)
    centered = (garment.rest_positions - garment.rest_positions.mean(axis=0)) @ TO_Z_UP.T * 100
    fitted = fit_garment(source(centered, garment.faces), body)
    gap = fitted.sewn_positions - garment.rest_positions
    assert np.linalg.norm(gap.mean(axis=0)) < 0.03
    np.testing.assert_allclose(gap - gap.mean(axis=0), 0.0, atol=1e-6)
    assert fitted.metadata["fit"]["penetration"]["after"]["inside"] == 0


def test_what_is_given_is_not_recognised(body, shirt):
    backwards = shirt.rest_positions * [-1, 1, -1]
    fitted = fit_garment(source(backwards, shirt.faces), body, FitOptions(front="-z"))
    np.testing.assert_allclose(fitted.sewn_positions, shirt.rest_positions, atol=1e-9)
    higher = shirt.rest_positions + np.array([0, 0.02, 0])
    kept = fit_garment(source(higher, shirt.faces), body, FitOptions(keep_place=True))
    np.testing.assert_allclose(kept.sewn_positions, higher, atol=1e-9)
    with pytest.raises(MeshError, match="give eslr fit --up and --front"):
        fit_garment(source(higher + 3.0, shirt.faces), body, FitOptions(keep_place=True, units="m"))
    with pytest.raises(MeshError, match="same axis"):
        fit_garment(source(shirt.rest_positions, shirt.faces), body, FitOptions(up="z", front="-z"))


def test_the_unit_of_a_format_is_named_and_the_given_one_wins(body, shirt):
    written = source(100.0 * shirt.rest_positions, shirt.faces, is_metric=True)  # a GLB in centimetres
    with pytest.raises(MeshError, match=r"prescribes metres and y up.*give eslr fit --units and --up and"):
        fit_garment(written, body, FitOptions(arms="rest"))
    fitted = fit_garment(written, body, FitOptions(arms="rest", units="cm", front="z"))
    assert fitted.metadata["fit"]["placement"]["metres_per_unit"] == 0.01
    np.testing.assert_allclose(fitted.sewn_positions, shirt.rest_positions, atol=1e-9)


@pytest.mark.parametrize("index", [1, 3])
def test_garment_of_another_arm_pose_is_turned_to_the_bodys(body, index):
    shirt, posture = bundled("longsleeve_1k"), arm_postures(body)[index]
    blended = np.einsum("vi,vixy->vxy", shirt.skin_weights, posture.transforms[shirt.skin_indices])
    worn = np.einsum("vxy,vy->vx", blended[:, :, :3], shirt.rest_positions) + blended[:, :, 3]
    fitted = fit_garment(source(worn, shirt.faces), body)
    assert fitted.metadata["fit"]["placement"]["arms_below_horizontal_deg"] == posture.arm_angle
    off = np.linalg.norm(fitted.rest_positions - shirt.rest_positions, axis=1)
    assert np.sqrt(np.mean(off**2)) < 0.015  # the armpits' skin weights are not the maker's
    np.testing.assert_allclose(fitted.sewn_positions, worn, atol=1e-9)  # lengths stay those of the file


def test_penetration_is_resolved_and_reported_and_lengths_stay(body, shirt):
    positions, count = dent(shirt, body, 0.005)
    fitted = fit_garment(source(positions, shirt.faces), body)
    report = fitted.metadata["fit"]["penetration"]
    assert report["before"]["inside"] >= count
    assert report["before"]["depth_max_mm"] == pytest.approx(5.0, abs=0.3)
    assert report["after"] == {"inside": 0, "depth_max_mm": 0.0, "deeper": 0}
    assert 7.0 < report["push_out"]["moved_max_mm"] < 12.0
    back = positions[:, 2] < 0
    np.testing.assert_array_equal(fitted.rest_positions[back], positions[back])
    np.testing.assert_array_equal(fitted.sewn_positions, positions)
    kept = fit_garment(source(positions, shirt.faces), body, FitOptions(push_out=False))
    np.testing.assert_array_equal(kept.rest_positions, positions)


def test_prepared_garment_measures_the_sewn_shape(shirt):
    options = dict(skin_weights=shirt.skin_weights, skin_indices=shirt.skin_indices)
    plain = prepare_garment(shirt.rest_positions, shirt.faces, **options)
    larger = prepare_garment(
        shirt.rest_positions, shirt.faces, sewn_positions=1.1 * shirt.rest_positions, **options
    )
    np.testing.assert_allclose(larger.rest_areas, 1.21 * plain.rest_areas, rtol=1e-4)
    np.testing.assert_allclose(
        larger.inverse_rest_frames, plain.inverse_rest_frames / 1.1, rtol=1e-3, atol=1e-3
    )
    np.testing.assert_array_equal(larger.rest_positions, plain.rest_positions)
    with pytest.raises(MeshError, match="do not fit"):
        prepare_garment(shirt.rest_positions, shirt.faces, sewn_positions=np.ones((999, 3)), **options)


def test_scanned_shirt_is_whole_again(tmp_path, body, shirt):
    fitted = fit_garment(read_garment_source(scanned_tshirt(tmp_path / "shirt.obj", body)), body)
    report = fitted.metadata["fit"]
    assert len(fitted.rest_positions) == len(shirt.rest_positions)
    assert report["mesh"]["welded_vertices"] > 50
    assert report["mesh"]["loose_vertices"] == 1
    assert report["placement"]["metres_per_unit"] == 0.01
    assert (report["placement"]["up"], report["placement"]["front"]) == ("z", "-y")
    assert count_parts(fitted) == 1
    assert fitted.vertex_map[0] == -1
    assert set(fitted.part_names) == {"back", "front", "left_sleeve", "right_sleeve"}
    assert fitted.corner_uvs.shape == (len(fitted.faces), 3, 2)
    sleeve = fitted.face_parts == fitted.part_names.index("left_sleeve")
    assert fitted.rest_positions[fitted.faces[sleeve]].mean(axis=1)[:, 0].min() > 0.19


def test_inside_out_and_mixed_faces_are_turned_with_their_texture(body, shirt):
    faces = shirt.faces.copy()
    faces[5:] = faces[5:, ::-1]
    uvs = np.arange(faces.size * 2, dtype=float).reshape(-1, 3, 2)
    fitted = fit_garment(source(shirt.rest_positions, faces, corner_uvs=uvs), body)
    np.testing.assert_array_equal(fitted.faces[5:], shirt.faces[5:])
    np.testing.assert_array_equal(fitted.corner_uvs[5:], uvs[5:, ::-1])
    np.testing.assert_array_equal(fitted.corner_uvs[:5], uvs[:5])
    assert fitted.metadata["fit"]["mesh"]["turned_faces"] == len(faces) - 5


@pytest.mark.parametrize(("gap", "components", "is_sewn"), [
    (1e-3, "auto", True), (5e-3, "auto", False), (1e-3, "keep", False),
])  # fmt: skip
def test_pieces_whose_seams_were_left_open_are_sewn(body, shirt, gap, components, is_sewn):
    """As programs export a pattern that was not welded: front and back, with a gap between them."""
    is_back = shirt.rest_positions[shirt.faces].mean(axis=1)[:, 2] < 0
    pieces = cut_apart(shirt.rest_positions, shirt.faces, is_back, [0.0, 0.0, -gap])
    fitted = fit_garment(source(*pieces), body, FitOptions(components=components))
    told = " ".join(fitted.metadata["fit"]["warnings"])
    assert ("pieces whose edges lie within 1 cm" in told) == (components == "auto" and not is_sewn)
    if is_sewn:
        assert len(fitted.rest_positions) == len(shirt.rest_positions)
        assert len(fitted.faces) == len(shirt.faces)


def test_a_double_sided_mesh_is_one_layer(body, shirt):
    count = len(shirt.rest_positions)
    both = np.concatenate([shirt.faces, shirt.faces[:, ::-1] + count])
    fitted = fit_garment(source(np.tile(shirt.rest_positions, (2, 1)), both), body)
    np.testing.assert_allclose(fitted.sewn_positions, shirt.rest_positions, atol=1e-9)
    assert len(fitted.faces) == len(shirt.faces)
    assert fitted.metadata["fit"]["warnings"] == []


def test_a_thick_shell_is_doubted(body, shirt):
    """A shirt that was exported with 2 mm of thickness: two layers, sewn along their edges."""
    count = len(shirt.rest_positions)
    outer = trimesh.Trimesh(shirt.rest_positions, shirt.faces, process=False)
    inner = outer.vertices - 0.002 * outer.vertex_normals
    rims = [np.stack([loop, np.roll(loop, -1)], axis=1) for loop in boundary_loops(shirt.faces)]
    start, end = np.concatenate(rims).T
    rim = np.concatenate(
        [np.stack([start, start + count, end], 1), np.stack([end, start + count, end + count], 1)]
    )
    faces = np.concatenate([shirt.faces, shirt.faces[:, ::-1] + count, rim[:, ::-1]])
    fitted = fit_garment(source(np.concatenate([shirt.rest_positions, inner]), faces), body)
    assert any("two sides 2.0 mm apart" in text for text in fitted.metadata["fit"]["warnings"])


@pytest.mark.parametrize(("components", "parts"), [("keep", 2), ("join", 1), ("largest", 1)])
def test_separate_parts(body, shirt, components, parts):
    is_left = shirt.rest_positions[shirt.faces].mean(axis=1)[:, 0] > 0
    cut = source(*cut_apart(shirt.rest_positions, shirt.faces, is_left, [0.006, 0, 0]))
    fitted = fit_garment(cut, body, FitOptions(components=components))
    assert count_parts(fitted) == parts
    if components == "join":
        assert len(fitted.faces) == len(shirt.faces)
    with pytest.raises(MeshError, match="2 separate components"):
        fit_garment(cut, body, FitOptions(components="refuse"))


def test_fitted_garment_has_the_pins_of_file_and_options(body, shirt):
    in_file = np.arange(len(shirt.rest_positions)) < 4
    options = FitOptions(pin=("vertices:3,9", "region:y>0.74"), **GIVEN)
    fitted = fit_garment(source(shirt.rest_positions, shirt.faces, is_pinned=in_file), body, options)
    expected = set(range(4)) | {9} | set(np.flatnonzero(shirt.rest_positions[:, 1] > 0.74))
    assert set(np.flatnonzero(fitted.is_pinned)) == expected
    assert fitted.metadata["fit"]["pinned"] == len(expected)


def test_pins_by_region_part_and_edge(body, shirt):
    parts = (np.arange(len(shirt.faces)) < 3).astype(int)
    cloth = source(shirt.rest_positions, shirt.faces, face_parts=parts, part_names=("body", "hem"))
    x, y, _ = shirt.rest_positions.T

    def pinned(text):
        return fit_garment(cloth, body, FitOptions(pin=(text,), push_out=False, **GIVEN)).is_pinned

    np.testing.assert_array_equal(pinned("region:y>0.6, x<-1e-3"), (y > 0.6) & (x < -1e-3))
    collar = pinned("loop:top")
    assert 10 < collar.sum() < 120
    assert y[collar].min() > 0.6
    assert x[pinned("loop:left")].min() > 0.2
    assert pinned("loop:0").sum() == pinned("loop:bottom").sum()
    assert set(np.flatnonzero(pinned("part:hem"))) == set(shirt.faces[:3].ravel())


def test_vertices_of_a_glb_are_counted_as_in_the_file(tmp_path, body, shirt):
    corners = shirt.faces.ravel()  # each corner a vertex of its own, as of flat shading
    flat = trimesh.Trimesh(
        shirt.rest_positions[corners], np.arange(len(corners)).reshape(-1, 3), process=False
    )
    flat.export(tmp_path / "shirt.glb")
    numbers = [4, 700, len(corners) - 1]
    options = FitOptions(arms="rest", pin=(f"vertices:{','.join(map(str, numbers))}",))
    fitted = fit_garment(read_garment_source(tmp_path / "shirt.glb"), body, options)
    assert fitted.vertex_map is not None
    assert len(fitted.vertex_map) == len(corners)
    np.testing.assert_allclose(
        fitted.sewn_positions[fitted.vertex_map], shirt.rest_positions[corners], atol=1e-6
    )
    assert set(np.flatnonzero(fitted.is_pinned)) == set(fitted.vertex_map[numbers])


@pytest.mark.parametrize(("pin", "message"), [
    ("collar", "is not understood"),
    ("vertices:a", "whole numbers"),
    ("vertices:99999", "vertices 0 to 999"),
    ("part:collar", "no such part"),
    ("region:y=3", "not a comparison"),
    ("region:y>9", "holds no vertex"),
    ("loop:9", "open edges 0 to 3"),
])  # fmt: skip
def test_impossible_pins_are_named(body, shirt, pin, message):
    options = FitOptions(pin=(pin,), push_out=False, **GIVEN)
    with pytest.raises(ConfigError, match=message):
        fit_garment(source(shirt.rest_positions, shirt.faces), body, options)


@pytest.mark.parametrize(("spoil", "message"), [
    (lambda p, f: (p * 0, f), "no face with an area is left"),
    (lambda p, f: (p * 1e9, f), "too large for a garment"),
    (lambda p, f: (p * 1e-9, f), "no garment's in"),
    (lambda p, f: (np.where(np.arange(len(p))[:, None] == 7, np.nan, p), f), "vertex 7 is not finite"),
    (lambda p, f: (p, f + 1), "names a vertex outside"),
    (lambda p, f: (p, f[:0]), "empty mesh"),
])  # fmt: skip
def test_meshes_beyond_repair_are_named(body, shirt, spoil, message):
    with pytest.raises(MeshError, match=message) as caught:
        fit_garment(source(*spoil(shirt.rest_positions, shirt.faces)), body, FitOptions(arms="rest"))
    assert "\n" not in str(caught.value)


def test_a_face_and_its_back_are_one(body, shirt):
    faces = np.concatenate([shirt.faces, shirt.faces[:1, [1, 0, 2]]])
    fitted = fit_garment(source(shirt.rest_positions, faces), body, FitOptions(**GIVEN))
    assert len(fitted.faces) == len(shirt.faces)


@pytest.mark.slow
@pytest.mark.parametrize("edge_length", [0.016, 0.03])
def test_remeshing_gives_the_wanted_edges_and_keeps_hems(body, shirt, edge_length):
    pytest.importorskip("pyacvd")
    fitted = fit_garment(source(shirt.rest_positions, shirt.faces), body, FitOptions(edge_length=edge_length))
    lengths = trimesh.Trimesh(fitted.sewn_positions, fitted.faces, process=False).edges_unique_length
    assert lengths.mean() == pytest.approx(edge_length, rel=0.12)
    assert lengths.max() < 2.5 * edge_length
    loops, before = boundary_loops(fitted.faces), boundary_loops(shirt.faces)
    assert len(loops) == len(before)
    low = min(fitted.sewn_positions[loop, 1].mean() for loop in loops)
    assert low == pytest.approx(min(shirt.rest_positions[loop, 1].mean() for loop in before), abs=2e-3)


def test_pins_that_remeshing_replaces_are_refused_or_told(body, shirt):
    pytest.importorskip("pyacvd")
    shirt_source = source(shirt.rest_positions, shirt.faces)
    with pytest.raises(ConfigError, match="counts vertices of the file, which edge_length replaces"):
        fit_garment(shirt_source, body, FitOptions(edge_length=0.03, pin=("vertices:0,5",)))
    held = dataclasses.replace(shirt_source, is_pinned=np.arange(len(shirt.rest_positions)) < 5)
    for pin in ((), ("loop:top",), ("none",)):
        told = fit_garment(held, body, FitOptions(edge_length=0.03, pin=pin)).fit_warnings
        assert any("the pins of the file are lost" in text for text in told) == (pin != ("none",))


def test_remeshed_hems_of_two_layers_with_one_middle_stay_apart(body):
    """A skirt and its lining, which one surface joins at the top."""
    pytest.importorskip("pyacvd")
    levels = [(0.8, 0.28, 0.28, 0.0), (1.0, 0.25, 0.25, 0.0), (1.0, 0.21, 0.21, 0.0), (0.8, 0.20, 0.20, 0.0)]
    options = FitOptions(edge_length=0.02, push_out=False, **GIVEN)
    fitted = fit_garment(source(*rings(levels, around=60, rows=4)), body, options)
    points = fitted.sewn_positions - fitted.sewn_positions.mean(axis=0)
    hems = sorted(
        np.linalg.norm(points[loop][:, [0, 2]], axis=1).mean() for loop in boundary_loops(fitted.faces)
    )
    np.testing.assert_allclose(hems, [0.20, 0.28], atol=2e-3)


def test_vertices_too_deep_to_be_moved_out_are_counted_and_told(body, shirt):
    positions, count = dent(shirt, body, 0.075)
    report = fit_garment(source(positions, shirt.faces), body).metadata["fit"]
    deeper = report["penetration"]["after"]["deeper"]
    assert 0 < deeper <= count
    assert f"deeper than 60 mm inside: {deeper} vertices, which stay there" in describe_fit(report)
