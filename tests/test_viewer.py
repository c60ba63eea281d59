"""Runs in the browser: the scene over the server's own interface, and in headless Chromium."""

import os
import shutil
import threading
import time

import numpy as np
import pytest

from eslr_jax.assets import load_garment_file
from eslr_jax.errors import AssetError
from eslr_jax.evaluation.fields import FIELDS, run_field
from eslr_jax.io.garment import write_garment_npz
from eslr_jax.io.run import read_run
from eslr_jax.io.trajectory import write_trajectory
from eslr_jax.render.colors import color_scale


def make_run(folder, body, name, scale=1.0):
    """Write a run of four frames: a tank top at rest, stretched, raised by 2 cm, at rest."""
    folder = folder / name
    folder.mkdir()
    garment = load_garment_file("tank")
    rest = garment.rest_positions + np.array([0, 0.82, 0])
    frames = np.stack([rest, rest * [1.1 * scale, 1, 1], rest + np.array([0, 0.02, 0]), rest])
    body_positions = np.repeat(
        np.asarray(body.rest_positions)[None] + np.array([[0, 0.82, 0]], np.float32), 4, 0
    )
    write_trajectory(
        folder / "trajectory.npz",
        positions=frames,
        velocities=np.gradient(frames, 1 / 30, axis=0),
        faces=garment.faces,
        timestep=1 / 30,
        body_positions=body_positions,
        body_faces=np.asarray(body.faces),
    )
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


@pytest.mark.parametrize("name", ["stretch-energy", "bending-energy", "inertia-energy", "gravity-energy"])
def test_energy_shares_add_up_to_the_energy(runs, name):
    import jax.numpy as jnp

    from eslr_jax.evaluation.fields import _prepared
    from eslr_jax.physics.bending import bending_energy
    from eslr_jax.physics.gravity import gravity_energy
    from eslr_jax.physics.inertia import inertia_energy, vertex_masses
    from eslr_jax.physics.membrane import stretch_energy

    run = runs[0]
    garment, material = _prepared(run)
    trajectory = run.trajectory
    before, now = (jnp.asarray(trajectory.positions[frame]) for frame in (0, 1))
    masses = vertex_masses(garment, material)
    guess = before + trajectory.timestep * trajectory.velocities[0]
    whole = {
        "stretch-energy": stretch_energy(now, garment, material),
        "bending-energy": bending_energy(now, garment, material),
        "inertia-energy": inertia_energy(now, guess, masses, jnp.float32(trajectory.timestep)),
        "gravity-energy": gravity_energy(now, before, masses, 9.81),
    }[name]
    shares = run_field(run, name).values[1] * np.asarray(garment.vertex_areas)
    assert shares.sum() == pytest.approx(float(whole), rel=1e-3, abs=1e-6)


def test_distance_grows_by_what_the_cloth_is_moved(runs):
    field = run_field(runs[0], "distance")
    assert np.all(field.values[0] > 0)
    np.testing.assert_allclose(field.values[0], field.values[3])
    with pytest.raises(AssetError, match="no field 'excess'"):
        run_field(runs[0], "excess")


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

        def blue_pixels():
            page.screenshot(path=picture, timeout=180_000)  # WebGL in software, on a busy machine
            pixels = np.asarray(Image.open(picture).convert("RGB")).astype(int)
            return int(((pixels[..., 2] > pixels[..., 0] + 40) & (pixels[..., 2] > 90)).sum())

        deadline = time.monotonic() + 240
        while blue_pixels() < 1500 and time.monotonic() < deadline:
            time.sleep(1.0)
        assert blue_pixels() > 1500  # two blue garments
        assert page.get_by_text("colour by").count() > 0
        with page.expect_download(timeout=240_000) as saved:
            page.get_by_role("button", name="save picture").click()
        exported = np.asarray(Image.open(saved.value.path()).convert("RGB"))
        assert exported.shape == (960, 1280, 3)
        assert len(np.unique(exported.reshape(-1, 3), axis=0)) > 100  # not one colour
        browser.close()
