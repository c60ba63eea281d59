"""The command line as a user meets it."""

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
from commands import eslr, eslr_here, refused, simulated, succeeded
from foreign_files import moving, smpl_model, write_amass, write_bvh
from garment_files import scanned_tshirt
from own_term import Push

from eslr_jax import ConfigError, MotionError, load_body, load_motion, pose_body
from eslr_jax.config import from_dict
from eslr_jax.pipeline.assets import load_garment_file
from eslr_jax.pipeline.cli.console import use_compile_cache
from eslr_jax.pipeline.cli.method import choose_method
from eslr_jax.pipeline.cli.options import Options
from eslr_jax.pipeline.formats.garment import read_garment_npz
from eslr_jax.terms import Contact


@pytest.mark.slow
def test_simulate_writes_everything(tmp_path):
    words = ("--simulator", "physics", "--frames", 4, "--iterations", 20, "--json")
    report = json.loads(succeeded(eslr("simulate", *words, "--out", tmp_path)).stdout)
    for key in (
        "finite", "num_frames", "num_vertices", "terms", "total", "max_principal_stretch",
        "penetration_p999_mm", "penetration_max_mm", "penetrating_share", "frame_ms", "compile_s", "device",
        "versions",
    ):  # fmt: skip
        assert key in report
    assert report["num_frames"] == 4
    assert json.loads((tmp_path / "report.json").read_text()) == report
    assert {path.name for path in tmp_path.iterdir()} == {
        "trajectory.npz", "scene.npz", "garment.npz", "animation.glb", "sheet.png", "report.json",
    }  # fmt: skip


def test_a_term_of_ones_own_takes_its_constants_and_choices_from_the_command_line():
    terms = Options(term=("own_term:Push,pressure=2", "eslr_jax.terms:Contact,rows=512")).terms()
    assert terms[-1] == Push(np.float32(2.0))
    assert [term.rows for term in terms if isinstance(term, Contact)] == [512]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("own_terms:Push", "No module named 'own_terms'"),
        ("own_term", "no class of this name"),
        ("own_term:struct", "no class of this name"),
        ("own_term:Push", "pressure"),
        ("own_term:Push,pressure=", "write all its constants"),
        ("own_term:Push,pressure='strong'", "could not convert"),
        ("own_term:Push,pressure=2,speed=3", "speed"),
    ],
)
def test_a_term_that_can_not_be_made_is_refused_in_one_line(text, reason):
    with pytest.raises(ConfigError, match=reason) as caught:
        Options(term=(text,)).terms()
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_a_first_run_tells_how_long_it_compiled(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))  # nothing is compiled there yet
    (one, told), (other, untold) = (
        simulated(tmp_path / "run", "--iterations", 20, "--frames", 4) for _ in range(2)
    )
    first, second = one["compile_s"], other["compile_s"]
    assert first > 5
    assert f"waited {first:.0f} s for the compiler" in told
    assert second < 0.5 * first
    assert ("for the compiler" in untold) == (second > 5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "integrator", "method"),
    [
        (("--iterations", 0), "euler", "smooth-small"),
        ((), "bdf2", "smooth-small, then 10 iterations of the solver"),
    ],
)
def test_a_network_alone_steps_as_it_was_trained_and_iterations_that_are_added_are_announced(
    tmp_path, options, integrator, method
):
    words = ("--model", "smooth-small", "--frames", 3, "--settle", 0, "--no-pictures", "--json")
    done = succeeded(eslr("simulate", *words, *options, "--out", tmp_path))
    report = json.loads(done.stdout)
    assert (report["integrator"], report["model"]) == (integrator, method)
    assert report["finite"]
    line = f"a frame is solved by {method}; --iterations 0 is the network alone"
    assert done.stderr.splitlines().count(line) == (not options)


