"""From a garment that another program wrote to one that is worn: each journey ends in a number."""

import json

import numpy as np
import pytest
import trimesh
from garment_files import TO_Z_UP, bundled, scanned_tshirt
from garment_shapes import cape, poncho, rings, shorts, skirt, trousers, tube_dress, write_obj

from eslr_jax import load_garment
from eslr_jax.mesh.topology import boundary_loops
from eslr_jax.pipeline.assets import load_garment_file
from eslr_jax.pipeline.dressing.options import FitOptions
from eslr_jax.pipeline.dressing.repair import largest_component

GIVEN = ("--keep-place", "--units", "m", "--up", "y", "--front", "z", "--arms", "rest")


def load(path, body, **options):
    """Fit a file without the cache."""
    return load_garment_file(path, body=body, fit=FitOptions(**options), cache=False)


def standing(positions, body):
    """Return heights above the floor [m]."""
    return positions[:, 1] - float(np.asarray(body.rest_positions)[:, 1].min())


@pytest.mark.parametrize(("name", "shape"), [("skirt", rings), ("shorts", shorts)])
def test_bottoms_of_ones_own_stay_up_for_sixty_frames(tmp_path, worn, slip, name, shape):
    levels = [(1.10, 0.175, 0.12, 0.045), (0.96, 0.21, 0.15, 0.02), (0.60, 0.28, 0.21, 0.03)]
    mesh = shape(levels, around=36, rows=28) if shape is rings else shape()
    report, trajectory = worn(write_obj(tmp_path / f"{name}.obj", mesh), tmp_path / "run", frames=60)
    assert report["finite"]
    assert abs(slip(trajectory)) < 0.01
    assert report["penetration_max_mm"] < 5.0


def test_a_scanned_shirt_hangs_from_the_shoulders(tmp_path, worn, slip, body):
    report, trajectory = worn(scanned_tshirt(tmp_path / "shirt.obj", body), tmp_path / "run")
    assert abs(slip(trajectory)) < 0.02
    assert report["max_principal_stretch"] < 1.4


def test_trousers_without_shared_vertices_in_millimetres(tmp_path, fit_report):
    positions, faces = trousers()
    path = tmp_path / "trousers.stl"
    trimesh.Trimesh(1000 * positions @ TO_Z_UP.T, faces, process=False).export(path)
    report = fit_report(path)
    assert report["placement"]["metres_per_unit"] == 0.001
    assert report["placement"]["origin"] == "floor"
    assert report["mesh"]["vertices"] == len(positions)
    assert report["pinned"] == 100  # the two top rings of fifty


@pytest.mark.parametrize(("shape", "suffix"), [(poncho, "ply"), (cape, "obj")])
def test_kept_place_is_not_refused(tmp_path, fit_report, shape, suffix):
    path = tmp_path / f"garment.{suffix}"
    trimesh.Trimesh(*shape(), process=False).export(path)
    report = fit_report(path, *GIVEN)
    assert report["placement"]["moved_m"] == pytest.approx([0.0, -0.8184, 0.0], abs=1e-4)
    assert report["placement"]["confidence"] > 0.9 or report["warnings"]
    assert (report["pinned"] > 0) == (shape is cape)  # which would slip off


def test_a_skirt_in_metres_is_not_put_on_the_head(tmp_path, body):
    positions, _ = shape = skirt()
    fitted = load(write_obj(tmp_path / "skirt.obj", shape), body)
    np.testing.assert_allclose(standing(fitted.sewn_positions, body), positions[:, 1], atol=1e-5)


def test_a_poncho_as_glb_lies_on_the_shoulders(tmp_path, body):
    path = tmp_path / "poncho.glb"
    trimesh.Trimesh(*poncho(), process=False).export(path)
    fitted = load(path, body)
    assert standing(fitted.sewn_positions, body).max() == pytest.approx(1.60, abs=1e-4)
    assert fitted.metadata["fit"]["pinned_by"] == "it hangs from the shoulders"


def test_a_strapless_dress_in_inches_is_held_at_the_bust(tmp_path, body):
    path = write_obj(tmp_path / "dress.obj", tube_dress(), scale=1 / 0.0254)
    fitted = load(path, body)
    assert fitted.metadata["fit"]["placement"]["metres_per_unit"] == 0.0254
    assert standing(fitted.sewn_positions, body)[fitted.is_pinned].min() == pytest.approx(1.34, abs=0.02)


