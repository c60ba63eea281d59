"""Runs in the browser: the scene over the server's own interface, and in headless Chromium."""

import threading
import time

import numpy as np
import pytest
from chromium import CHROMIUM, launch
from example_runs import write_run

from eslr_jax import AssetError
from eslr_jax.pipeline.assets import load_garment_file
from eslr_jax.pipeline.formats.garment import write_garment_npz
from eslr_jax.pipeline.page import go_to_worst, open_view, play, show
from eslr_jax.pipeline.report.fields import FIELDS
from eslr_jax.pipeline.report.run import read_run

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


@pytest.fixture(scope="module")
def runs(tmp_path_factory, body):
    folder = tmp_path_factory.mktemp("runs")
    return [
        read_run(write_run(folder, body, name, scale)) for name, scale in (("loose", 1.0), ("tight", 1.2))
    ]


@pytest.mark.parametrize(("spoil", "message"), [
    (lambda folder: (folder / "trajectory.npz").unlink(), "is no run"),
    (lambda folder: (folder / "trajectory.npz").write_bytes(b"PK"), "trajectory"),
    (lambda folder: (folder / "garment.npz").write_bytes(b""), "garment"),
    (lambda folder: write_garment_npz(folder / "garment.npz", load_garment_file("tank", vertices="4k")), "4000"),
    (lambda folder: (folder / "report.json").write_text("{"), "report.json"),
])  # fmt: skip
def test_broken_runs_are_named(tmp_path, body, spoil, message):
    folder = write_run(tmp_path, body, "run")
    spoil(folder)
    with pytest.raises(AssetError, match=message) as caught:
        read_run(folder)
    assert "\n" not in str(caught.value)


@pytest.fixture
def view(runs):
    pytest.importorskip("viser")
    opened = open_view(runs, port=8791)
    yield opened
    opened.server.stop()


def scene_of(view):
    """Return what the scene shows of the runs, by name."""
    handles = view.server.scene._handle_from_node_name
    return {name: handle for name, handle in handles.items() if name.startswith("/runs/")}


def test_page_shows_every_run_beside_the_other(view, runs):
    meshes = scene_of(view)
    assert {"/runs/0/garment", "/runs/0/body", "/runs/1/garment", "/runs/1/body"} <= set(meshes)
    first, second = meshes["/runs/0/garment"], meshes["/runs/1/garment"]
    np.testing.assert_allclose(first.vertices, runs[0].trajectory.positions[0], atol=1e-6)
    np.testing.assert_allclose(second.vertices[:, 0].mean() - first.vertices[:, 0].mean(), 1.3, atol=0.01)


def test_controls_change_the_scene(view, runs):
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
    view.controls["frame"].value = 0
    view.controls["playing"].value = True
    end = threading.Event()
    player = threading.Thread(target=play, args=(view,), kwargs={"until": end})
    player.start()
    seen, deadline = set(), time.monotonic() + 60
    while len(seen) < 6 and time.monotonic() < deadline:
        seen.add(view.controls["frame"].value)
        time.sleep(0.005)
    end.set()
    player.join(timeout=10)
    assert not player.is_alive()
    assert seen == set(range(6))


def test_a_field_is_plotted_over_time_and_leads_to_its_worst_frame(view):
    plot = view.controls["plot"]
    assert not plot.visible
    view.controls["color"].value = "stretch"
    show(view)
    assert "dark" in view.controls["legend"].content
    deadline = time.monotonic() + 60
    while not plot.visible and time.monotonic() < deadline:
        time.sleep(0.05)  # its callback has a thread of its own
    assert plot.visible
    time_of_frame, *curves = plot.data
    np.testing.assert_allclose(np.diff(time_of_frame), 1 / 30)
    assert [int(np.argmax(curve)) for curve in curves] == [1, 1]  # both are stretched then
    assert curves[1][1] > curves[0][1] > 1.05
    go_to_worst(view)
    assert view.controls["frame"].value == 1


@pytest.mark.slow
def test_every_field_has_a_legend(view):
    for name in FIELDS:
        view.controls["color"].value = name
        show(view)
        assert "dark" in view.controls["legend"].content


def test_names_are_above_the_heads_and_the_page_follows(view):
    top = view.runs[0].trajectory.body.positions[0][:, 1].max()
    assert scene_of(view)["/runs/0/name"].position[1] == pytest.approx(top + 0.2, abs=1e-5)
    moved = view.runs[0].trajectory
    moved.positions[2] += [0.0, 0.0, 2.0]
    moved.body.positions[2] += [0.0, 0.0, 2.0]
    try:
        for follows, place in ((True, 0.0), (False, 2.0)):
            view.controls["follow"].value = follows
            view.controls["frame"].value = 2
            show(view)
            body = scene_of(view)["/runs/0/body"].vertices
            assert body[:, 2].mean() - moved.body.positions[0][:, 2].mean() == pytest.approx(place, abs=1e-4)
    finally:
        moved.positions[2] -= [0.0, 0.0, 2.0]
        moved.body.positions[2] -= [0.0, 0.0, 2.0]


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_page_in_headless_chromium(view, tmp_path):
    from PIL import Image

    with launch() as page:
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


def test_play_gives_a_frame_the_iterations_that_it_has_time_for():
    from eslr_jax.pipeline.page.live import next_iterations

    def after_forty_frames(iterations, seconds):
        """Return the iterations of every frame, given the time that one takes with so many [s]."""
        counts = [iterations]
        for _ in range(40):
            counts.append(next_iterations(counts[-1], seconds(counts[-1]), 1 / 30))
        return counts

    assert after_forty_frames(100, lambda count: 1.0)[-1] == 15
    quick = after_forty_frames(15, lambda count: 1e-3)
    assert quick == sorted(quick)
    assert quick[1] < 20
    assert quick[-1] == 100
    fitting = after_forty_frames(100, lambda count: 0.6e-3 * count)[-12:]  # a timestep has room for 55
    assert 45 < np.mean(fitting) < 55