def test_a_compile_cache_that_is_set_is_kept(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    own = jax.config.jax_compilation_cache_dir
    use_compile_cache()
    assert own is not None
    assert jax.config.jax_compilation_cache_dir == own
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(sys.platform == "win32", reason="terminals differ")
def test_waiting_counts_its_seconds_on_a_terminal():
    import pty

    code = "import time; from eslr_jax.pipeline.cli.console import waiting\n"
    code += "with waiting('thinking'): time.sleep(1.5)"
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
    code = "from eslr_jax.pipeline.cli.console import open_browser; open_browser('http://localhost:9')"
    command, settings = [sys.executable, "-c", code], os.environ | {"BROWSER": str(browser)}
    subprocess.run(command, env=settings, check=True, stdout=subprocess.PIPE)
    assert not opened.exists()  # nobody watches
    ours, terminal = pty.openpty()
    subprocess.run(command, env=settings, check=True, stdout=terminal)
    os.close(terminal)
    os.close(ours)
    assert opened.read_text() == "http://localhost:9\n"


def test_commands_silence_the_log_of_xla_before_jax_reads_the_setting():
    """Its errors become exceptions; what is left asks a user whose compilation is slow to file a bug."""
    code = (
        "import os, sys; from eslr_jax.pipeline import cli; sys.argv = ['eslr', 'assets', '--kind', 'fabric']; "
        "assert 'jax' not in sys.modules; cli.main(); print(os.environ['TF_CPP_MIN_LOG_LEVEL'])"
    )
    settings = {key: value for key, value in os.environ.items() if key != "TF_CPP_MIN_LOG_LEVEL"}
    found = subprocess.run(
        [sys.executable, "-c", code], env=settings, check=True, capture_output=True, text=True
    )
    assert found.stdout.split()[-1] == "3"


def test_assets_lists_every_kind(body):
    done = succeeded(eslr_here("assets", "--json", "--verify"))
    listed = json.loads(done.stdout)
    assert all(asset["source"] and (asset["kind"] == "fabric" or asset["licence"]) for asset in listed)
    assert {"body", "garment", "motion", "fabric"} <= {asset["kind"] for asset in listed}
    (clip,) = (asset for asset in listed if asset["name"] == "cmu_016_22")
    poses = pose_body(body, load_motion("cmu_016_22"), num_frames=clip["frames"])
    assert len(poses.positions) == clip["frames"]
    with pytest.raises(MotionError, match="fewer than"):
        pose_body(body, load_motion("cmu_016_22"), num_frames=clip["frames"] + 1)
    fabrics = json.loads(eslr_here("assets", "--kind", "fabric", "--json").stdout)
    assert all(fabric["source"] and fabric["density"] > 0 for fabric in fabrics.values())
    assert fabrics["cotton"]["stretch_stiffness"] == pytest.approx(32.94, abs=0.01)


def test_what_runs_keep_is_shown_and_removed(tmp_path, monkeypatch):
    from eslr_jax.pipeline.assets.cache import user_cache

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    programs = user_cache() / "compiled" / "traced"
    programs.mkdir(parents=True)
    (programs / "one").write_bytes(bytes(2_000_000))
    (user_cache() / "calibration.json").write_text("{}")
    shown = json.loads(eslr_here("cache", "--json").stdout)
    assert (shown["compiled"]["files"], shown["compiled"]["mb"], shown["garments"]["files"]) == (1, 2.0, 0)
    cleared = eslr_here("cache", "--clear")
    assert "compiled: 1 files, 2.0 MB" in cleared.stdout
    assert not programs.exists()
    assert (user_cache() / "calibration.json").exists()  # a measurement of this machine stays
    assert eslr_here("cache", "--clear").returncode == 0  # nothing is left


def test_a_file_that_differs_from_its_checksum_is_told(monkeypatch):
    from eslr_jax.pipeline.assets import catalog

    lost = dataclasses.replace(catalog.list_assets()[0], file="lost.npz")
    monkeypatch.setattr(catalog, "list_assets", lambda: (lost,))
    refused(eslr_here("assets", "--verify"), "damaged or missing: lost.npz")


def test_info_takes_the_networks_that_simulate_takes(tmp_path, monkeypatch):
    from eslr_jax.pipeline.assets.catalog import find_asset

    def shown(model):
        done = succeeded(eslr_here("info", "--model", model, "--json"))
        return json.loads(done.stdout)

    assert shown("eslr-small")["config"]["refinement_steps"] == 14  # also an architecture, of twelve steps
    assert shown("eslr-small:4")["config"]["refinement_steps"] == 4
    assert "4 a frame" in shown("eslr-small:4")["form"]
    assert "acceleration" in shown("eslr-5")["form"]  # the paper's
    bundled = find_asset("model", "eslr-small")
    (tmp_path / "mine").write_bytes(bundled.read_bytes())
    (tmp_path / "mine.json").write_bytes(bundled.with_suffix(".json").read_bytes())
    monkeypatch.chdir(tmp_path)
    assert shown("mine")["model"] == "mine"


@pytest.mark.slow
def test_scanned_shirt_to_a_stable_simulation_in_one_command(tmp_path, body):
    """An OBJ with seams, in centimetres, Z up, 5 mm inside the body: no option but the file."""
    scan = scanned_tshirt(tmp_path / "shirt.obj", body)
    result = succeeded(eslr("simulate", "--garment", scan, cwd=tmp_path))
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
    result = succeeded(eslr("fit", scan, "--out", tmp_path / "fitted.npz", *options))
    assert (tmp_path / "fitted.png").read_bytes() == b"texture"
    assert json.loads(result.stdout)["pinned"] > 10
    assert (tmp_path / "fitted_fit.png").stat().st_size > 10_000
    report, _ = simulated(tmp_path / "run", "--garment", tmp_path / "fitted.npz", "--frames", 4)
    assert report["fabric"] == ["silk", "front:denim"]
    assert (tmp_path / "run" / "garment.npz").exists()


def test_a_garment_is_fitted_to_a_shape_of_the_body(tmp_path):
    done = eslr_here("fit", "tank", "--out", tmp_path / "a.npz", "--betas", 2, "--no-picture")
    assert done.stdout.splitlines()[-1] == str(tmp_path / "a.npz"), done.stderr
    fitted, usual = read_garment_npz(tmp_path / "a.npz"), load_garment_file("tank")
    assert np.ptp(fitted.rest_positions[:, 1]) > 1.02 * np.ptp(usual.rest_positions[:, 1])


def test_a_home_folder_is_expanded_before_anything_is_read(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    refused(eslr_here("simulate", "--resume", "--out", "~/run"), f"{tmp_path}/run holds no interrupted")


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, (None, 500, 0.01)),
        ({"simulator": "physics"}, (None, 500, 0.01)),
        ({"tolerance": "0.1%"}, (None, 500, 0.001)),
        ({"iterations": 7}, (None, 7, None)),
        ({"model": "smooth-small"}, ("smooth-small, then 10 iterations of the solver", 10, None)),
        (
            {"model": "smooth-small", "iterations": 3},
            ("smooth-small, then 3 iterations of the solver", 3, None),
        ),
        ({"model": "smooth-small", "tolerance": "5%"}, ("smooth-small, then the solver", 500, 0.05)),
        ({"model": "smooth-small", "iterations": 0}, ("smooth-small", 0, None)),
        ({"simulator": "network"}, ("eslr-small, then 10 iterations of the solver", 10, None)),
        ({"iterations": 0}, ("eslr-small", 0, None)),
    ],
)
def test_the_options_say_what_solves_a_frame(options, expected):
    method = choose_method(Options(**options))
    assert (method.model, method.config.iterations, method.tolerance) == expected


