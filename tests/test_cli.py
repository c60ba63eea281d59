"""The command line as a user meets it."""

import dataclasses
import inspect
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from formats import smpl_model, write_amass, write_bvh
from garment_files import scanned_tshirt

from eslr_jax.assets import load_body, load_garment_file, load_motion
from eslr_jax.body.rig import skeleton_motion
from eslr_jax.errors import AssetError, ConfigError, MotionError
from eslr_jax.fit.options import FitOptions
from eslr_jax.io.garment import read_garment_npz


def eslr(*arguments, cwd=None):
    command = [sys.executable, "-m", "eslr_jax.cli", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, check=False)


def refused(result, *words):
    lines = [line for line in result.stderr.strip().splitlines() if line.startswith("eslr: ")]
    assert result.returncode == 2, result.stderr
    assert len(lines) == 1, result.stderr
    assert "Traceback" not in result.stderr
    for word in words:
        assert word in lines[0]


@pytest.mark.slow
def test_simulate_writes_everything(tmp_path):
    result = eslr(
        "simulate", "--simulator", "physics", "--frames", 4, "--iterations", 20, "--out", tmp_path, "--json"
    )
    assert result.returncode == 0, result.stderr
    report = json.loads(result.stdout)
    for key in (
        "finite", "num_frames", "num_vertices", "terms", "total", "max_principal_stretch",
        "penetration_p999_mm", "penetration_max_mm", "penetrating_share", "frame_ms", "compile_s", "device",
        "versions",
    ):  # fmt: skip
        assert key in report
    assert report["num_frames"] == 4
    assert json.loads((tmp_path / "report.json").read_text()) == report
    assert {path.name for path in tmp_path.iterdir()} == {
        "trajectory.npz", "garment.npz", "animation.glb", "sheet.png", "report.json",
    }  # fmt: skip


@pytest.mark.slow
def test_a_first_run_tells_how_long_it_compiled(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))  # nothing is compiled there yet
    words = (
        "simulate",
        "--simulator",
        "physics",
        "--iterations",
        20,
        "--frames",
        4,
        "--no-pictures",
        "--json",
    )
    reports = []
    for _ in range(2):
        result = eslr(*words, "--out", tmp_path / "run")
        assert result.returncode == 0, result.stderr
        reports.append((json.loads(result.stdout)["compile_s"], result.stderr))
    (first, told), (second, untold) = reports
    assert first > 5
    assert f"waited {first:.0f} s for the compiler" in told
    assert second < 0.5 * first
    assert ("for the compiler" in untold) == (second > 5)


@pytest.mark.slow
@pytest.mark.parametrize(("iterations", "integrator"), [(0, "euler"), (5, "bdf2")])
def test_a_bundled_network_alone_steps_by_the_integrator_it_was_trained_with(
    tmp_path, iterations, integrator
):
    options = ("--model", "smooth-small", "--iterations", iterations, "--frames", 3, "--no-pictures")
    result = eslr("simulate", *options, "--out", tmp_path, "--json")
    assert result.returncode == 0, result.stderr
    report = json.loads(result.stdout)
    assert (report["model"], report["integrator"]) == ("smooth-small", integrator)
    assert report["finite"]


@pytest.mark.parametrize("command", ["simulate", "play", "score"])
def test_garments_may_be_given_again(command):
    from eslr_jax.cli import _refuse_repetition

    _refuse_repetition([command, "--garment", "pants", "--garment", "tshirt"])
    with pytest.raises(ConfigError, match="--motion is given twice"):
        _refuse_repetition([command, "--motion", "turn", "--motion=jump"])


@pytest.mark.skipif(sys.platform == "win32", reason="terminals differ")
def test_waiting_counts_its_seconds_on_a_terminal():
    import pty

    code = "import time; from eslr_jax.cli.console import waiting\nwith waiting('thinking'): time.sleep(1.5)"
    command = [sys.executable, "-c", code]
    assert not subprocess.run(command, check=True, stderr=subprocess.PIPE).stderr  # a file gets nothing
    ours, terminal = pty.openpty()
    subprocess.run(command, check=True, stderr=terminal, env=os.environ | {"TERM": "xterm", "COLUMNS": "80"})
    os.close(terminal)
    shown = os.read(ours, 1 << 20).decode()
    os.close(ours)
    for clock in ("0:00:00", "0:00:01"):
        assert f"thinking {clock}" in re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", shown)


