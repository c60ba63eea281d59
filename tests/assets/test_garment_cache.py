"""Garments of a user through the front door: fitted once, kept by content, safe with two processes."""

import dataclasses
import os
import re
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from garment_files import bundled, scanned_tshirt

from eslr_jax import load_garment
from eslr_jax.pipeline.assets import cache, garments, load_garment_file
from eslr_jax.pipeline.assets.cache import (
    cache_folder,
    cached,
    content_key,
    trim_folder,
)
from eslr_jax.pipeline.dressing.options import FitOptions
from eslr_jax.pipeline.formats.garment import write_garment_npz
from eslr_jax.types import Garment


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
    contents = [
        (b"ab", b"c"),
        (b"a", b"bc"),
        (np.zeros(2),),
        (np.zeros((1, 2)),),
        (np.zeros(2, np.float32),),
        ("a",),
        (FitOptions(),),
        (FitOptions(units="cm"),),
    ]
    keys = {content_key(*parts) for parts in contents}
    assert len(keys) == 8
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


def test_fitted_file_is_taken_as_it_is(empty_cache, tmp_path, scan, body):
    fitted = load_garment_file(scan, body=body)
    write_garment_npz(tmp_path / "fitted.npz", fitted)
    again = load_garment_file(tmp_path / "fitted.npz")
    np.testing.assert_allclose(again.rest_positions, fitted.rest_positions, atol=1e-6)
    assert again.metadata == fitted.metadata
    assert not any(path.suffix == ".tmp" for path in empty_cache.iterdir())


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
    makes_nothing = {package / name for name in ("errors.py", "extras.py")}
    for file in sorted(listed):
        for module in re.findall(r"^from eslr_jax\.(\S+) import", file.read_text(), flags=re.M):
            source = package / (module.replace(".", "/") + ".py")
            if source.exists() and file.parent.name in ("fit", "geometry"):
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
