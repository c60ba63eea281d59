"""Fabrics by name, by numbers, per part; and what they do in the energies."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from garment_files import bundled

from eslr_jax import ConfigError, pose_body, prepare_scene, prepare_scenes
from eslr_jax.fabric.materials import COTTON, FABRICS, WOVEN, fabric_material
from eslr_jax.fabric.validate import validate_material
from eslr_jax.numerics import gather_corners
from eslr_jax.pipeline.assets import prepare_stored
from eslr_jax.pipeline.fabrics import beyond_training, garment_material, parse_fabric
from eslr_jax.pose.motion import still_motion
from eslr_jax.terms import CLOTH
from eslr_jax.terms.stretch import green_strains, stretch_energy, thread_strains
from eslr_jax.terms.term import vertex_masses


@pytest.fixture(scope="module")
def two_fabrics():
    stored = bundled("tshirt_1k")
    side = (stored.rest_positions[stored.faces].mean(axis=1)[:, 0] > 0).astype(int)
    stored = dataclasses.replace(stored, face_parts=side, part_names=("right", "left"))
    return stored, prepare_stored(stored)


@pytest.mark.parametrize("name", list(FABRICS))
def test_uniaxial_tension_has_the_measured_stiffness(name):
    """Plane stress: E h = 4 mu h (mu + lambda) / (2 mu + lambda)."""
    material, fabric = fabric_material(name), FABRICS[name]
    mu, lame = (
        float(value) * float(material.thickness) for value in (material.lame_mu, material.lame_lambda)
    )
    assert 4 * mu * (mu + lame) / (2 * mu + lame) == pytest.approx(fabric.stretch_stiffness, rel=1e-5)


def test_fabric_by_numbers():
    material = parse_fabric("density=0.3, bending_stiffness=1e-5")
    assert material.density == np.float32(0.3)
    assert material.bending_stiffness == np.float32(1e-5)
    assert material.lame_mu == COTTON.lame_mu


def test_a_scene_has_the_fabrics_of_the_garments_file(two_fabrics, body):
    stored, plain = two_fabrics
    texts = ["silk", "left:denim"]
    garment = prepare_stored(dataclasses.replace(stored, metadata={"fabrics": texts}))
    poses, options = pose_body(body, still_motion(body, 2)), {"terms": CLOTH}
    scene = prepare_scene(garment, poses, **options)
    jax.tree.map(np.testing.assert_array_equal, scene.material, garment_material(texts, plain, stored))
    assert scene.garment.material is None  # gradients with respect to a fabric have one place
    given = prepare_scene(garment, poses, material=COTTON, **options)
    assert given.material.density == COTTON.density
    assert prepare_scene(plain, poses, **options).material.density == COTTON.density
    whole = prepare_stored(dataclasses.replace(stored, metadata={"fabrics": ["denim"]}))
    scenes = prepare_scenes([whole, plain], [poses] * 2, [None, None], **options)
    assert [one.material.density for one in scenes] == [fabric_material("denim").density, COTTON.density]
    assert jax.tree.structure(scenes[0]) == jax.tree.structure(scenes[1])
    with pytest.raises(ConfigError, match="one isotropic fabric for each garment"):
        prepare_scenes([garment], [poses], [None], **options)


def test_fabric_per_part(two_fabrics):
    stored, garment = two_fabrics
    material = garment_material(["silk", "left:denim"], garment, stored)
    silk, denim = fabric_material("silk"), fabric_material("denim")
    left = stored.face_parts == 1
    np.testing.assert_array_equal(material.lame_mu, np.where(left, denim.lame_mu, silk.lame_mu))
    x = np.asarray(garment.rest_positions)[:, 0]
    assert np.all(material.density[x > 0.06] == denim.density)
    assert np.all(material.density[x < -0.06] == silk.density)
    both = (material.bending_stiffness > silk.bending_stiffness * 1.01) & (
        material.bending_stiffness < denim.bending_stiffness * 0.99
    )
    assert 20 < both.sum() < 200  # hinges along the seam have the mean
    areas = np.asarray(garment.rest_areas)
    expected = areas[left].sum() * denim.density + areas[~left].sum() * silk.density
    assert float(np.sum(vertex_masses(garment, material))) == pytest.approx(float(expected), rel=1e-5)
    stretched = garment.rest_positions * 1.1
    parts = [
        float(stretch_energy(stretched, garment.replace(rest_areas=np.where(mask, areas, 0.0)), fabric))
        for mask, fabric in ((left, denim), (~left, silk))
    ]
    assert float(stretch_energy(stretched, garment, material)) == pytest.approx(sum(parts), rel=1e-4)


def test_padding_does_not_change_the_fabric_of_parts(two_fabrics):
    stored, garment = two_fabrics
    padded = garment_material(["left:denim"], prepare_stored(stored, pad=True), stored)
    plain = garment_material(["left:denim"], garment, stored)
    for name in ("density", "lame_mu", "bending_stiffness"):
        values = getattr(plain, name)
        np.testing.assert_array_equal(getattr(padded, name)[: len(values)], values)


def test_what_networks_have_not_seen_is_named():
    assert beyond_training(COTTON) == ()
    assert beyond_training(fabric_material("denim")) == ("lame_mu", "lame_lambda")
    assert beyond_training(COTTON.replace(thickness=np.float32(2e-3))) == ("lame_mu", "lame_lambda")
    assert beyond_training(COTTON.replace(density=np.float32(3.0))) == ("density",)
    assert beyond_training(COTTON.replace(bending_stiffness=np.float32(1e-9))) == ("bending_stiffness",)


@pytest.mark.parametrize(("text", "named"), [
    ("denin", "denim"), ("weight=3", "density"), ("density=heavy", "heavy"), ("density=-1", "density"),
    ("density=nan", "density"), ("warp_stretch=100,coupling=100", "coupling"), ("collar:silk", "right, left"),
])  # fmt: skip
def test_a_fabric_that_can_not_be_is_refused_in_one_line(two_fabrics, text, named):
    stored, garment = two_fabrics
    with pytest.raises(ConfigError, match=named) as caught:
        garment_material([text], garment, stored)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", list(WOVEN))
def test_woven_fabrics_bear_their_coupling(name):
    weave, is_class = WOVEN[name].weave, WOVEN[name].source.startswith("class")
    assert weave.stiffness
    assert weave.rigidity
    along, across, coupling, shear = weave.stiffness
    assert coupling**2 < along * across
    assert shear > 0
    assert all(1e-6 < rigidity < 5e-5 for rigidity in weave.rigidity) or is_class  # [N m], of clothes
    assert all(5e-7 < rigidity < 1e-4 for rigidity in weave.rigidity)  # light silk to raw denim
    assert WOVEN[name].source


def strains_of_threads(garment, threads, scale):
    """Return the strain along warp and weft of every face of a garment that is scaled."""
    pulled = jnp.asarray(np.asarray(garment.rest_positions) * scale)
    corners = gather_corners(pulled, garment.faces, garment.face_incidence)
    along, across, _ = thread_strains(green_strains(corners, garment), threads)
    return np.asarray(along), np.asarray(across)


def test_woven_fabric_lies_on_the_garment_with_its_warp_up(two_fabrics):
    stored, garment = two_fabrics
    material = garment_material(["silk", "left:denim-woven"], garment, stored)
    validate_material(material, garment)
    left = stored.face_parts == 1
    threads, expected = material.threads, WOVEN["denim-woven"].weave.stiffness
    assert threads is not None
    np.testing.assert_allclose(threads.stiffness[:, left].T, np.tile(expected, (left.sum(), 1)), rtol=1e-5)
    silk = fabric_material("silk")
    np.testing.assert_allclose(threads.stiffness[3, ~left], silk.lame_mu * silk.thickness, rtol=1e-5)
    along, across = strains_of_threads(garment, threads, [1.0, 1.02, 1.0])
    steep = along > 0.015  # faces of the body, which hang
    assert steep.mean() > 0.3
    assert np.abs(across[steep]).max() < 0.005


def test_texture_coordinates_turn_the_warp(two_fabrics):
    stored, garment = two_fabrics
    corners = stored.rest_positions[stored.faces]
    stored = dataclasses.replace(stored, corner_uvs=corners[:, :, [1, 0]])  # v along x
    threads = garment_material(["suiting-woven"], garment, stored).threads
    assert threads is not None
    along, across = strains_of_threads(garment, threads, [1.02, 1.0, 1.0])
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    is_front = np.abs(normals[:, 2]) > 0.98 * np.linalg.norm(normals, axis=1)
    assert is_front.sum() > 50
    assert along[is_front].min() > 0.018
    assert np.abs(across[is_front]).max() < 0.003


def test_fabric_by_flexural_rigidity(two_fabrics):
    stored, garment = two_fabrics
    material = garment_material(["density=0.15,flexural_rigidity=1e-5"], garment, stored)
    assert material.threads is None
    assert material.plate is not None
    assert material.plate.rows.shape == (3, 9, len(garment.faces))
    assert float(material.bending_stiffness) == pytest.approx(4e-5)  # what networks read
    with pytest.raises(ConfigError, match="lie on a mesh"):
        parse_fabric("flexural_rigidity=1e-5")


def test_a_weave_of_another_mesh_is_refused(two_fabrics):
    stored, garment = two_fabrics
    material = garment_material(["suiting-woven"], garment, stored)
    with pytest.raises(ConfigError, match="plate is of"):
        validate_material(material, prepare_stored(stored, pad=True))
