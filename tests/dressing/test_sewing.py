"""A pattern becomes one mesh around the body, with the lengths of its panels."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from eslr_jax import load_body, load_garment
from eslr_jax.errors import ConfigError, MeshError
from eslr_jax.fabric.materials import fabric_material
from eslr_jax.mesh.closest import nearest_places
from eslr_jax.mesh.piercing import piercing_edges
from eslr_jax.mesh.topology import boundary_loops, vertex_normals
from eslr_jax.mesh.validate import validate_mesh
from eslr_jax.pipeline.assets import prepare_stored
from eslr_jax.pipeline.assets.garments import MEAN_SHAPE, load_garment_file, sew_pattern_file
from eslr_jax.pipeline.dressing.outfit import wear_together
from eslr_jax.pipeline.dressing.panels import join_panels
from eslr_jax.pipeline.fabrics import garment_material
from eslr_jax.pipeline.formats.garment import read_garment_npz, write_garment_npz
from eslr_jax.pipeline.formats.pattern import Seam, read_pattern, signed_area
from eslr_jax.terms.stretch import principal_stretches

PATTERNS = Path(__file__).parents[2] / "data" / "patterns"


@pytest.fixture(scope="module")
def mean_body():
    return load_body(betas=MEAN_SHAPE)


@pytest.fixture(scope="module")
def tshirt(mean_body):
    return sew_pattern_file(PATTERNS / "tshirt.json", mean_body, num_vertices=600)


def flat_areas(corners):
    """Return the areas of triangles in the plane, corners [faces, 3, 2]."""
    return trimesh.triangles.area(np.pad(corners, ((0, 0), (0, 0), (0, 1))))


@pytest.mark.parametrize(("name", "loops"), [("skirt", 2), ("tshirt", 4)])
def test_panels_are_joined_along_all_seams(name, loops):
    pattern = read_pattern(PATTERNS / f"{name}.json")
    mesh = join_panels(pattern, 800)
    assert abs(len(mesh.placed) - 800) < 60
    validate_mesh(mesh.placed, mesh.faces)  # one piece, turned one way
    assert len(boundary_loops(mesh.faces)) == loops
    areas, corners = flat_areas(mesh.panel_corners), mesh.panel_corners
    whole = sum(abs(signed_area(panel.outline)) for panel in pattern.panels.values())
    assert areas.sum() == pytest.approx(whole, rel=1e-3)
    squares = np.square(corners - corners[:, [1, 2, 0]]).sum(axis=(1, 2))
    assert (4 * np.sqrt(3) * areas / squares).min() > 0.3  # one of an equilateral face


def test_a_longer_edge_is_gathered():
    """Folds that no face can hold stretch nothing: the faces along a seam get the length of its shorter side."""
    pattern = read_pattern(PATTERNS / "skirt.json")
    back = pattern.panels["back"]
    wide = dataclasses.replace(back, edges=tuple(edge * [1.0, 1.2] for edge in back.edges))
    mesh = join_panels(dataclasses.replace(pattern, panels=pattern.panels | {"back": wide}), 600)
    lengths = {}
    for corners, face, panel in zip(mesh.panel_corners, mesh.faces, mesh.face_panels, strict=True):
        for k in range(3):
            edge = tuple(sorted((int(face[k]), int(face[k - 1]))))
            lengths.setdefault(edge, {})[int(panel)] = float(np.linalg.norm(corners[k] - corners[k - 1]))
    along = [lengths[tuple(sorted(map(int, edge)))] for edge in mesh.seam_edges]
    assert along
    for sides in along:
        assert sides[0] == pytest.approx(sides[1], rel=1e-6)


def test_a_parallel_seam_runs_the_other_way():
    """Sewn right side to wrong side, a skirt of two panels is a Moebius strip."""
    pattern = read_pattern(PATTERNS / "skirt.json")
    turned = (Seam(pattern.seams[0].sides, True), pattern.seams[1])
    mesh = join_panels(dataclasses.replace(pattern, seams=turned), 400)
    with pytest.raises(MeshError, match="opposite directions"):
        validate_mesh(np.random.default_rng(0).random(mesh.placed.shape), mesh.faces)


def test_sewn_garment_lies_around_the_body(tshirt, mean_body):
    assert piercing_edges(tshirt.rest_positions, tshirt.faces)[0].size == 0
    body, faces = np.asarray(mean_body.rest_positions, float), np.asarray(mean_body.faces)
    place = nearest_places(tshirt.rest_positions, body, faces, vertex_normals(body, faces))
    assert (np.einsum("px,px->p", place.offsets, place.normals) > 0).all()
    outwards = vertex_normals(tshirt.rest_positions, tshirt.faces)
    assert np.mean(np.einsum("px,px->p", outwards, place.normals)) > 0.8
    report = tshirt.metadata["sewing"]
    assert report["p99_principal_stretch"] < 1.35
    assert report["warnings"] == []
    neck = np.asarray(report["seams"]["left_front edge 6 to right_front edge 6"])
    assert np.abs(tshirt.rest_positions[neck, 0]).max() < 0.03


def test_lengths_are_those_of_the_panels(tshirt, tmp_path):
    """Also from a file, and for one garment of an outfit."""
    write_garment_npz(tmp_path / "shirt.npz", tshirt)
    stored = read_garment_npz(tmp_path / "shirt.npz")
    garment = prepare_stored(stored, cache=False)
    areas = flat_areas(tshirt.panel_corners)
    np.testing.assert_allclose(garment.rest_areas, areas, rtol=1e-4)
    assert np.asarray(garment.hinge_rest_lengths).min() > 1e-3
    shorts = load_garment_file("shorts", body=load_body(betas=MEAN_SHAPE))
    outfit = prepare_stored(wear_together([shorts, tshirt], ["shorts", "shirt"]), cache=False)
    np.testing.assert_allclose(outfit.rest_areas[-len(areas) :], areas, rtol=1e-4)
    alone = prepare_stored(shorts, cache=False)
    np.testing.assert_allclose(outfit.rest_areas[: len(shorts.faces)], alone.rest_areas, rtol=1e-3)


def test_carried_to_another_body_it_is_cut_anew(tshirt):
    """The stretch stays what it was, for lengths change with the body's."""
    garment = load_garment(PATTERNS / "tshirt.json", cache=False)
    larger, _ = principal_stretches(garment.rest_positions, garment)
    cut = prepare_stored(tshirt, cache=False)
    assert float(garment.rest_areas.sum()) > 1.02 * float(cut.rest_areas.sum())
    assert float(np.quantile(larger, 0.95)) < 1.2


