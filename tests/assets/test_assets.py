"""What is bundled is whole, named once, and refused with the cause where it is not."""

import dataclasses
import json

import numpy as np
import pytest

from eslr_jax import (
    AssetError,
    CheckpointError,
    ConfigError,
    MotionError,
    load_body,
    load_garment,
    load_model,
    load_motion,
    pose_body,
)
from eslr_jax.networks.registry import MODELS, write_network
from eslr_jax.pipeline.assets import asset_names, load_garment_file, load_splits
from eslr_jax.pipeline.assets.catalog import is_intact, list_assets
from eslr_jax.pipeline.assets.garments import check_resolution
from eslr_jax.pipeline.cli.actor import is_moving_mesh, load_wearer
from eslr_jax.pose.motion import Motion, still_motion


def test_every_file_is_intact_and_licensed():
    for asset in list_assets():
        assert is_intact(asset), asset.file
        assert asset.licence
        assert asset.source


def test_the_box_is_small():
    files = {asset.file: asset.bytes for asset in list_assets() if asset.kind != "model"}
    assert sum(files.values()) < 8_000_000


def test_splits_name_what_exists_once():
    splits = load_splits()
    garments = {name.rsplit("_", 1)[0] for name in asset_names("garment")}
    for kind, names in (("motions", asset_names("motion")), ("garments", garments)):
        assert sorted(name for split in splits[kind].values() for name in split) == sorted(names)


@pytest.mark.parametrize("load", [load_garment, load_motion, load_model])
def test_unknown_names_list_what_exists(load):
    with pytest.raises(AssetError, match="there are"):
        load("nosuchthing")
    with pytest.raises(AssetError, match="did you mean cmu_016_32"):
        load_motion("cmu_016_3 2")


def test_a_network_takes_other_numbers_of_refinement_steps():
    trained = load_model("eslr-small")
    fewer = load_model("eslr-small:3")
    assert fewer.config == dataclasses.replace(trained.config, refinement_steps=3)
    with pytest.raises(AssetError, match="refinement_steps must be at least 1"):
        load_model("eslr-small:0")
    with pytest.raises(AssetError, match="has no refinement steps"):
        load_model("mgn-5-correction:2")


def test_a_folder_with_an_asset_s_name_is_not_taken_for_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("tshirt", "anny", "cmu_016_32"):
        (tmp_path / name).mkdir()
    assert load_garment_file("tshirt").rest_positions.shape == (1000, 3)
    assert load_body("anny").joint_names == load_motion("cmu_016_32").joint_names


def test_motions_that_cannot_be_played_are_refused(body, tmp_path):
    with pytest.raises(AssetError, match="doesn't exist"):
        load_motion(tmp_path / "walk.npz")
    motion = load_motion()
    with pytest.raises(MotionError, match="another skeleton"):
        pose_body(body, dataclasses.replace(motion, joint_names=("Pelvis", *motion.joint_names[1:])))
    with pytest.raises(MotionError, match="fewer than"):
        pose_body(body, motion, num_frames=10_000)


def test_broken_motions_are_refused(body):
    rotations, places = np.zeros((4, 31, 3)), np.zeros((4, 3))
    with pytest.raises(MotionError, match="no frames"):
        Motion("broken", rotations[:0], places[:0], 30.0, body.joint_names)
    for spoil in (np.nan, np.inf):
        rotations[2] = spoil
        with pytest.raises(MotionError, match="rotations of frame 2 are not finite"):
            Motion("broken", rotations, places, 30.0, body.joint_names)


@pytest.mark.parametrize("betas", [(), (-2.0,), (2.0,)])
def test_still_body_of_any_shape_stands_on_the_floor(betas):
    body = load_body(betas=betas)
    poses = pose_body(body, still_motion(body, 2))
    np.testing.assert_allclose(np.asarray(poses.positions)[..., 1].min(), 0.0, atol=1e-5)
    np.testing.assert_array_equal(poses.positions[0], poses.positions[1])
    rest = np.asarray(body.rest_positions)
    np.testing.assert_allclose(np.ptp(poses.positions[0], axis=0), np.ptp(rest, axis=0), atol=1e-5)


@pytest.fixture(scope="module")
def network():
    return MODELS["eslr-small"].new_network()


def test_foreign_weights_are_refused(tmp_path, network):
    write_network(tmp_path / "model.npz", network, {})
    path = tmp_path / "model.json"
    written = json.loads(path.read_text())
    for change, message in (
        ({"format": 99}, "update eslr-jax"),
        ({"model": {"base": "eslr", "latent_sise": 3}}, "another architecture"),
        ({"model": None}, "damaged|architecture"),
    ):
        path.write_text(json.dumps(written | change))
        with pytest.raises(CheckpointError, match=message):
            load_model(tmp_path / "model.npz")
    path.unlink()
    with pytest.raises(CheckpointError, match="copy both"):
        load_model(tmp_path / "model.npz")


def test_a_resolution_is_for_bundled_garments():
    check_resolution(["tshirt"], "4k")
    check_resolution(["shirt.obj", "tshirt"], "4k")
    check_resolution(["shirt.obj"], "1k")
    with pytest.raises(ConfigError, match=r"--vertices 4k is for bundled garments.*--edge-length"):
        check_resolution(["shirt.obj"], "4k")


def test_a_moving_mesh_is_a_body_at_rest_and_a_folder_named_like_a_body_is_none(tmp_path, monkeypatch, body):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "anny").mkdir()
    assert not is_moving_mesh("anny")
    assert load_wearer("anny").joint_names == body.joint_names
    rest = np.asarray(body.rest_positions)
    np.savez("scan.npz", positions=np.stack([rest, rest + 0.1]), faces=np.asarray(body.faces))
    np.testing.assert_allclose(load_wearer("scan.npz").rest_positions, rest, atol=1e-6)
    with pytest.raises(ConfigError, match="has no shapes; leave out --betas"):
        load_wearer("scan.npz", betas=(1.0,))