def test_options_survive_the_record_that_a_run_goes_on_from():
    options = Options(
        garment=("pants", "tshirt"),
        betas=(1.0, -2.0),
        wind=(3.0, 0.0, 0.0),
        joint_map=Path("map.json"),
        iterations=30,
        contact="fast",
    )
    assert from_dict(Options, json.loads(json.dumps(options.record()))) == options


def test_a_budget_buys_iterations_of_the_solver_and_of_a_network():
    alone, behind = (
        choose_method(Options(budget="12ms", model=model)).within_budget(1000, 1)
        for model in (None, "smooth-small")
    )
    assert alone.config.iterations > behind.config.iterations > 1
    assert behind.model == "smooth-small, then the solver"
    assert (alone.tolerance, alone.budget_ms) == (None, 12.0)
    assert alone.pace(alone.config.iterations, 1e3) == 5


def test_a_map_is_written_for_joints_that_nobody_knows(tmp_path, body):
    walk = moving(body)
    bones = [f"Bone.{number:03}" for number in range(len(walk.skeleton.joint_names))]
    write_bvh(tmp_path / "a.bvh", walk, names=bones)
    done = eslr_here("joints", "--motion", tmp_path / "a.bvh", "--out", tmp_path / "map.json")
    assert "LeftArm" in done.stdout
    assert json.loads((tmp_path / "map.json").read_text())["LeftArm"] == ""
    done = eslr_here("joints", "--motion", "cmu_016_32", "--json")
    assert json.loads(done.stdout)["LeftArm"] == "LeftArm"


def test_the_map_that_is_shown_is_the_one_that_is_used(tmp_path, body):
    """SMPL parameters move a body of SMPL's family by name: its fingers rest."""
    rng = np.random.default_rng(0)
    np.savez(tmp_path / "body.npz", **smpl_model(body, rng))
    write_amass(tmp_path / "walk.npz", rng.normal(0.0, 0.3, (4, 24, 3)), np.zeros((4, 3)), 30.0)
    files = ("--motion", tmp_path / "walk.npz", "--body", tmp_path / "body.npz")
    shown = json.loads(eslr_here("joints", *files, "--json").stdout)
    target = load_body(str(tmp_path / "body.npz"))
    motion = load_motion(tmp_path / "walk.npz", body=target)
    moves = np.abs(motion.rotations).max(axis=(0, 2)) > 1e-6
    assert {name for name, other in shown.items() if other} == {
        name for name, is_moving in zip(target.joint_names, moves, strict=True) if is_moving
    }
    assert shown["left_hand"] == ""


@pytest.mark.skipif(sys.platform == "win32", reason="pipes differ")
def test_whoever_reads_the_output_may_leave():
    ours, end = os.pipe()
    os.close(ours)
    command = [sys.executable, "-m", "eslr_jax.pipeline.cli", "assets", "--json"]
    result = subprocess.run(command, stdout=end, stderr=subprocess.PIPE, text=True, check=False)
    os.close(end)
    assert (result.returncode, result.stderr) == (141, "")
