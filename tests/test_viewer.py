"""Runs in the browser: the scene over the server's own interface, and in headless Chromium."""

import dataclasses
import json
import os
import shutil
import threading
import time
import typing

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eslr_jax.assets import load_garment_file
from eslr_jax.cli.runs import render
from eslr_jax.config import SimConfig
from eslr_jax.errors import AssetError
from eslr_jax.evaluation.gap import trajectory_states
from eslr_jax.evaluation.fields import FIELDS, _prepared, _scene, energy_shares, gap_shares, run_field
from eslr_jax.evaluation.hard_cases.build import join_meshes, make_cloth, sheet
from eslr_jax.io.garment import write_garment_npz
from eslr_jax.io.run import read_run
from eslr_jax.io.trajectory import write_trajectory
from eslr_jax.physics.materials import COTTON
from eslr_jax.physics.potential import PotentialTerms, potential, potential_terms
from eslr_jax.physics.problem import PhysicsParameters, start_guess
from eslr_jax.render.colors import color_scale
from eslr_jax.scene import initial_state
from eslr_jax.simulation.step import FrameInput, frame_problem, solve


def make_run(folder, body, name, scale=1.0):
    """Write a run of six frames: a tank top at rest, stretched, raised, at rest, shrunk, and lowered."""
    folder = folder / name
    folder.mkdir()
    garment = load_garment_file("tank")
    rest = garment.rest_positions + np.array([0, 0.82, 0])
    shrunk = rest * [0.9, 1, 0.9]  # into the body
    moved = [rest + np.array([0, 0.02, 0]), rest, shrunk, shrunk - np.array([0, 1e-3, 0])]
    frames = np.stack([rest, rest * [1.1 * scale, 1, 1], *moved])
    body_positions = np.repeat(
        np.asarray(body.rest_positions)[None] + np.array([[0, 0.82, 0]], np.float32), len(frames), 0
    )
    write_trajectory(
        folder / "trajectory.npz",
        positions=frames,
        velocities=np.gradient(frames, 1 / 30, axis=0),
        faces=garment.faces,
        timestep=1 / 30,
        body_positions=body_positions,
        body_faces=np.asarray(body.faces),
        body_rest_positions=np.asarray(body.rest_positions),
        contact_faces=np.asarray(body.faces)[np.asarray(body.is_obstacle)],
    )
    (folder / "report.json").write_text(json.dumps({"self_contact": True}))
    write_garment_npz(folder / "garment.npz", garment)
    return folder


@pytest.fixture(scope="module")
def runs(tmp_path_factory, body):
    folder = tmp_path_factory.mktemp("runs")
    return [read_run(make_run(folder, body, name, scale)) for name, scale in (("loose", 1.0), ("tight", 1.2))]


def test_stretch_of_uniform_stretch(runs):
    field = run_field(runs[0], "stretch")
    np.testing.assert_allclose(field.values[0], 1.0, atol=1e-4)
    assert field.values[1].min() > 1.0
    assert 1.05 < np.median(field.values[1]) <= field.values[1].max() < 1.1 + 1e-3
    np.testing.assert_allclose(field.values[2], field.values[0], atol=1e-4)


@pytest.fixture(scope="module")
def last_problem(runs):
    """The last frame of a run as its simulation stated it, with garment and fabric."""
    garment, material = _prepared(runs[0])
    scene = _scene(runs[0], garment, material, has_contact=True)
    parameters = PhysicsParameters()
    state, inputs = jax.tree.map(
        lambda leaf: leaf[-1], trajectory_states(runs[0].trajectory, scene, parameters)
    )
    config = SimConfig(simulator="physics", self_contact=True)
    problem = frame_problem(garment, state, inputs, scene.surface, scene.timestep, parameters, config)
    return problem, garment, material


@pytest.mark.parametrize("term", PotentialTerms._fields)
def test_energy_shares_add_up_to_the_energy(runs, last_problem, term):
    problem, garment, material = last_problem
    answer = jnp.asarray(runs[0].trajectory.positions[-1])
    whole = float(getattr(potential_terms(answer, problem, garment, material), term))
    shares = run_field(runs[0], f"{term}-energy").values[-1] * np.asarray(garment.vertex_areas)
    assert shares.sum() == pytest.approx(whole, rel=1e-3, abs=1e-6)
    assert whole != 0 or term == "repulsion"  # no two layers meet


