"""`eslr batch`: which scenes a file holds, what is refused, and that a killed worker loses nothing."""

import json
import os
import signal
import threading
import time

import numpy as np
import pytest
from commands import eslr, eslr_here, refused, succeeded

from eslr_jax.pipeline.cli.batch import (
    MANIFEST,
    read_manifest,
    read_scenes,
    shared_reach,
    simulate_scenes,
)
from eslr_jax.pipeline.report.run import read_run

GRID = """
seeds = 2
[options]
frames = 3
[every]
garment = ["tshirt", ["pants", "tshirt"]]
motion = ["jump", "turn", "swing", "cmu_016_32"]
[draw]
betas = [[-1.0, 1.0], [0.5, 0.5]]
start = [0.0, 0.2]
[split]
by = "motion"
validation = 0.25
test = 0.25
"""


def scenes_of(folder, text):
    (folder / "scenes.toml").write_text(text)
    return read_scenes(folder / "scenes.toml")


def test_every_combination_is_a_scene_with_its_own_draws(tmp_path):
    scenes = scenes_of(tmp_path, GRID)
    assert len(scenes) == 2 * 4 * 2
    pairs = {(tuple(each.options["garment"]), each.options["motion"], each.seed) for each in scenes.values()}
    assert len(pairs) == len(scenes)
    drawn = np.array([each.options["betas"] for each in scenes.values()])
    assert len(np.unique(drawn[:, 0])) == len(scenes)
    assert (np.abs(drawn[:, 0]) <= 1).all()
    assert (drawn[:, 1] == 0.5).all()
    assert all(0 <= float(each.options["start"].removesuffix("s")) <= 0.2 for each in scenes.values())
    assert {each.options["frames"] for each in scenes.values()} == {3}
    assert any(name.startswith("pants+tshirt-swing-s1-") for name in scenes)
    more = scenes_of(tmp_path, GRID.replace('"jump", ', '"jump", "cmu_069_23", '))
    assert scenes.keys() < more.keys()  # other values change no scene that is done
    assert len({each.program for each in scenes.values()}) == 2  # one a garment


def test_no_motion_is_in_two_splits(tmp_path):
    splits = {}
    for scene in scenes_of(tmp_path, GRID).values():
        splits.setdefault(scene.split, set()).add(scene.options["motion"])
    assert sorted(map(len, splits.values())) == [1, 1, 2]
    assert len(set().union(*splits.values())) == 4
    alone = scenes_of(tmp_path, GRID.partition("[split]")[0])
    assert {scene.split for scene in alone.values()} == {"train"}


@pytest.mark.parametrize(
    ("old", "new", "cause"),
    [
        ("seeds = 2", "seeds = 0", "seeds = 0; give 1"),
        ("seeds = 2", "sedes = 2", "did you mean seeds"),
        ("[draw]", "[drawn]", "did you mean draw"),
        ("frames = 3", "frmes = 3", "did you mean frames"),
        ("frames = 3", "frames = 'ten'", "frames = 'ten' has the wrong type"),
        ("frames = 3", "frames = 1", "two frames or more"),
        ("frames = 3", "frames = 3\nmotion = 'jump'", "motion is in two tables"),
        ('["tshirt", ["pants", "tshirt"]]', '"tshirt"', "every.garment = 'tshirt'; give a list"),
        ("[[-1.0, 1.0], [0.5, 0.5]]", "[1.0, -1.0]", "draw.betas"),
        ("[[-1.0, 1.0], [0.5, 0.5]]", "[[1.0], [1.0, 2.0]]", "draw.betas"),
        ('by = "motion"', 'by = "fabric"', "split.by = 'fabric'; name an option of [every]"),
        ("test = 0.25", "test = 0.05", "split.test = 0.05 of 4 values of motion is none"),
        ("test = 0.25", "test = 0.8", "together less than 1"),
        ("[draw]\nbetas = [[-1.0, 1.0], [0.5, 0.5]]\nstart = [0.0, 0.2]\n", "", "seeds = 2 without [draw]"),
        ("seeds = 2", "seeds 2", "scenes.toml: "),
        (GRID, "", "every"),
    ],
)
def test_a_file_that_is_wrong_is_one_line_and_no_folder(tmp_path, monkeypatch, old, new, cause):
    assert GRID.count(old) == 1
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scenes.toml").write_text(GRID.replace(old, new))
    refused(eslr_here("batch", "scenes.toml", "--out", "data"), cause, "scenes.toml")
    assert os.listdir(tmp_path) == ["scenes.toml"]


