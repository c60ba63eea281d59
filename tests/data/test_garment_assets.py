"""The bundled garments are sound meshes, worn on the bundled body without touching it."""

from functools import cache

import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree

from eslr_jax import load_body
from eslr_jax.mesh.topology import boundary_loops
from eslr_jax.mesh.validate import validate_mesh
from eslr_jax.pipeline.assets import load_garment_file
from eslr_jax.pipeline.dressing.clearance import body_heights
from eslr_jax.pipeline.dressing.postures import rest_posture

NUM_LOOPS = {
    "tshirt": 4, "tank": 4, "longsleeve": 4, "shorts": 3, "pants": 3,
    "dress": 4, "kneepants": 3, "shortsleeve": 4, "tightdress": 4,
}  # fmt: skip
PINNED = {"tank", "shorts", "pants", "dress", "kneepants", "tightdress"}
NUM_VERTICES = {"1k": 1000, "4k": 4000, "10k": 10000}
CASES = [
    pytest.param(name, level, marks=[pytest.mark.slow] if level != "1k" else [])
    for name in NUM_LOOPS
    for level in NUM_VERTICES
]
each_garment = pytest.mark.parametrize(("name", "level"), CASES)
load = cache(lambda name, level: load_garment_file(name, vertices=level))


def surface(garment):
    return trimesh.Trimesh(garment.rest_positions, garment.faces, process=False)


@pytest.fixture(scope="module")
def posture():
    return rest_posture(load_body())


@each_garment
def test_garment_is_one_manifold_sheet_with_its_openings(name, level):
    garment = load(name, level)
    faces, num_vertices = garment.faces, len(garment.rest_positions)
    validate_mesh(garment.rest_positions, faces)  # one oriented sheet without loose vertices
    assert abs(num_vertices / NUM_VERTICES[level] - 1.0) < 0.05
    loops = boundary_loops(faces)
    assert len(loops) == NUM_LOOPS[name]
    assert len(np.unique(np.concatenate(loops))) == sum(map(len, loops))
    assert surface(garment).euler_number == 2 - NUM_LOOPS[name]  # a sphere with holes


@each_garment
def test_garment_triangles_are_even(name, level):
    mesh = surface(load(name, level))
    assert mesh.edges_unique_length.std() / mesh.edges_unique_length.mean() < 0.2
    assert np.degrees(mesh.face_angles.min()) > 15.0


@each_garment
def test_garment_faces_outward_and_clears_the_body(name, level, posture):
    mesh = surface(load(name, level))
    sample = np.random.default_rng(0).choice(len(mesh.faces), 150, replace=False)
    centres, normals = mesh.triangles_center[sample], mesh.face_normals[sample]
    assert body_heights(np.concatenate([mesh.triangles[sample, 0], centres]), posture)[0].min() > 0.003
    here, above = (body_heights(points, posture)[0] for points in (centres, centres + 0.002 * normals))
    assert np.mean(above > here) > 0.9  # cloth in the crotch and under the arms may face another limb


@each_garment
def test_garment_skin_weights_are_convex(name, level, body):
    garment = load(name, level)
    assert garment.skin_weights.shape == garment.skin_indices.shape == (len(garment.rest_positions), 4)
    assert (garment.skin_weights >= 0.0).all()
    np.testing.assert_array_equal(garment.skin_weights.sum(axis=1), 1.0)
    assert garment.skin_indices.min() >= 0
    assert garment.skin_indices.max() < len(body.joint_names)


@each_garment
def test_garment_pins_hold_the_top_of_both_sides(name, level):
    garment = load(name, level)
    pinned, positions = garment.is_pinned, garment.rest_positions
    assert pinned.any() == (name in PINNED)
    if name in PINNED:
        assert 0.002 < pinned.mean() < 0.12
        assert (positions[pinned, 0] > 0.05).any()
        assert (positions[pinned, 0] < -0.05).any()
        assert positions[pinned, 1].min() >= positions[~pinned, 1].max()


@pytest.mark.slow
@pytest.mark.parametrize("name", list(NUM_LOOPS))
def test_garment_levels_share_one_shape(name):
    coarse, fine = load(name, "4k"), load(name, "10k")
    distance = KDTree(fine.rest_positions).query(coarse.rest_positions)[0]
    assert distance.max() < surface(fine).edges_unique_length.mean()
