"""Garments that are worn together."""

import dataclasses

import numpy as np
import pytest
from garment_shapes import rings

from eslr_jax.assets import load_body, load_garment_file, load_motion, prepare_stored
from eslr_jax.body.motion import pose_body
from eslr_jax.body.timing import with_settling
from eslr_jax.config import SimConfig
from eslr_jax.errors import MeshError
from eslr_jax.evaluation.referee import intersecting_pairs
from eslr_jax.fabric import garment_material
from eslr_jax.fit.outfit import LAYER_GAP, combine_garments
from eslr_jax.geometry.topology import is_on_boundary
from eslr_jax.io.garment import GarmentFile
from eslr_jax.physics.materials import fabric_material
from eslr_jax.scene.plan import SceneOptions, prepare_scene
from eslr_jax.simulation.simulate import simulate

SETTLE = 15  # frames
CROSSES = "after two seconds layers that swing, or three that are pressed together, pass through each other"


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


def test_parts_and_fabrics_are_named_after_their_garments():
    inner, outer = tube(0.10, 0.0, 0.4), tube(0.11, 0.2, 0.6)
    half = np.arange(len(outer.faces)) // (len(outer.faces) // 2)
    outer = dataclasses.replace(
        outer, face_parts=half, part_names=("low", "high"), metadata={"fabrics": ["denim", "high:silk"]}
    )
    outfit = combine_garments([inner, outer], ["skirt", "top"])
    assert outfit.part_names == ("skirt", "top/low", "top/high")
    garment = prepare_stored(outfit, cache=False)
    material = garment_material((), garment, outfit)
    for part, fabric in enumerate(("cotton", "denim", "silk")):
        expected = fabric_material(fabric).lame_mu
        assert np.all(np.asarray(material.lame_mu)[outfit.face_parts == part] == expected)


def test_a_garment_is_worn_once():
    with pytest.raises(MeshError, match="worn once only"):
        combine_garments([tube(0.10, 0.0, 0.4)] * 2, ["skirt", "skirt"])


def skirt_of(dress: GarmentFile) -> GarmentFile:
    """Return a dress from the waist down, held there."""
    height = dress.rest_positions[:, 1]
    waist = height.min() + 0.55 * np.ptp(height)
    faces = dress.faces[np.all(height[dress.faces] < waist, axis=1)]
    kept, faces = np.unique(faces, return_inverse=True)
    faces = faces.reshape(-1, 3)
    upper = is_on_boundary(faces, len(kept)) & (height[kept] > waist - 0.1)
    return GarmentFile(
        dress.rest_positions[kept], faces, dress.skin_weights[kept], dress.skin_indices[kept], upper
    )


def load(name: str) -> GarmentFile:
    """Return a bundled garment, or a skirt."""
    return skirt_of(load_garment_file("dress")) if "skirt" in name else load_garment_file(name)


@pytest.mark.slow
@pytest.mark.parametrize(
    "names",
    [
        ("pants", "tshirt"),
        ("shorts", "dress"),
        pytest.param(("underskirt", "skirt"), marks=pytest.mark.xfail(reason=CROSSES)),
        pytest.param(("tank", "longsleeve"), marks=pytest.mark.xfail(reason=CROSSES)),
    ],
)
def test_an_outfit_on_a_walk_does_not_cross_itself(names):
    outfit = combine_garments([load(name) for name in names], names)
    garment = prepare_stored(outfit)
    assert not len(intersecting_pairs(garment.rest_positions, outfit.faces))
    poses = with_settling(pose_body(load_body(), load_motion("cmu_016_32"), num_frames=100), SETTLE)
    options = SceneOptions(has_skin=True, integrator="bdf2")
    run = simulate(
        None, prepare_scene(garment, poses, options=options), config=SimConfig(iterations=300, tolerance=0.01)
    )
    piece = np.repeat([0, 1], list(outfit.metadata["outfit"].values()))[outfit.faces[:, 0]]
    positions = np.asarray(run.trajectory.positions)[SETTLE:]
    for frame in (20, 40, 60, 80, 99):
        pairs = intersecting_pairs(positions[frame], outfit.faces)
        assert not np.any(piece[pairs[:, 0]] != piece[pairs[:, 1]]), frame