@pytest.mark.skipif(sys.platform == "win32", reason="terminals differ")
def test_a_page_is_opened_where_a_person_sits(tmp_path):
    import pty

    browser, opened = tmp_path / "browser", tmp_path / "opened"
    browser.write_text(f'#!/bin/sh\necho "$1" > {opened}\n')
    browser.chmod(0o755)
    code = "from eslr_jax.cli.console import open_browser; open_browser('http://localhost:9')"
    command, settings = [sys.executable, "-c", code], os.environ | {"BROWSER": str(browser)}
    subprocess.run(command, env=settings, check=True, stdout=subprocess.PIPE)
    assert not opened.exists()  # nobody watches
    ours, terminal = pty.openpty()
    subprocess.run(command, env=settings, check=True, stdout=terminal)
    os.close(terminal)
    os.close(ours)
    assert opened.read_text() == "http://localhost:9\n"


def test_assets_lists_every_kind():
    result = eslr("assets", "--json", "--verify")
    kinds = {asset["kind"] for asset in json.loads(result.stdout)}
    assert {"body", "garment", "motion", "fabric"} <= kinds


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"body": "anny"}, "only --export takes a body; leave out --body"),
        ({"kind": "fabric", "verify": True}, "fabrics have no files; leave out --verify"),
        ({"export": Path("a.obj"), "kind": "body", "json_": True}, "lists nothing; leave out --kind, --json"),
        ({"export": Path("a.obj"), "verify": True}, "lists nothing; leave out --verify"),
    ],
)
def test_options_of_assets_that_would_do_nothing_are_refused(options, words):
    from eslr_jax.cli.assets import assets

    with pytest.raises(ConfigError, match=words):
        assets(**options)


def test_a_missing_file_is_told_with_the_damaged_ones(monkeypatch):
    from eslr_jax.assets import catalog
    from eslr_jax.cli.assets import assets

    lost = dataclasses.replace(catalog.list_assets()[0], file="lost.npz")
    monkeypatch.setattr(catalog, "list_assets", lambda: (lost,))
    with pytest.raises(AssetError, match=r"damaged or missing: lost\.npz"):
        assets(verify=True)


def test_info_takes_the_networks_that_simulate_takes(tmp_path, capsys, monkeypatch):
    from eslr_jax.assets.catalog import find_asset
    from eslr_jax.cli.assets import info

    info(model="eslr-small", json_=True)  # also an architecture, of twelve steps
    assert json.loads(capsys.readouterr().out)["config"]["refinement_steps"] == 14
    info(model="eslr-small:4", json_=True)
    assert json.loads(capsys.readouterr().out)["config"]["refinement_steps"] == 4
    bundled = find_asset("model", "eslr-small")
    (tmp_path / "mine").write_bytes(bundled.read_bytes())
    (tmp_path / "mine.json").write_bytes(bundled.with_suffix(".json").read_bytes())
    monkeypatch.chdir(tmp_path)
    info(model="mine", json_=True)
    assert json.loads(capsys.readouterr().out)["model"] == "mine"
    with pytest.raises(
        AssetError, match=r"did you mean eslr-small\? .* of architectures there are .*eslr-15"
    ):
        info(model="eslr-smal")
    with pytest.raises(ConfigError, match="only a --scene takes these; leave out --motion, --self-contact"):
        info(motion="turn", self_contact=True)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--garment", "tshrit"), ("no garment named", "tshirt")),
        (("--motion", "moonwalk"), ("no motion named", "cmu_016_32")),
        (("--body", "robot"), ("no body named", "anny")),
        (("--garment", "missing.obj"), ("missing.obj",)),
        (("--frames", "1"), ("two frames",)),
        (("--budget", "20ms", "--model", "eslr-small"), ("leave out", "--model")),
        (("--tolerance", "1%", "--iterations", "5"), ("leave out", "--iterations")),
        (("--budget", "20ms", "--tolerance", "1%"), ("either",)),
        (("--simulator", "physics", "--model", "eslr-small"), ("leave out --model",)),
        (("--garment", "tshirt", "--garment", "tshirt"), ("worn once only",)),
        (("--motion", "turn", "--motion", "jump"), ("--motion is given twice",)),
        (("--frames", "100000", "--simulator", "physics"), ("fewer than",)),
    ],
)
def test_unknown_names_are_refused_in_one_line(tmp_path, arguments, words):
    refused(eslr("simulate", "--out", tmp_path / "out", *arguments), *words)
    assert not list(tmp_path.glob("out/*"))


def test_unwritable_output_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    refused(eslr("simulate", "--out", tmp_path / "file"), "is a file")


@pytest.mark.slow
def test_broken_mesh_is_refused(tmp_path):
    def simulate(path):
        return eslr("simulate", "--garment", path, "--simulator", "physics", "--out", tmp_path / "out")

    mesh = trimesh.creation.icosphere(radius=2e4)
    mesh.export(tmp_path / "large.obj")
    refused(simulate(tmp_path / "large.obj"), "no garment's in m, cm, mm, in")
    (tmp_path / "empty.obj").write_text("")
    refused(simulate(tmp_path / "empty.obj"), "empty")


