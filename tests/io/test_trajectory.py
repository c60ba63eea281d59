"""Trajectory files come back as they were written, and broken ones are named."""

import contextlib
import os

import numpy as np
import pytest

from eslr_jax.errors import AssetError
from eslr_jax.io.trajectory import read_trajectory, write_trajectory


def make_arguments(num_frames=3):
    rng = np.random.default_rng(0)
    return {
        "positions": rng.normal(size=(num_frames, 5, 3)).astype(np.float32),
        "velocities": rng.normal(size=(num_frames, 5, 3)).astype(np.float32),
        "faces": np.array([[0, 1, 2], [2, 3, 4]]),
        "body_positions": rng.normal(size=(num_frames, 4, 3)).astype(np.float32),
        "body_faces": np.array([[0, 1, 2], [0, 2, 3]]),
        "timestep": 1 / 30,
        "metadata": {"garment": "tshirt", "versions": {"jax": "0.10"}, "pins": [1, 2]},
    }


def test_trajectory_round_trip_is_exact(tmp_path):
    arguments = make_arguments()
    write_trajectory(tmp_path / "run.npz", **arguments)
    result = read_trajectory(tmp_path / "run.npz")
    for name in ("positions", "velocities", "faces", "body_positions", "body_faces"):
        np.testing.assert_array_equal(getattr(result, name), arguments[name])
    assert result.timestep == arguments["timestep"]
    assert result.metadata == arguments["metadata"]
    assert result.num_frames == 3


def test_trajectory_without_a_body(tmp_path):
    arguments = make_arguments() | {"body_positions": None, "body_faces": None, "metadata": None}
    write_trajectory(tmp_path / "run.npz", **arguments)
    result = read_trajectory(tmp_path / "run.npz")
    assert result.body_positions is None
    assert result.body_faces is None
    assert result.metadata == {}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"velocities": np.zeros((3, 4, 3))}, "velocities"),
        ({"faces": np.array([[0, 1, 5]])}, "name vertex 5"),
        ({"faces": np.array([[0, 1, -1]])}, "vertex"),
        ({"positions": np.zeros((5, 3))}, "frames, vertices, 3"),
        ({"positions": np.zeros((0, 5, 3)), "velocities": np.zeros((0, 5, 3))}, "frames, vertices, 3"),
        ({"body_faces": None}, "both or neither"),
        ({"body_positions": np.zeros((2, 4, 3))}, "2 body frames"),
        ({"timestep": 0.0}, "timestep"),
        ({"timestep": np.nan}, "timestep"),
        ({"metadata": {"a": object()}}, "JSON"),
        ({"metadata": {"a": np.nan}}, "JSON"),
    ],
)
def test_write_trajectory_names_what_is_wrong_and_writes_nothing(tmp_path, change, message):
    with pytest.raises(AssetError, match=message):
        write_trajectory(tmp_path / "run.npz", **(make_arguments() | change))
    assert not os.listdir(tmp_path)


def test_read_trajectory_names_a_missing_or_foreign_file(tmp_path):
    with pytest.raises(AssetError, match="doesn't exist"):
        read_trajectory(tmp_path / "none.npz")
    with pytest.raises(AssetError, match="can't be read"):
        read_trajectory(tmp_path)
    (tmp_path / "text.npz").write_text("hello")
    with pytest.raises(AssetError, match="not an npz archive"):
        read_trajectory(tmp_path / "text.npz")
    np.savez(tmp_path / "other.npz", positions=np.zeros(3))
    with pytest.raises(AssetError, match="is no trajectory"):
        read_trajectory(tmp_path / "other.npz")


def test_read_trajectory_runs_no_pickle(tmp_path):
    write_trajectory(tmp_path / "run.npz", **make_arguments())
    with np.load(tmp_path / "run.npz") as archive:
        arrays = dict(archive)
    arrays["metadata"] = np.array([object()], dtype=object)
    np.savez(tmp_path / "run.npz", **arrays)
    with pytest.raises(AssetError, match="damaged"):
        read_trajectory(tmp_path / "run.npz")


@pytest.mark.filterwarnings("ignore")  # a damaged header may look like one from Python 2
def test_read_trajectory_survives_truncation_and_flipped_bytes(tmp_path):
    source = tmp_path / "run.npz"
    write_trajectory(source, **make_arguments())
    content, damaged = source.read_bytes(), tmp_path / "damaged.npz"
    rng = np.random.default_rng(1)
    for cut in range(0, len(content), 97):
        damaged.write_bytes(content[:cut])
        with pytest.raises(AssetError):
            read_trajectory(damaged)
    for _ in range(300):
        mutated = bytearray(content)
        for position in rng.integers(len(content), size=rng.integers(1, 6)):
            mutated[position] = rng.integers(256)
        damaged.write_bytes(mutated)
        with contextlib.suppress(AssetError):  # a flip in unused bytes may leave a valid file
            read_trajectory(damaged)
