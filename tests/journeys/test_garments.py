"""From a garment that another program wrote to one that is worn: each journey ends in a number."""

import json

import numpy as np
import pytest
import trimesh
from commands import eslr, slip, succeeded, worn
from garment_files import cut_apart, scanned_tshirt
from garment_shapes import rings, shorts, skirt, write_obj

from eslr_jax import load_garment
from eslr_jax.pipeline.assets import load_garment_file
from eslr_jax.pipeline.dressing.options import FitOptions

pytestmark = pytest.mark.slow


def load(path, body, **options):
    """Fit a file without the cache."""
    return load_garment_file(path, body=body, fit=FitOptions(**options), cache=False)


@pytest.mark.parametrize("shape", [skirt, shorts])
def test_bottoms_of_ones_own_stay_up_for_sixty_frames(tmp_path, shape):
    path = write_obj(tmp_path / "own.obj", shape())
    report, trajectory = worn(tmp_path / "run", "--garment", path, "--frames", 60)
    assert abs(slip(trajectory)) < 0.01
    assert report["penetration_max_mm"] < 5.0


def test_a_scanned_shirt_hangs_from_the_shoulders(tmp_path, body):
    scan = scanned_tshirt(tmp_path / "shirt.obj", body)
    report, trajectory = worn(tmp_path / "run", "--garment", scan, "--frames", 20)
    assert abs(slip(trajectory)) < 0.02
    assert report["max_principal_stretch"] < 1.4


def test_a_garment_modelled_on_the_exported_body_fits_exactly(tmp_path, body):
    result = succeeded(eslr("assets", "--export", tmp_path / "body.obj"))
    assert "1.84 m tall, in metres, its feet at height 0" in result.stdout
    mannequin = trimesh.load(tmp_path / "body.obj", process=False)
    assert mannequin.vertices[:, 1].min() == pytest.approx(0.0, abs=1e-6)
    grown = mannequin.vertices + 0.012 * mannequin.vertex_normals
    height = mannequin.triangles_center[:, 1]
    is_cloth = (height > 0.93) & (height < 1.15) & (np.abs(mannequin.triangles_center[:, 0]) < 0.25)
    belt = write_obj(tmp_path / "belt.obj", (np.array(grown), np.array(mannequin.faces[is_cloth])))
    fitted = load(belt, body, components="largest", weld=1e-7)
    assert fitted.metadata["fit"]["placement"]["origin"] == "floor"
    assert fitted.metadata["fit"]["penetration"]["before"]["inside"] == 0


def test_panels_are_sewn_before_the_waist_is_looked_for(tmp_path, body):
    positions, faces = skirt()
    is_left = positions[faces].mean(axis=1)[:, 0] > 0
    path = write_obj(tmp_path / "skirt.obj", cut_apart(positions, faces, is_left, [0.004, 0, 0]))
    apart = load(path, body)
    assert "nothing holds the garment up" in " ".join(apart.metadata["fit"]["warnings"])
    sewn = load(path, body, components="join", join_gap=0.01)
    assert sewn.metadata["fit"]["mesh"]["components_left"] == 1
    assert sewn.is_pinned.sum() >= 96
    assert load_garment(path, body=body, fit=FitOptions(components="join"), cache=False).is_pinned.sum() >= 96


def test_a_large_mesh_tells_its_cost_before_it_is_fitted(tmp_path):
    levels = [(1.10, 0.175, 0.12, 0.045), (0.96, 0.21, 0.15, 0.02), (0.60, 0.28, 0.21, 0.03)]
    path = write_obj(tmp_path / "skirt.obj", rings(levels, around=240, rows=130))
    result = succeeded(eslr("fit", path, "--out", tmp_path / "skirt.npz", "--no-picture", "--json"))
    assert "31,200 vertices are many" in result.stderr
    assert json.loads(result.stdout)["placement"]["origin"] == "floor"