def test_skirt_is_held_at_the_waist(mean_body):
    skirt = sew_pattern_file(PATTERNS / "skirt.json", mean_body, num_vertices=300)
    assert 10 < skirt.is_pinned.sum() < 100
    assert skirt.part_names == ("front", "back")
    uvs = skirt.corner_uvs
    up = uvs[:, 0] - uvs[:, 1]
    assert np.abs(up[:, 1]).sum() > 0
    heights = [uvs[skirt.face_parts == k].reshape(-1, 2) for k in range(2)]
    assert heights[0][:, 0].max() < heights[1][:, 0].min()  # side by side


def test_a_tube_of_one_panel_is_doubted(mean_body, tmp_path):
    whole = json.loads((PATTERNS / "skirt.json").read_text())
    del whole["pattern"]["panels"]["back"]
    sides = [{"panel": "front", "edge": 1}, {"panel": "front", "edge": 3}]
    whole["pattern"]["stitches"] = [sides]
    (tmp_path / "tube.json").write_text(json.dumps(whole))
    tube = sew_pattern_file(tmp_path / "tube.json", mean_body, num_vertices=150, cache=False)
    assert any("front edge 1 to edge 3 joins a panel to itself" in text for text in tube.fit_warnings)


def test_seams_bend_as_their_own_fabric(tshirt):
    garment = prepare_stored(tshirt, cache=False)
    material = garment_material(["silk", "seams:bending_stiffness=4e-4"], garment, tshirt)
    bending, ends = np.asarray(material.bending_stiffness), np.asarray(garment.hinges)[:, :2]
    is_stiff = bending == np.float32(4e-4)
    assert (bending[~is_stiff] == fabric_material("silk").bending_stiffness).all()
    assert material.density == fabric_material("silk").density
    for vertices in tshirt.metadata["sewing"]["seams"].values():
        along = np.isin(ends, vertices).all(axis=1)
        assert is_stiff[along].all()
        assert along.sum() >= len(vertices) - 2  # a line of them; its ends may lie on the boundary
    with pytest.raises(ConfigError, match="seams bend by bending_stiffness"):
        garment_material(["suiting-woven", "seams:denim"], garment, tshirt)
    with pytest.raises(ConfigError, match="no part 'seams'"):
        garment_material(["seams:denim"], garment, dataclasses.replace(tshirt, metadata={}))
