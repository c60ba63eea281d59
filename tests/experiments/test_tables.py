"""Tables of the paper that grow row by row."""

import json
import os
import subprocess
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from commands import eslr_here
from paper import rollouts
from paper.rollouts import Setting, read_system
from paper.tables import (
    DEEP,
    PARTS,
    SYSTEMS,
    TABLES,
    check_costs,
    check_networks,
    rows_of_setting,
    table_setting,
    with_changes,
    with_row,
    with_totals,
)

from eslr_jax import NonFiniteError, Status

SETTING = Setting(("tshirt", "dress"), ("cmu_016_32",), 100, "1k")
ROW = {"stretch": 0.1, "gap_share": 0.1}
TABLE = {
    **SETTING._asdict(),
    "mean": {"mgn-5": ROW},
    "seeds": {},
    "garments": {"mgn-5": {"tshirt": ROW, "dress": ROW}},
    "networks": {"mgn-5": ["mgn-5-correction", "weights/second.npz"]},
    "environments": {"mgn-5": {"device": "cpu"}},
    "notes": {"mgn-5": "of older code"},
}


@pytest.fixture
def file(tmp_path):
    """Return the file of a table."""
    file = tmp_path / "table.json"
    file.write_text(json.dumps(TABLE))
    return file


def test_rows_of_the_same_setting_are_kept(file):
    assert rows_of_setting(file, SETTING) == {name: TABLE[name] for name in PARTS}


def test_a_row_that_is_measured_again_changes_nothing_of_the_others(file):
    row = {
        "mean": {"gap_share": 1.0},
        "networks": ["mgn-5-correction~untrained"],
        "environments": {"device": "gpu"},
    }
    changed = with_row(rows_of_setting(file, SETTING), "mgn-5, untrained", row)
    assert changed["mean"]["mgn-5, untrained"] == row["mean"]
    assert changed["environments"] == {"mgn-5": {"device": "cpu"}, "mgn-5, untrained": {"device": "gpu"}}
    assert changed["notes"] == TABLE["notes"]
    assert changed["mean"]["mgn-5"]["learned_share"] == pytest.approx(0.9)
    anew = with_row(changed, "mgn-5", {**row, "mean": {"gap_share": 0.2}})
    assert anew["mean"]["mgn-5"] == {"gap_share": 0.2, "learned_share": pytest.approx(0.8)}
    assert (anew["notes"], anew["garments"]) == ({}, {})  # what the new row doesn't have is not the old one's


def test_without_a_table_there_are_no_rows(tmp_path):
    assert rows_of_setting(tmp_path / "table.json", SETTING) == {name: {} for name in PARTS}


@pytest.mark.parametrize(
    ("other", "name"),
    [
        (SETTING._replace(garments=("tshirt",)), "garments"),
        (SETTING._replace(clips=("cmu_016_29",)), "clips"),
        (SETTING._replace(frames=50), "frames"),
    ],
)
def test_a_table_of_another_setting_is_not_written_over(file, other, name):
    with pytest.raises(SystemExit, match=f"other {name}; give another --out"):
        rows_of_setting(file, other)


def test_what_is_asked_for_is_taken_where_it_belongs_to_the_table():
    default = table_setting("native_garments", None, None, 100, "1k")
    assert (len(default.garments), len(default.clips)) == (6, 3)
    chosen = table_setting("native_garments", ["cmu_056_01", "deepmimic_walk"], ["pants", "scraf"], 100, "1k")
    assert (chosen.garments, chosen.clips) == (("pants",), ("cmu_056_01",))
    assert table_setting("unseen_garments", None, ["pants"], 100, "1k").garments == ()
    moved = table_setting("new_motion", ["cmu_056_01", "deepmimic_walk"], ["pants"], 100, "1k")
    assert (moved.garments, moved.clips, moved.frames) == (("pants",), ("deepmimic_walk",), 60)


def test_costs_of_other_rows_are_not_lost(tmp_path):
    file = tmp_path / "model_cost_1k.json"
    check_costs(file, ("mgn-5",))
    file.write_text(json.dumps({"mean": {"mgn-5": ROW, "eslr-5": ROW}}))
    check_costs(file, ("mgn-5", "eslr-5", "hood"))
    with pytest.raises(SystemExit, match="has rows for eslr-5; measure them too, or give another --out"):
        check_costs(file, ("mgn-5",))


def test_controls_of_weights_show_no_training_cost():
    assert read_system("mgn-5-correction").cost["core_hours"] > 0
    for control in ("untrained", "no_decoder"):
        assert "core_hours" not in read_system(f"mgn-5-correction~{control}").cost


def test_default_rows_have_every_bundled_network_of_five_layers():
    models = json.loads(eslr_here("assets", "--kind", "model", "--json").stdout)
    bundled = {model["name"] for model in models if model["name"].endswith("-5-correction")}
    assert bundled
    networks = {name for row in DEEP for name in row.split("=")[1].split(",")}
    assert bundled <= networks
    assert all(Path(file).is_file() for file in networks - bundled)


def test_the_default_command_goes_on_with_the_shipped_tables():
    rows = {label: tuple(names.split(",")) for label, names in (row.split("=", 1) for row in SYSTEMS)}
    check_costs(rollouts.RESULTS / "model_cost_1k.json", tuple(rows))
    for table in TABLES[:-1]:
        file = rollouts.RESULTS / f"{table}.json"
        kept = rows_of_setting(file, table_setting(table, None, None, 100, "1k"))
        assert kept["networks"]
        check_networks(file, with_changes(rows, table, True), kept["networks"])


