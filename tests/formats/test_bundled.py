"""The bundled formats of bodies and motions."""

import numpy as np

from eslr_jax.files.npz import read_arrays, write_arrays
from eslr_jax.pipeline.assets.catalog import find_asset
from eslr_jax.pipeline.formats.bundled import read_body, read_motion_archive

CLIP = {
    "joint_names": np.array(["a", "b"]),
    "walk/rotations": np.random.default_rng(0).normal(size=(4, 2, 3)),
    "walk/translations": np.random.default_rng(1).normal(size=(4, 3)),
    "walk/fps": np.array(33.3),
}


def test_a_clip_comes_back_exactly(tmp_path):
    write_arrays(tmp_path / "a.npz", CLIP)
    clip = read_motion_archive(tmp_path / "a.npz")["walk"]
    np.testing.assert_array_equal(clip.rotations, CLIP["walk/rotations"])
    np.testing.assert_array_equal(clip.translations, CLIP["walk/translations"])
    assert (clip.fps, clip.joint_names) == (33.3, ("a", "b"))


def test_skin_weights_of_a_body_sum_to_one(tmp_path):
    bundled = read_arrays(find_asset("body", "anny"), content="body")
    write_arrays(tmp_path / "body.npz", {**bundled, "skin_weights": 0.97 * bundled["skin_weights"]})
    np.testing.assert_allclose(
        read_body(tmp_path / "body.npz").skin_weights, bundled["skin_weights"], atol=1e-6
    )
