"""Garments that are worn together."""

import dataclasses

import numpy as np
import pytest
from cloth import shaped
from contact import OUTFITS, dressed, judge, load
from garment_files import bundled, stored
from garment_shapes import rings

from eslr_jax import AssetError, MeshError, simulate
from eslr_jax.fabric.materials import fabric_material
from eslr_jax.mesh.plate import warp_directions
from eslr_jax.pipeline.assets import load_garment_file, prepare_stored
from eslr_jax.pipeline.dressing.outfit import LAYER_GAP, combine_garments
from eslr_jax.pipeline.dressing.transfer import transfer_garment
from eslr_jax.pipeline.fabrics import garment_material, worn_fabrics
from eslr_jax.pipeline.formats.garment import GarmentFile, write_garment_npz
from eslr_jax.pipeline.report.crossing import intersecting_pairs


def tube(radius: float, bottom: float, top: float) -> GarmentFile:
    """Return a tube of cloth around the vertical, its normals outwards."""
    positions, faces = rings([(top, radius, radius, 0.0), (bottom, radius, radius, 0.0)], around=24, rows=7)
    return stored(positions, faces)


def test_a_garment_beneath_another_is_moved_over_it_and_keeps_its_lengths():
    inner, outer = tube(0.10, 0.0, 0.4), tube(0.098, 0.2, 0.6)
    outfit = combine_garments([inner, outer], ["skirt", "top"])
    first, second = np.split(outfit.rest_positions, [len(inner.rest_positions)])
    np.testing.assert_array_equal(first, inner.rest_positions)
    covering = second[second[:, 1] < 0.38]
    assert np.linalg.norm(covering[:, [0, 2]], axis=1).min() > 0.10 + 0.9 * LAYER_GAP * np.cos(np.pi / 24)
    assert not len(intersecting_pairs(outfit.rest_positions, outfit.faces))
    sewn = np.concatenate([inner.rest_positions, outer.rest_positions])
    np.testing.assert_array_equal(outfit.sewn_positions, sewn)


def test_garments_that_coincide_as_sewn_are_worn_over_each_other():
    outfit = combine_garments([tube(0.10, 0.0, 0.4)] * 2, ["underskirt", "skirt"])
    garment = prepare_stored(outfit, cache=False)
    first, second = np.split(np.asarray(garment.vertex_areas)[np.asarray(garment.vertex_mask)], 2)
    np.testing.assert_allclose(first, second, rtol=1e-6)


def test_garments_far_from_each_other_stay_as_they_are():
    garments = [tube(0.10, 0.0, 0.4), tube(0.10, 0.5, 0.9)]
    outfit = combine_garments(garments, ["skirt", "top"])
    np.testing.assert_array_equal(
        outfit.rest_positions, np.concatenate([garment.rest_positions for garment in garments])
    )


@pytest.mark.parametrize(("inner", "outer", "given", "worn"), [
    ([], ["denim", "high:silk"], (), ("cotton", "denim", "silk")),
    (["satin"], [], ("top:denim", "top/high:silk"), ("satin", "denim", "silk")),
])  # fmt: skip
def test_parts_and_fabrics_are_named_after_their_garments(inner, outer, given, worn):
    skirt, top = tube(0.10, 0.0, 0.4), tube(0.11, 0.2, 0.6)
    half = np.arange(len(top.faces)) // (len(top.faces) // 2)
    skirt = dataclasses.replace(skirt, metadata={"fabrics": inner})
    top = dataclasses.replace(top, face_parts=half, part_names=("low", "high"), metadata={"fabrics": outer})
    outfit = combine_garments([skirt, top], ["skirt", "top"])
    assert outfit.part_names == ("skirt", "top/low", "top/high")
    material = garment_material(given, prepare_stored(outfit, cache=False), outfit)
    for part, fabric in enumerate(worn):
        expected = fabric_material(fabric).lame_mu
        assert np.all(np.asarray(material.lame_mu)[outfit.face_parts == part] == expected)
    assert worn_fabrics(("denim",), outfit) == ("denim",)


def test_a_textured_garment_keeps_its_warp_beside_one_without_texture():
    inner, outer = tube(0.10, 0.0, 0.4), tube(0.11, 0.2, 0.6)
    assert combine_garments([inner, outer], ["skirt", "top"]).corner_uvs is None
    corners = outer.rest_positions[outer.faces]
    turned = dataclasses.replace(outer, corner_uvs=corners[:, :, [1, 0]])  # v along x
    outfit = combine_garments([inner, turned], ["skirt", "top"])
    garment = prepare_stored(outfit, cache=False)
    warp = warp_directions(garment, outfit.corner_uvs)
    own = warp_directions(prepare_stored(turned, cache=False), turned.corner_uvs)
    np.testing.assert_allclose(warp[len(inner.faces) :], own, atol=1e-5)
    np.testing.assert_allclose(warp[: len(inner.faces)], warp_directions(garment)[: len(inner.faces)])


