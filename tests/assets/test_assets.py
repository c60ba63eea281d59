"""What is bundled is whole, named once, and refused with the cause where it is not."""

import dataclasses
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from garment_files import bundled, scanned_tshirt

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
from eslr_jax.pipeline.assets import asset_names, cache, garments, load_garment_file, load_splits
from eslr_jax.pipeline.assets.cache import cache_folder, cached, content_key, trim_folder
from eslr_jax.pipeline.assets.catalog import list_assets
from eslr_jax.pipeline.assets.garments import check_resolution
from eslr_jax.pipeline.cli.method import load_wearer
from eslr_jax.pipeline.dressing.options import FitOptions
from eslr_jax.pose.motion import Motion, still_motion
from eslr_jax.types import Garment


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
    assert load_wearer("anny").joint_names == body.joint_names
    rest = np.asarray(body.rest_positions)
    np.savez("scan.npz", positions=np.stack([rest, rest + 0.1]), faces=np.asarray(body.faces))
    np.testing.assert_allclose(load_wearer("scan.npz").rest_positions, rest, atol=1e-6)
    with pytest.raises(ConfigError, match="has no shapes; leave out --betas"):
        load_wearer("scan.npz", betas=(1.0,))


# --- garments of a user through the front door: fitted once, kept by content, safe with two processes -------


@pytest.fixture
def empty_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return cache_folder()


@pytest.fixture(scope="module")
def scan(tmp_path_factory, body):
    return scanned_tshirt(tmp_path_factory.mktemp("scan") / "shirt.obj", body)


def test_second_load_computes_nothing(empty_cache, scan, body, monkeypatch):
    first = load_garment(scan, body=body)
    assert len(list(empty_cache.iterdir())) == 2
    monkeypatch.setattr(garments, "fit_garment", None)
    monkeypatch.setattr(garments, "prepare_garment", None)
    again = load_garment(scan, body=body)
    for name in first.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
    with pytest.raises(TypeError):
        load_garment(scan, body=body, fit=FitOptions(pin=("loop:top",)))  # other options, another entry
    with pytest.raises(TypeError):
        load_garment(scan, body=body.replace(rest_positions=body.rest_positions * 1.01))  # another body


def test_a_garment_from_the_cache_has_the_structure_of_one_that_is_new(empty_cache):
    new = load_garment("tshirt", cache=False)
    static = [
        field.name for field in dataclasses.fields(Garment) if not field.metadata.get("pytree_node", True)
    ]
    assert static
    for _ in range(2):  # stored, then read
        kept = load_garment("tshirt")
        assert jax.tree.structure(kept) == jax.tree.structure(new)
        assert hash(jax.tree.structure(kept)) == hash(jax.tree.structure(new))
        for name in static:
            assert type(getattr(kept, name)) is type(getattr(new, name))


def test_changed_file_and_damaged_entry_are_made_again(empty_cache, tmp_path, body):
    path = tmp_path / "tank.npz"
    garment = bundled("tank_1k")
    np.savez(path, positions=garment.rest_positions, faces=garment.faces)
    first = load_garment_file(path, body=body)
    (entry,) = empty_cache.iterdir()
    entry.write_bytes(entry.read_bytes()[:1000])
    again = load_garment_file(path, body=body)
    np.testing.assert_allclose(first.rest_positions, again.rest_positions, atol=1e-6)
    np.savez(path, positions=garment.rest_positions + np.array([0, 0.01, 0]), faces=garment.faces)
    moved = load_garment_file(path, body=body)
    np.testing.assert_allclose(moved.sewn_positions[:, 1] - again.sewn_positions[:, 1], 0.01, atol=1e-6)


def test_an_entry_tells_the_joints_of_its_own_body(empty_cache, scan, body):
    other = body.replace(joint_names=(*body.joint_names[:-1], "tail"))  # else the same
    for rig in (body, other):
        entry = load_garment_file(scan, body=rig).metadata["body"]
        assert entry["joint_names"] == list(rig.joint_names)


def test_unwritable_cache_costs_only_time(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert cached(content_key("x"), lambda: {"a": np.ones(2)})["a"].tolist() == [1, 1]


def test_keys_tell_contents_apart():
    arrays = np.zeros(2), np.zeros((1, 2)), np.zeros(2, np.float32)
    others = "a", FitOptions(), FitOptions(units="cm")
    contents = [(b"ab", b"c"), (b"a", b"bc"), *((part,) for part in (*arrays, *others))]
    assert len({content_key(*parts) for parts in contents}) == len(contents)
    assert content_key(np.zeros(2), "a") == content_key(np.zeros(2), "a")


@pytest.mark.slow
def test_two_processes_may_make_the_same_entry(empty_cache):
    code = (
        "import numpy as np; from eslr_jax.pipeline.assets.cache import cached\n"
        "for k in range(40):\n"
        "    a = cached(f'{k:064d}', lambda: {'a': np.full((200, 200), k, float)})['a']\n"
        "    assert a.shape == (200, 200) and (a == k).all()"
    )
    workers = [subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE) for _ in range(2)]
    for worker in workers:
        _, errors = worker.communicate(timeout=60)
        assert worker.returncode == 0, errors
    assert len(list(empty_cache.iterdir())) == 40


@pytest.mark.slow
def test_4k_garment_is_quick(empty_cache, tmp_path, body):
    import time

    garment = bundled("tshirt_4k")
    np.savez(tmp_path / "shirt.npz", positions=garment.rest_positions * 100, faces=garment.faces)
    times = []
    for _ in range(2):
        began = time.process_time()
        load_garment(tmp_path / "shirt.npz", body=body)
        times.append(time.process_time() - began)
    assert times[0] < 5.0
    assert times[1] < 1.0


def test_all_that_computes_an_entry_is_part_of_its_name():
    """Whatever geometry and fit import makes their results; errors and options make none."""
    package = Path(cache.__file__).parents[2]
    listed = {file for name in cache._CODE for file in (package / name).glob("*.py")} | {
        package / name for name in cache._CODE if name.endswith(".py")
    }
    makes_nothing = {package / name for name in ("errors.py", "pipeline/extras.py")}
    for file in sorted(listed):
        for module in re.findall(r"^from eslr_jax\.(\S+) import", file.read_text(), flags=re.M):
            source = package / (module.replace(".", "/") + ".py")
            if source.exists() and file.parent.name in ("mesh", "pose", "dressing"):
                assert source in listed | makes_nothing, f"{file.name} imports {module}"


def test_a_doubtful_fit_is_told_with_every_load(empty_cache, tmp_path, body, monkeypatch):
    garment = bundled("tank_1k")
    np.savez(tmp_path / "tank.npz", positions=garment.rest_positions, faces=garment.faces)
    fitted = load_garment_file(tmp_path / "tank.npz", body=body)
    fitted.metadata["fit"]["warnings"] = ["the place is doubtful"]
    monkeypatch.setattr(garments, "load_garment_file", lambda *_, **__: fitted)
    with pytest.warns(UserWarning, match="tank.npz: the place is doubtful"):
        load_garment(tmp_path / "tank.npz", body=body)


def test_the_oldest_programs_go_where_they_take_too_much(tmp_path):
    for age, name in enumerate(["new", "old", "older"]):
        (tmp_path / name).write_bytes(bytes(100))
        os.utime(tmp_path / name, (1e9 - age, 1e9 - age))
    trim_folder(tmp_path, most=300)
    assert len(list(tmp_path.iterdir())) == 3
    trim_folder(tmp_path, most=250)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["new", "old"]
    trim_folder(tmp_path / "missing", most=0)