def test_commands_that_cannot_be_begun_are_one_line(tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.chdir(tmp_path)
    refused(eslr_here("batch", "missing.toml", "--out", "data"), "missing.toml can't be read")
    (tmp_path / "scenes.toml").write_text(GRID)
    refused(eslr_here("batch", "scenes.toml", "--out", "data", "--workers", 0), "--workers 0")
    refused(eslr_here("score", "."), "holds no")  # a folder without a manifest is none of a batch
    (tmp_path / MANIFEST).write_text("{}")
    refused(eslr_here("score", "."), "manifest.json is damaged")


FEW = """
seeds = 3
[options]
frames = 3
settle = 0
iterations = 1
contact = "fast"
[every]
garment = ["tshirt", "tshrit"]
motion = ["jump", "turn"]
[draw]
betas = [[-0.5, 0.5]]
"""


@pytest.mark.slow  # 80 to 100 s on a busy machine: two processes begin with JAX, and compile
def test_a_killed_worker_costs_its_task_alone(tmp_path):
    """One of two workers is killed while it simulates: every scene is there once and whole."""
    distributed = pytest.importorskip("distributed")
    scenes = scenes_of(tmp_path, FEW)
    out = tmp_path / "data"
    out.mkdir()
    killed, is_over = [], threading.Event()
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, memory_limit=None, dashboard_address=None
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        near = shared_reach(scenes, out, client)
        assert sorted(reach is None for reach in near.values()) == [
            False,
            True,
        ]  # the misspelled one has none

        def kill():
            while not is_over.is_set():
                if len(list(out.glob(".tshirt*.part"))) == 2:  # both are at it
                    killed.append(next(iter(cluster.workers.values())).pid)
                    os.kill(killed[0], signal.SIGKILL)
                    return
                time.sleep(0.02)

        killer = threading.Thread(target=kill)
        killer.start()
        ended = list(simulate_scenes(scenes, out, client, near))
        is_over.set()
        killer.join()
    assert killed
    names = [name for name, _ in ended]
    assert sorted(names) == sorted(scenes)  # nothing lost, nothing twice
    for name, error in ended:
        assert (error is None) == name.startswith("tshirt"), (name, error)
    runs = [path for path in out.iterdir() if path.is_dir() and not path.name.startswith(".")]
    assert {path.name for path in runs} == {name for name in scenes if name.startswith("tshirt")}
    sizes = {read_run(path).scene.body.surface.faces.shape for path in runs}
    assert len(sizes) == 1  # bodies and motions differ, the program is one
    assert {read_run(path).trajectory.num_frames for path in runs} == {3}


@pytest.mark.slow  # 60 to 90 s on a busy machine
def test_the_command_goes_on_tells_failures_and_is_scored(tmp_path):
    pytest.importorskip("distributed")
    text = FEW.replace("seeds = 3", "seeds = 1")
    (tmp_path / "scenes.toml").write_text(text)
    done = eslr("batch", "scenes.toml", "--out", "data", "--workers", 1, cwd=tmp_path)
    refused(done, "2 of 4 scenes failed")
    assert done.stdout.count("did you mean tshirt") == 2
    out = tmp_path / "data"
    before = {path: path.stat().st_mtime_ns for path in out.glob("tshirt*/*")}
    assert len(before) == 2 * 6
    (out / ".tshirt-turn.0.part").mkdir()  # of a worker that was killed
    (tmp_path / "scenes.toml").write_text(text.replace('["tshirt", "tshrit"]', '["tshirt"]'))
    done = succeeded(eslr("batch", "scenes.toml", "--out", "data", cwd=tmp_path))
    assert "2 of 2 scenes are done already" in done.stderr
    assert {path: path.stat().st_mtime_ns for path in out.glob("tshirt*/*")} == before
    assert not list(out.glob(".*.part"))
    entries = read_manifest(out)
    assert {entry["status"] for entry in entries.values()} == {"done"}
    assert all(entry["num_frames"] == 3 for entry in entries.values())
    scored = succeeded(eslr("score", "data", "--json", cwd=tmp_path))
    rows = json.loads(scored.stdout)
    assert [row["scene"] for row in rows] == sorted(entries)
    assert all(row["gap_relative_median"] > 0 and row["split"] == "train" for row in rows)
