"""Garments that are worn together."""

import dataclasses

import numpy as np
import pytest
from garment_shapes import rings
from outfits import OUTFITS, count_pairs, load

from eslr_jax import MeshError
from eslr_jax.fabric.materials import fabric_material
from eslr_jax.mesh.plate import warp_directions
from eslr_jax.pipeline.assets import prepare_stored
from eslr_jax.pipeline.dressing.outfit import LAYER_GAP, combine_garments
from eslr_jax.pipeline.fabrics import garment_material, worn_fabrics
from eslr_jax.pipeline.formats.garment import GarmentFile
from eslr_jax.pipeline.report.crossing import intersecting_pairs

MOST = (0, 0, 1, 1)  # intersecting pairs; without edges against edges the last two have up to 4 and 8


def tube(radius: float, bottom: float, top: float) -> GarmentFile:
    """Return a tube of cloth around the vertical, its normals outwards."""
    positions, faces = rings([(top, radius, radius, 0.0), (bottom, radius, radius, 0.0)], around=24, rows=7)
    count = len(positions)
    return GarmentFile(
        positions, faces, np.ones((count, 1)), np.zeros((count, 1), int), np.zeros(count, bool)
    )


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
@pytest.mark.parametrize(("names", "most"), list(zip(OUTFITS, MOST, strict=True)))
def test_an_outfit_on_a_walk_does_not_cross_itself(names, most):
    rest = combine_garments([load(name) for name in names], names)
    assert not len(intersecting_pairs(rest.rest_positions, rest.faces))
    row = count_pairs(names)
    assert max(row["pairs"]) <= most, row
    assert row["residual_max"] < 100.0