def test_excess_shares_add_up_to_what_the_answer_is_above_the_optimum(runs, last_problem):
    problem, garment, material = last_problem
    answer = start_guess(problem, garment)
    minimum = solve(problem, garment, material, answer, iterations=500, memory=8, tolerance=1e-3)
    gap = float(potential(answer, problem, garment, material) - minimum.value)
    shares = np.asarray(gap_shares(answer, problem, garment, material))
    assert gap > 1e-3
    assert shares.sum() == pytest.approx(gap, rel=0.01)  # contacts have kinks
    assert -shares[shares < 0].sum() < 0.5 * gap
    at_optimum = gap_shares(minimum.position, problem, garment, material)
    assert abs(float(at_optimum.sum())) < 0.01 * gap


def test_repulsion_counts_where_layers_meet():
    """Two sheets 1 mm apart: the pairs' energy goes to both layers."""
    lower = sheet(6, 6, (0.1, 0.1))
    upper = lower[0] + np.array([0.003, 1e-3, 0.002]), lower[1]
    garment = make_cloth(join_meshes(lower, upper), {}, allow_components=True)
    still = jnp.asarray(garment.rest_positions)
    state = initial_state(still, jnp.zeros_like(still))
    problem = frame_problem(
        garment,
        state,
        FrameInput(None, None, None),
        None,
        jnp.float32(1 / 30),
        PhysicsParameters(),
        SimConfig(simulator="physics", self_contact=True),
    )
    whole = float(potential_terms(still, problem, garment, COTTON).repulsion)
    shares = np.asarray(energy_shares("repulsion", still, problem, garment, COTTON))
    assert whole > 0
    assert shares.sum() == pytest.approx(whole, rel=1e-4)
    assert min(shares[:36].sum(), shares[36:].sum()) > 0.2 * whole


@pytest.mark.parametrize(("name", "change", "message"), [
    ("gap", {"contact_faces": None, "body_rest_positions": None}, "rest pose, which contacts need"),
    ("friction-energy", {"body_positions": None, "body_faces": None}, "has no body, and so no friction-energy"),
    ("distance", {"body_positions": None, "body_faces": None}, "has no body"),
])  # fmt: skip
def test_what_a_run_lacks_for_a_field_is_said(runs, name, change, message):
    run = dataclasses.replace(runs[0], trajectory=dataclasses.replace(runs[0].trajectory, **change))
    with pytest.raises(AssetError, match=message) as caught:
        run_field(run, name)
    assert "\n" not in str(caught.value)


def test_a_run_without_self_contact_has_no_repulsion(runs):
    with pytest.raises(AssetError, match="without --self-contact"):
        run_field(dataclasses.replace(runs[0], report={}), "repulsion-energy")


def test_render_knows_every_field():
    colors = typing.get_type_hints(render)["color"]
    assert set(typing.get_args(colors)) == {"fabric", *FIELDS}


def test_distance_grows_by_what_the_cloth_is_moved(runs):
    field = run_field(runs[0], "distance")
    assert np.all(field.values[0] > 0)
    np.testing.assert_allclose(field.values[0], field.values[3])
    with pytest.raises(AssetError, match="no field 'warmth'"):
        run_field(runs[0], "warmth")


def test_color_scale_ends_and_order():
    colors = color_scale(np.array([-9.0, 0.0, 0.5, 1.0, 9.0, np.nan]), 0.0, 1.0)
    np.testing.assert_array_equal(colors[0], colors[1])
    np.testing.assert_array_equal(colors[3], colors[4])
    np.testing.assert_array_equal(colors[5], colors[1])
    lightness = color_scale(np.linspace(0, 1, 30), 0.0, 1.0) @ [0.3, 0.6, 0.1]
    assert np.all(np.diff(lightness) > 0)


@pytest.mark.parametrize(("spoil", "message"), [
    (lambda folder: (folder / "trajectory.npz").unlink(), "is no run"),
    (lambda folder: (folder / "trajectory.npz").write_bytes(b"PK"), "trajectory"),
    (lambda folder: (folder / "garment.npz").write_bytes(b""), "garment"),
    (lambda folder: write_garment_npz(folder / "garment.npz", load_garment_file("tank", vertices="4k")), "4000"),
    (lambda folder: (folder / "report.json").write_text("{"), "report.json"),
])  # fmt: skip
def test_broken_runs_are_named(tmp_path, body, spoil, message):
    folder = make_run(tmp_path, body, "run")
    spoil(folder)
    with pytest.raises(AssetError, match=message) as caught:
        read_run(folder)
    assert "\n" not in str(caught.value)