def test_fabrics_are_listed_with_their_sources():
    fabrics = json.loads(eslr("assets", "--kind", "fabric", "--json").stdout)
    assert {"cotton", "denim", "silk"} <= set(fabrics)
    assert all(fabric["source"] and fabric["density"] > 0 for fabric in fabrics.values())
    assert fabrics["cotton"]["stretch_stiffness"] == pytest.approx(32.94, abs=0.01)


@pytest.mark.slow
def test_render_and_view_refuse_what_is_no_run(tmp_path):
    refused(eslr("render", tmp_path, "--out", tmp_path / "a.gif"), ".mp4", ".png")
    refused(eslr("render", tmp_path, "--out", tmp_path / "a.png"), "is no run")
    refused(eslr("view", tmp_path), "is no run")


@pytest.mark.slow
def test_fit_refuses_what_it_cannot_do(tmp_path, body):
    scan = scanned_tshirt(tmp_path / "shirt.obj", body)
    refused(eslr("fit", scan, "--out", tmp_path / "shirt.obj"), "npz")
    refused(eslr("fit", scan, "--out", tmp_path / "a.npz", "--pin", "part:collar"), "front", "no such part")
    refused(eslr("fit", scan, "--out", tmp_path / "a.npz", "--fabric", "denin"), "did you mean denim")
    assert not (tmp_path / "a.npz").exists()


@pytest.mark.slow
def test_scanned_shirt_to_a_stable_simulation_in_one_command(tmp_path, body):
    """An OBJ with seams, in centimetres, Z up, 5 mm inside the body: no option but the file."""
    scan = scanned_tshirt(tmp_path / "shirt.obj", body)
    result = eslr("simulate", "--garment", scan, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["finite"]
    assert report["num_frames"] > 100
    assert report["max_principal_stretch"] < 1.4
    assert report["penetration_max_mm"] < 1.0
    assert "inside the body: 19 vertices, 5.0 mm deep, before; 0, 0.0 mm, after" in result.stderr


@pytest.mark.slow
def test_fit_writes_a_garment_and_a_picture(tmp_path, body):
    scan = scanned_tshirt(tmp_path / "shirt.obj", body)
    options = ("--pin", "loop:top", "--fabric", "silk", "front:denim", "--json")
    (tmp_path / "fitted.png").write_bytes(b"texture")
    result = eslr("fit", scan, "--out", tmp_path / "fitted.npz", *options)
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "fitted.png").read_bytes() == b"texture"
    assert json.loads(result.stdout)["pinned"] > 10
    assert (tmp_path / "fitted_fit.png").stat().st_size > 10_000
    run = ("--simulator", "physics", "--frames", 4, "--no-pictures", "--json", "--out", tmp_path / "run")
    result = eslr("simulate", "--garment", tmp_path / "fitted.npz", *run)
    assert result.returncode == 0, result.stderr
    report = json.loads(result.stdout)
    assert report["fabric"] == ["silk", "front:denim"]
    assert report["finite"]
    assert (tmp_path / "run" / "garment.npz").exists()


def test_fit_does_not_write_over_what_it_reads(tmp_path):
    from eslr_jax.cli.garments import fit

    np.savez(tmp_path / "mesh.npz", positions=np.eye(3), faces=np.arange(3)[None])
    before = (tmp_path / "mesh.npz").read_bytes()
    with pytest.raises(AssetError, match="a file that is read"):
        fit(str(tmp_path / "mesh.npz"), tmp_path / "." / "mesh.npz")
    assert (tmp_path / "mesh.npz").read_bytes() == before


def test_a_bundled_garment_takes_no_options_of_a_fit(tmp_path):
    from eslr_jax.cli.garments import fit

    options = FitOptions(pin=("none",), edge_length=0.01)
    with pytest.raises(ConfigError, match=r"pants is bundled.*leave out --edge-length, --pin"):
        fit("pants", tmp_path / "a.npz", options=options)


def test_a_garment_is_fitted_to_a_shape_of_the_body(tmp_path, capsys):
    from eslr_jax.cli.garments import fit

    fit("tank", tmp_path / "a.npz", betas=(2.0,), picture=False)
    fitted, usual = read_garment_npz(tmp_path / "a.npz"), load_garment_file("tank")
    assert np.ptp(fitted.rest_positions[:, 1]) > 1.02 * np.ptp(usual.rest_positions[:, 1])
    assert capsys.readouterr().out.splitlines()[-1] == str(tmp_path / "a.npz")
    with pytest.raises(ConfigError, match="leave out its unit"):
        fit("tank", tmp_path / "a.npz", body_units="cm", picture=False)


