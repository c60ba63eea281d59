"""Trajectory files come back as they were written, and broken ones are named."""

import dataclasses
import os

import numpy as np
import pytest

from eslr_jax import AssetError, load_trajectory, pose_body, prepare_scene
from eslr_jax.pipeline.assets import load_garment_file, prepare_stored
from eslr_jax.pipeline.formats.animated import AnimatedMesh, Skin
from eslr_jax.pipeline.formats.palette import SKIN_COLOR
from eslr_jax.pipeline.formats.trajectory import TrajectoryFile, read_trajectory, write_trajectory
from eslr_jax.pipeline.report.run import ClothTrack, read_run, run_trajectory, write_run
from eslr_jax.pose.motion import still_motion
from eslr_jax.terms import CLOTH

RNG = np.random.default_rng(0)
FRAMES = 3


def floats(*shape):
    return RNG.normal(size=shape).astype(np.float32)


BODY = AnimatedMesh(
    "body",
    positions=floats(FRAMES, 4, 3),
    faces=np.array([[0, 1, 2], [0, 2, 3]]),
    color=SKIN_COLOR,
    rest_positions=floats(4, 3),
    skin=Skin(
        np.full((4, 2), np.float32(0.5)), np.tile([0, 1], (4, 1)), floats(FRAMES, 2, 3, 4), floats(2, 3),
        (-1, 0), ("hips", "spine"),
    ),
)  # fmt: skip
WHOLE = TrajectoryFile(
    positions=floats(FRAMES, 5, 3),
    velocities=floats(FRAMES, 5, 3),
    faces=np.array([[0, 1, 2], [2, 3, 4]]),
    timestep=1 / 30,
    metadata={"garment": "tshirt", "versions": {"jax": "0.10"}, "pins": [1, 2]},
    body=BODY,
    friction_loads=np.abs(floats(FRAMES, 5)),
)


def assert_equal(found, expected):
    """Compare two values, field by field where they have fields."""
    if dataclasses.is_dataclass(expected):
        for field in dataclasses.fields(expected):
            assert_equal(getattr(found, field.name), getattr(expected, field.name))
    elif isinstance(expected, np.ndarray | np.generic):
        np.testing.assert_array_equal(found, expected)
    else:
        assert found == expected


@pytest.mark.parametrize(
    "trajectory",
    [WHOLE, dataclasses.replace(WHOLE, body=None, friction_loads=None, metadata={})],
    ids=["whole", "bare"],
)
def test_trajectory_round_trip_is_exact(tmp_path, trajectory):
    write_trajectory(tmp_path / "run.npz", trajectory)
    found = read_trajectory(tmp_path / "run.npz")
    assert_equal(found, trajectory)
    assert found.num_frames == FRAMES


def test_a_run_is_read_from_its_folder_or_its_file_and_its_report_from_the_json_alone(tmp_path):
    write_trajectory(tmp_path / "trajectory.npz", WHOLE)
    for path in (tmp_path, str(tmp_path / "trajectory.npz")):
        assert_equal(load_trajectory(path), WHOLE)
    with pytest.raises(AssetError, match="give a folder that `eslr simulate` wrote"):
        load_trajectory(tmp_path / "none")
    assert read_run(tmp_path).report == {}
    (tmp_path / "report.json").write_text('{"total": 2.0}')
    run = read_run(tmp_path)
    assert run.report == {"total": 2.0}
    assert_equal(run.trajectory, WHOLE)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"faces": np.array([[0, 1, 5]])}, "names 5 of 5 vertices"),
        ({"positions": np.zeros((0, 5, 3)), "velocities": np.zeros((0, 5, 3)), "body": None,
          "friction_loads": None}, "0 frames"),
        ({"body": dataclasses.replace(BODY, positions=np.zeros((2, 4, 3)))}, "body_positions"),
        ({"timestep": np.nan}, "timestep"),
        ({"metadata": {"a": object()}}, "JSON"),
        ({"metadata": {"a": np.nan}}, "JSON"),
    ],
)  # fmt: skip
def test_write_trajectory_names_what_is_wrong_and_writes_nothing(tmp_path, change, message):
    with pytest.raises(AssetError, match=message):
        write_trajectory(tmp_path / "run.npz", dataclasses.replace(WHOLE, **change))
    assert not os.listdir(tmp_path)


def test_a_run_is_written_whole_or_not_at_all(tmp_path, body, monkeypatch):
    """What an earlier run left in the folder stays then, so that no report is of another trajectory."""
    garment, rig = load_garment_file("tshirt"), body
    poses = pose_body(rig, still_motion(rig, 3))
    scene = prepare_scene(prepare_stored(garment), poses, terms=CLOTH)
    moved = np.repeat(np.asarray(scene.initial_state.position)[None], 3, axis=0)
    residuals = np.arange(len(moved), dtype=np.float32)
    track = ClothTrack(moved, np.zeros_like(moved), np.zeros(moved.shape[:2]), residuals)
    write_run(tmp_path, track, scene, (rig, poses, garment), report={"total": 1.0})
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["animation.glb", "garment.npz", "report.json", "scene.npz", "trajectory.npz"]

    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("eslr_jax.pipeline.report.run.export_trajectory", stop)
    with pytest.raises(KeyboardInterrupt):
        write_run(
            tmp_path,
            track._replace(positions=moved + 1.0),
            scene,
            (rig, poses, garment),
            report={"total": 2.0},
        )
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    monkeypatch.undo()
    (tmp_path / "trajectory.npz").rename(tmp_path / "kept")
    (tmp_path / "trajectory.npz").mkdir()  # the last of the files: those before it are in place
    with pytest.raises(AssetError, match=r"can't write .*trajectory\.npz"):
        write_run(tmp_path, track, None, (rig, poses, garment), report={"total": 2.0})
    (tmp_path / "trajectory.npz").rmdir()
    (tmp_path / "kept").rename(tmp_path / "trajectory.npz")
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    kept = read_run(tmp_path)
    assert kept.scene.num_frames == 3
    assert kept.report == {"total": 1.0}
    np.testing.assert_allclose(kept.trajectory.positions, moved, atol=1e-5)
    again = run_trajectory(kept)
    np.testing.assert_array_equal(again.residuals, residuals)
    write_run(tmp_path, track, None, (rig, poses, garment), report={"total": 3.0})
    assert sorted(path.name for path in tmp_path.iterdir()) == [name for name in names if name != "scene.npz"]
