"""Files appear whole or not at all."""

import contextlib
import os

import pytest

from eslr_jax import AssetError
from eslr_jax.files.atomic import atomic_write, ensure_output_dir


def test_atomic_write_replaces_the_file_and_keeps_the_suffix(tmp_path):
    target = tmp_path / "result.npz"
    target.write_text("old")
    with atomic_write(target) as temporary:
        assert temporary.parent == tmp_path
        assert temporary.suffix == ".npz"
        temporary.write_text("new")
        assert target.read_text() == "old"
    assert target.read_text() == "new"
    assert os.listdir(tmp_path) == ["result.npz"]


def test_atomic_write_failure_leaves_everything_as_before(tmp_path):
    target = tmp_path / "result.npz"
    target.write_text("old")
    with contextlib.suppress(KeyboardInterrupt), atomic_write(target) as temporary:
        temporary.write_text("half")
        raise KeyboardInterrupt
    assert target.read_text() == "old"
    assert os.listdir(tmp_path) == ["result.npz"]


@pytest.mark.parametrize("place", ["", "missing/file", "file"])
def test_atomic_write_names_an_impossible_target_and_a_block_that_wrote_nothing(tmp_path, place):
    with pytest.raises(AssetError, match="can't write"), atomic_write(tmp_path / place):
        pass


def test_ensure_output_dir_creates_parents_and_leaves_them_empty(tmp_path):
    folder = ensure_output_dir(tmp_path / "a" / "b")
    assert folder.is_dir()
    assert not os.listdir(folder)


@pytest.mark.parametrize("name", ["file", "file/below"])
def test_ensure_output_dir_names_a_file_in_the_way(tmp_path, name):
    (tmp_path / "file").write_text("")
    with pytest.raises(AssetError, match="output folder"):
        ensure_output_dir(tmp_path / name)