def test_no_iterations_are_those_of_a_network_alone():
    from eslr_jax.cli.method import choose_method
    from eslr_jax.cli.options import Options
    from eslr_jax.cli.simulate import simulate

    usual = {name: option.default for name, option in inspect.signature(simulate).parameters.items()}
    options = Options(**{field.name: usual[field.name] for field in dataclasses.fields(Options)})
    for given, expected in (
        ({"iterations": 0}, ("network", 0)),
        ({"iterations": 7}, ("physics", 7)),
    ):
        method = choose_method(dataclasses.replace(options, **given), (None, None), 1000, None)
        assert (method.simulator, method.config.iterations) == expected
    with pytest.raises(ConfigError, match="--iterations 0 needs a network; name --model, or give 1 or more"):
        choose_method(
            dataclasses.replace(options, iterations=0, simulator="physics"), (None, None), 1000, None
        )


def test_a_home_folder_is_expanded_before_anything_is_read(tmp_path, monkeypatch):
    from eslr_jax.cli.simulate import simulate

    monkeypatch.setenv("HOME", str(tmp_path))
    with pytest.raises(AssetError, match=f"{tmp_path}/run holds no interrupted simulation"):
        simulate(out=Path("~/run"), resume=True)


def test_a_map_is_written_for_joints_that_nobody_knows(tmp_path, capsys):
    from eslr_jax.cli.bodies import joints

    walk = skeleton_motion(load_motion("cmu_016_32"), load_body())
    bones = [f"Bone.{number:03}" for number in range(len(walk.skeleton.joint_names))]
    write_bvh(tmp_path / "a.bvh", walk, names=bones)
    joints(str(tmp_path / "a.bvh"), out=tmp_path / "map.json")
    values = json.loads((tmp_path / "map.json").read_text())
    assert values["LeftArm"] == ""
    assert "LeftArm" in capsys.readouterr().out
    joints("cmu_016_32", json_=True)
    values = json.loads(capsys.readouterr().out)
    assert values["LeftArm"] == "LeftArm"
    with pytest.raises(MotionError, match="needs no joint map"):
        joints("turn")


def test_the_map_that_is_shown_is_the_one_that_is_used(tmp_path, body, capsys):
    """SMPL parameters move a body of SMPL's family by name: its fingers rest."""
    from eslr_jax.cli.bodies import joints

    rng = np.random.default_rng(0)
    np.savez(tmp_path / "body.npz", **smpl_model(body, rng))
    write_amass(tmp_path / "walk.npz", rng.normal(0.0, 0.3, (4, 24, 3)), np.zeros((4, 3)), 30.0)
    joints(str(tmp_path / "walk.npz"), str(tmp_path / "body.npz"), json_=True)
    shown = json.loads(capsys.readouterr().out)
    target = load_body(str(tmp_path / "body.npz"))
    motion = load_motion(tmp_path / "walk.npz", body=target)
    moves = np.abs(motion.rotations).max(axis=(0, 2)) > 1e-6
    assert {name for name, other in shown.items() if other} == {
        name for name, is_moving in zip(target.joint_names, moves, strict=True) if is_moving
    }
    assert shown["left_hand"] == ""


def test_broken_motion_is_refused(tmp_path):
    path = tmp_path / "walk.npz"
    np.savez(path, something=np.zeros(3))
    refused(
        eslr("simulate", "--motion", path, "--simulator", "physics", "--out", tmp_path / "out"), "no motion"
    )


def test_a_resumed_training_takes_no_other_configuration(tmp_path):
    result = eslr("train", "--out", tmp_path / "run", "--resume", "--set", "iterations=3")
    refused(result, "--resume", "--set")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(("option", "value"), [("gap-frames", 2), ("every", 0), ("rollout-frames", 0)])
def test_an_evaluation_of_nothing_is_refused(option, value):
    result = eslr("evaluate", "--model", "eslr-small", f"--{option}", value)
    refused(result, option.replace("-", "_"), "or more")


@pytest.mark.skipif(sys.platform == "win32", reason="pipes differ")
@pytest.mark.parametrize("arguments", [["train", "--help"], ["assets", "--json"]])
def test_whoever_reads_the_output_may_leave(arguments):
    ours, end = os.pipe()
    os.close(ours)
    command = [sys.executable, "-m", "eslr_jax.cli", *arguments]
    result = subprocess.run(command, stdout=end, stderr=subprocess.PIPE, text=True, check=False)
    os.close(end)
    assert (result.returncode, result.stderr) == (141, "")