def test_an_odd_unit_is_told_and_can_be_given(tmp_path, fit_report, body):
    garment = bundled("longsleeve_1k")
    floor = float(np.asarray(body.rest_positions)[:, 1].min())
    shape = (garment.rest_positions - [0.0, floor, 0.0], garment.faces)
    path = write_obj(tmp_path / "shirt.obj", shape, scale=37.3)
    assert any("units in a metre" in text for text in fit_report(path)["warnings"])
    report = fit_report(path, "--units", 1 / 37.3)
    assert report["warnings"] == []
    assert report["placement"]["origin"] == "floor"


def test_a_garment_modelled_on_the_exported_body_fits_exactly(tmp_path, eslr, body):
    result = eslr("assets", "--export", tmp_path / "body.obj")
    assert result.returncode == 0, result.stderr
    assert "1.84 m tall, in metres, its feet at height 0" in result.stdout
    mannequin = trimesh.load(tmp_path / "body.obj", process=False)
    assert mannequin.vertices[:, 1].min() == pytest.approx(0.0, abs=1e-6)
    grown = mannequin.vertices + 0.012 * mannequin.vertex_normals
    height = mannequin.triangles_center[:, 1]
    is_cloth = (height > 0.93) & (height < 1.15) & (np.abs(mannequin.triangles_center[:, 0]) < 0.25)
    belt = largest_component(np.array(grown), np.array(mannequin.faces[is_cloth]))
    fitted = load(write_obj(tmp_path / "belt.obj", (belt.positions, belt.faces)), body, weld=1e-7)
    assert fitted.metadata["fit"]["placement"]["origin"] == "floor"
    assert fitted.metadata["fit"]["penetration"]["before"]["inside"] == 0


def test_quads_become_triangles_and_keep_their_waist(tmp_path, body):
    positions, faces = skirt()
    quads = faces.reshape(2, -1, 3).transpose(1, 0, 2)  # two triangles of every cell of the grid
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in positions]
    lines += [f"f {a} {d} {b} {c}" for (a, b, c), (_, d, _) in (quads + 1).tolist()]
    (tmp_path / "skirt.obj").write_text("\n".join(lines))
    fitted = load(tmp_path / "skirt.obj", body)
    assert len(fitted.faces) == len(faces)
    assert sorted(len(loop) for loop in boundary_loops(fitted.faces)) == [48, 48]
    assert fitted.is_pinned[:96].all()


def test_panels_are_sewn_before_the_waist_is_looked_for(tmp_path, body):
    positions, faces = skirt()
    is_left = positions[faces].mean(axis=1)[:, 0] > 0
    left, right = (np.unique(faces[part]) for part in (is_left, ~is_left))
    number = np.zeros((2, len(positions)), int)
    number[0, left], number[1, right] = np.arange(len(left)), len(left) + np.arange(len(right))
    panels = (
        np.concatenate([positions[left] + [0.004, 0, 0], positions[right]]),
        np.concatenate([number[0, faces[is_left]], number[1, faces[~is_left]]]),
    )
    path = write_obj(tmp_path / "skirt.obj", panels)
    apart = load(path, body)
    assert "nothing holds the garment up" in " ".join(apart.metadata["fit"]["warnings"])
    sewn = load(path, body, components="join", join_gap=0.01)
    assert sewn.metadata["fit"]["mesh"]["components_left"] == 1
    assert sewn.is_pinned.sum() >= 96
    assert load_garment(path, body=body, fit=FitOptions(components="join"), cache=False).is_pinned.sum() >= 96


def test_a_large_mesh_tells_its_cost_before_it_is_fitted(tmp_path, eslr):
    levels = [(1.10, 0.175, 0.12, 0.045), (0.96, 0.21, 0.15, 0.02), (0.60, 0.28, 0.21, 0.03)]
    path = write_obj(tmp_path / "skirt.obj", rings(levels, around=240, rows=130))
    result = eslr("fit", path, "--out", tmp_path / "skirt.npz", "--no-picture", "--json")
    assert result.returncode == 0, result.stderr
    assert "31,200 vertices are many" in result.stderr
    assert json.loads(result.stdout)["placement"]["origin"] == "floor"
