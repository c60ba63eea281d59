"""The bundled formats of bodies and motions: whole ones come back, broken ones are named."""

import numpy as np
import pytest
from broken import refuses

from eslr_jax.assets.catalog import find_asset
from eslr_jax.io.bundled import read_body, read_motion_archive
from eslr_jax.io.npz import read_arrays, write_arrays

CLIP = {
    "joint_names": np.array(["a", "b"]),
    "walk/rotations": np.random.default_rng(0).normal(size=(4, 2, 3)),
    "walk/translations": np.random.default_rng(1).normal(size=(4, 3)),
    "walk/fps": np.array(33.3),
}
BROKEN_MOTIONS = {
    "no clip": ({"walk/rotations": None}, "no motion"),
    "no names": ({"joint_names": None}, "no motion"),
    "no rate": ({"walk/fps": None}, "lacks walk/fps"),
    "another number of joints": ({"walk/rotations": np.zeros((4, 5, 3))}, "[frames, 2, 3]"),
    "frames that differ": ({"walk/translations": np.zeros((3, 3))}, "translations"),
    "names that are numbers": ({"joint_names": np.arange(2)}, "names"),
    "text for numbers": ({"walk/translations": np.array([["a"] * 3] * 4)}, "translations"),
}
BROKEN_BODIES = {
    "no faces": ({"faces": None}, "lacks faces"),
    "weights of another body": ({"skin_weights": np.zeros((3, 7))}, "skin_weights"),
    "a joint beyond": ({"skin_indices": np.full((12272, 7), 99)}, "99 of 31"),
    "a vertex beyond": ({"faces": np.full((24540, 3), 20000)}, "20000"),
    "a cycle": ({"parents": np.full(31, 3)}, "parents"),
    "not finite": ({"joint_rest_positions": np.full((31, 3), np.nan)}, "finite"),
    "lying": (
        {"rest_positions": np.linspace(0, 1, 12272)[:, None] * [0.5, 0.3, 1.8]},
        "turn it so that Y is up",
    ),
    "a vertex without a joint": ({"skin_weights": np.zeros((12272, 7))}, "skin weight"),
    "faces of floats": ({"faces": np.zeros((24540, 3))}, "faces"),
}


def whole(values, changes):
    return {key: value for key, value in (values | changes).items() if value is not None}


def test_a_clip_comes_back_exactly(tmp_path):
    write_arrays(tmp_path / "a.npz", CLIP)
    clip = read_motion_archive(tmp_path / "a.npz")["walk"]
    np.testing.assert_array_equal(clip.rotations, CLIP["walk/rotations"])
    np.testing.assert_array_equal(clip.translations, CLIP["walk/translations"])
    assert (clip.fps, clip.joint_names) == (33.3, ("a", "b"))


@pytest.mark.parametrize("kind", BROKEN_MOTIONS)
def test_broken_motions_are_named_in_one_line(tmp_path, kind):
    changes, word = BROKEN_MOTIONS[kind]
    write_arrays(tmp_path / "clip.npz", whole(CLIP, changes))
    refuses(read_motion_archive, tmp_path / "clip.npz", word)


@pytest.fixture(scope="module")
def bundled():
    return read_arrays(find_asset("body", "anny"), content="body")


@pytest.mark.parametrize("kind", BROKEN_BODIES)
def test_broken_bodies_are_named_in_one_line(tmp_path, bundled, kind):
    changes, word = BROKEN_BODIES[kind]
    write_arrays(tmp_path / "body.npz", whole(bundled, changes))
    refuses(read_body, tmp_path / "body.npz", word)


def test_skin_weights_of_a_body_sum_to_one(tmp_path, bundled):
    write_arrays(tmp_path / "body.npz", {**bundled, "skin_weights": 0.97 * bundled["skin_weights"]})
    np.testing.assert_allclose(
        read_body(tmp_path / "body.npz").skin_weights, bundled["skin_weights"], atol=1e-6
    )