def test_a_garment_is_worn_once():
    with pytest.raises(MeshError, match="worn once only"):
        combine_garments([tube(0.10, 0.0, 0.4)] * 2, ["skirt", "skirt"])


@pytest.mark.slow
@pytest.mark.parametrize("worn", OUTFITS)
def test_nothing_passes_through_an_outfit_on_a_walk(worn):
    rest = load(worn)
    assert not len(intersecting_pairs(rest.rest_positions, rest.faces))
    run = simulate(None, dressed(worn, "cmu_016_32"), raises=False)
    row = judge(run.scene, run.trajectory)
    assert row["passed"], row


# --- a fitted garment is worn by the body that it was fitted to, and by no other ----------------------------

NUDGE = 5e-4  # [m], less than two files of one body may differ by


@pytest.fixture(scope="module")
def tank(body):
    """A garment as its run keeps it."""
    return load_garment_file("tank", body=body)


@pytest.fixture(scope="module")
def file(tank, tmp_path_factory):
    path = tmp_path_factory.mktemp("wearer") / "tank.npz"
    write_garment_npz(path, tank)
    return path


def larger(body, by):
    """Return a body of another shape, its joints moved by so much [m]."""
    return body.replace(joint_rest_positions=body.joint_rest_positions + by)


def renamed(body):
    return body.replace(joint_names=("pelvis", *body.joint_names[1:]))


def test_its_own_body_wears_it(file, tank, body):
    worn = load_garment_file(file, body=body)
    np.testing.assert_allclose(worn.rest_positions, tank.rest_positions, atol=1e-6)
    assert worn.metadata == tank.metadata
    assert load_garment_file(file, body=larger(body, NUDGE)).metadata == tank.metadata


def test_a_body_with_other_joints_does_not(file, body):
    with pytest.raises(
        MeshError, match=r"tank\.npz was fitted to another body, with other joints \(Hips, pelvis\)"
    ):
        load_garment_file(file, body=renamed(body))
    swapped = body.replace(joint_names=(*body.joint_names[1::-1], *body.joint_names[2:]))
    with pytest.raises(MeshError, match=r"was fitted to another body, .* \(in another order\)"):
        load_garment_file(file, body=swapped)


def test_a_body_of_another_shape_does_not(file, body):
    with pytest.raises(MeshError, match=r"was fitted to another body, of another shape .* 35 mm away"):
        load_garment_file(file, body=larger(body, 0.02))


def test_a_garment_that_is_carried_tells_its_new_body(body):
    taller = shaped(body, lambda places: 1.1 * places)
    carried = transfer_garment(bundled("tank_1k"), body, taller)
    joint = carried.metadata["body"]["joint_rest_positions"][3]
    assert joint == pytest.approx(taller.joint_rest_positions[3].tolist(), abs=1e-5)


def test_an_outfit_tells_the_body_of_its_garments(tank):
    below = dataclasses.replace(tank, rest_positions=tank.rest_positions - [0.0, 2.0, 0.0], metadata={})
    outfit = combine_garments([below, tank], ["low", "high"])
    assert outfit.metadata["body"] == tank.metadata["body"]
    joints = tank.metadata["body"]["joint_rest_positions"]
    other = tank.metadata["body"] | {"joint_rest_positions": [[x, y + 0.01, z] for x, y, z in joints]}
    with pytest.raises(MeshError, match="high was fitted to another body than low"):
        combine_garments([dataclasses.replace(below, metadata={"body": other}), tank], ["low", "high"])


@pytest.mark.parametrize("entry", [None, "anny", {"joint_names": ["Hips"]}, {"joint_names": ["Hips"],
    "joint_rest_positions": [0.0]}, {"joint_names": 3, "joint_rest_positions": []}])  # fmt: skip
def test_a_damaged_entry_is_named(tank, tmp_path, body, entry):
    write_garment_npz(tmp_path / "a.npz", dataclasses.replace(tank, metadata={"body": entry}))
    with pytest.raises(AssetError, match=r"a\.npz has damaged metadata; fit the garment again"):
        load_garment_file(tmp_path / "a.npz", body=body)