@pytest.fixture
def view(runs):
    pytest.importorskip("viser")
    from eslr_jax.viewer import open_view

    opened = open_view(runs, port=8791)
    yield opened
    opened.server.stop()


def scene_of(view):
    """Return the scene's meshes by name."""
    handles = view.server.scene._handle_from_node_name
    return {name: handle for name, handle in handles.items() if name.startswith("/runs/")}


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_page_shows_every_run_beside_the_other(view, runs):
    meshes = scene_of(view)
    assert {"/runs/0/garment", "/runs/0/body", "/runs/1/garment", "/runs/1/body"} <= set(meshes)
    first, second = meshes["/runs/0/garment"], meshes["/runs/1/garment"]
    np.testing.assert_allclose(first.vertices, runs[0].trajectory.positions[0], atol=1e-6)
    np.testing.assert_allclose(second.vertices[:, 0].mean() - first.vertices[:, 0].mean(), 1.3, atol=0.01)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_controls_change_the_scene(view, runs):
    from eslr_jax.viewer import play, show

    view.controls["frame"].value = 1
    show(view)
    np.testing.assert_allclose(
        scene_of(view)["/runs/0/garment"].vertices, runs[0].trajectory.positions[1], atol=1e-6
    )
    view.controls["wireframe"].value = True
    view.controls["body"].value = False
    show(view)
    assert scene_of(view)["/runs/0/garment"].wireframe
    assert not scene_of(view)["/runs/0/body"].visible
    view.controls["wireframe"].value = False
    for name in FIELDS:
        view.controls["color"].value = name
        show(view)
        assert "dark" in view.controls["legend"].content
    view.fields.clear()
    view.runs[0].report["self_contact"] = False
    view.controls["color"].value = "repulsion-energy"
    show(view)
    view.runs[0].report["self_contact"] = True
    assert "without --self-contact" in view.controls["legend"].content
    view.controls["frame"].value = 0
    view.controls["playing"].value = True
    end = threading.Event()
    player = threading.Thread(target=play, args=(view,), kwargs={"until": end})
    player.start()
    time.sleep(0.5)
    end.set()
    player.join(timeout=10)
    assert not player.is_alive()


CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or os.environ.get("CHROMIUM")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_page_in_headless_chromium(view, tmp_path):
    sync_api = pytest.importorskip("playwright.sync_api")
    from PIL import Image

    from eslr_jax.viewer import show

    with sync_api.sync_playwright() as playwright:
        arguments = [
            "--no-sandbox",
            "--use-gl=angle",
            "--use-angle=swiftshader",
            "--enable-unsafe-swiftshader",
        ]
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=arguments)
        page = browser.new_page(viewport={"width": 640, "height": 480})
        page.goto(view.url)
        picture = tmp_path / "page.png"

        def until(is_color, count):
            deadline, found = time.monotonic() + 240, 0
            while found <= count and time.monotonic() < deadline:
                page.screenshot(path=picture, timeout=180_000)  # WebGL in software, on a busy machine
                red, green, blue = np.moveaxis(
                    np.asarray(Image.open(picture).convert("RGB")).astype(int), -1, 0
                )
                found = int(is_color(red, green, blue).sum())
                time.sleep(1.0)
            assert found > count

        until(lambda red, green, blue: (blue > red + 40) & (blue > 90), 1500)  # two blue garments
        view.controls["frame"].value = 1
        view.controls["color"].value = "gap"
        show(view)
        until(
            lambda red, green, blue: (np.minimum(red, green) > blue + 60) & (green > 0.8 * red), 30
        )  # yellow
        page.get_by_text("J/m2").wait_for(timeout=60_000)
        assert page.get_by_text("colour by").count() > 0
        with page.expect_download(timeout=240_000) as saved:
            page.get_by_role("button", name="save picture").click()
        exported = np.asarray(Image.open(saved.value.path()).convert("RGB"))
        assert exported.shape == (960, 1280, 3)
        assert len(np.unique(exported.reshape(-1, 3), axis=0)) > 100  # not one colour
        browser.close()