def test_a_row_of_a_changed_network_has_no_controls_of_its_own():
    rows = {"raw": ("eslr-small~raw",), "eslr-5": ("eslr-5-correction",)}
    assert set(with_changes(rows, "native_garments", False)) == {*rows, "eslr-5, untrained"}


def test_costs_have_the_totals_of_the_table_of_their_size(file):
    costs = {"vertices": "1k", "mean": {"mgn-5": {"latency_ms": 1.0}, "mgn-15": {"latency_ms": 2.0}}}
    file.write_text(json.dumps({**TABLE, "mean": {"mgn-5": {"total": -0.3}, "guess": {"total": 9.0}}}))
    assert with_totals(costs, file)["mean"] == {
        "mgn-5": {"latency_ms": 1.0, "total": -0.3},
        "mgn-15": {"latency_ms": 2.0},
    }
    other = {"vertices": "4k", "mean": {"mgn-5": {"latency_ms": 1.0}}}
    assert "total" not in with_totals(other, file)["mean"]["mgn-5"]


def test_a_row_is_of_the_networks_that_it_was_measured_with(file):
    kept = rows_of_setting(file, SETTING)["networks"]
    check_networks(
        file, {"mgn-5": ("mgn-5-correction", "/else/where/weights/second.npz"), "new": ("eslr-small",)}, kept
    )
    with pytest.raises(SystemExit, match=r"a row mgn-5 of mgn-5-correction, weights/second.npz; give"):
        check_networks(file, {"mgn-5": ("mgn-5-correction", "other/second.npz")}, kept)


@pytest.fixture
def broken_rollouts(monkeypatch):
    """Let every other rollout meet a number that is not finite; nothing is simulated."""
    worn = SimpleNamespace(garment="tshirt", scene=None, root_height=lambda: 1.0)
    states = [Status.NON_FINITE, Status.OK]
    gap = SimpleNamespace(reached=np.ones(2), optimum=np.zeros(2), initial_gap=np.ones(2))

    class Row(SimpleNamespace):
        def __iter__(self):
            return iter((self.garment, self.scene, None))

    rows = [(Row(**vars(worn)), None) for _ in states]
    found = [SimpleNamespace(status=int(bits), first_bad_frame=3, demands={}) for bits in states]
    monkeypatch.setattr(rollouts, "scenes_of", lambda *_: rows)
    monkeypatch.setattr(rollouts, "simulate_scenes", lambda *_, **__: found)
    monkeypatch.setattr(rollouts, "trajectory_gap", lambda *_, **__: gap)
    monkeypatch.setattr(rollouts, "stepped_potentials", lambda *_: np.ones(2))
    monkeypatch.setattr(rollouts, "distance_mm", lambda *_: 0.0)
    monkeypatch.setattr(rollouts, "measure", lambda *_: {"stretch": 1.0})
    return [rollouts.Reference(None, gap)] * len(states)


def test_a_row_says_in_how_many_rollouts_a_network_was_not_finite(broken_rollouts, capsys):
    rows = rollouts.measure_system("guess", SETTING, broken_rollouts)
    assert rows["all"]["not_finite"] == rows["tshirt"]["not_finite"] == 0.5
    assert "not finite in 50% of the rollouts" in capsys.readouterr().out


@pytest.mark.usefixtures("broken_rollouts")
def test_a_reference_that_is_not_finite_is_refused():
    with pytest.raises(NonFiniteError, match="frame 3"):
        rollouts.find_references(SETTING)


def reproduce(tmp_path, what, eslr="", **environment):
    """Run the paper's script with stand-ins for its programs; return its exit code and the calls of them."""
    for name, does in (("eslr", eslr), ("python", "")):
        program = tmp_path / name
        program.write_text(f'#!/bin/sh\necho {name} "$@" >> "{tmp_path}/calls"\n{does}\n')
        program.chmod(0o755)
    path = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}", **environment}
    script = Path(rollouts.__file__).with_name("reproduce.sh")
    ended = subprocess.run(["bash", script, what, tmp_path / "out"], env=path, check=False)
    return ended.returncode, (tmp_path / "calls").read_text().splitlines()


def test_the_papers_script_stops_where_a_training_was_stopped(tmp_path):
    """`eslr train` ends without an error after Ctrl-C."""
    code, calls = reproduce(tmp_path, "small")
    assert (code, [call.split()[0] for call in calls]) == (1, ["eslr"])


def test_the_papers_form_is_trained_by_equal_recipes_and_in_pieces(tmp_path):
    for _ in range(2):
        _, calls = reproduce(tmp_path, "acceleration", 'mkdir -p "$5/checkpoints/1"', MINUTES="120")
    first, second = calls
    assert "1k-acceleration.toml" in first
    assert first.endswith("--set=model.base=eslr-5 --set=seed=0 --minutes 120")
    assert second == f"eslr train --out {tmp_path}/out/eslr-5-s0 --resume --minutes 120"


def test_the_papers_script_trains_every_network_twice_and_tabulates_the_second(tmp_path):
    writes = 'while [ "$1" != --out ]; do shift; done\nmkdir -p "$2"; touch "$2/model.npz"'
    code, (*trainings, tables) = reproduce(tmp_path, "small", writes)
    assert code == 0
    networks = [*(row.split("=")[0] for row in DEEP), "mgn-16"]  # which has no weights here
    assert len(trainings) == 4 * len(networks)
    for network in networks:
        first, second = (f"{tmp_path}/out/{network}-{run}/model.npz" for run in ("s0", "s0-on"))
        (going_on,) = (line for line in trainings if f"--start-from {first} " in line)
        assert f"--set=model.base={network} --set=seed=10" in going_on
        assert f" {network}={second},{tmp_path}/out/{network}-s1-on/model.npz " in tables
