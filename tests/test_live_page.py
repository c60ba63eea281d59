"""`eslr play`: the page and every control of it, over the server's own interface and in headless Chromium."""

import threading
import time

import numpy as np
import pytest
import trimesh
from chromium import CHROMIUM, launch

from eslr_jax.io.run import read_run

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::DeprecationWarning")]


class Player:
    """A page, and a thread that simulates."""

    def __init__(self, out):
        from eslr_jax.viewer.live import Choice, open_live, run_live

        self.live = open_live(Choice("tshirt", "1k", "turn"), out=out, port=8841)
        self.frames, self.end = 0, threading.Event()
        self.thread = threading.Thread(
            target=run_live, args=(self.live,), kwargs={"until": self.end, "on_frame": self.count}
        )
        self.thread.start()

    def count(self):
        self.frames += 1

    def wait(self, count, seconds=600):
        goal, deadline = self.frames + count, time.monotonic() + seconds
        while self.frames < goal and time.monotonic() < deadline:
            assert self.thread.is_alive()
            time.sleep(0.02)
        assert self.frames >= goal, self.live.controls["status"].content

    def positions(self):
        return np.asarray(self.live.state.position)


@pytest.fixture(scope="module")
def player(tmp_path_factory):
    pytest.importorskip("viser")
    player = Player(tmp_path_factory.mktemp("live"))
    player.wait(5)
    yield player
    player.end.set()
    player.thread.join(timeout=60)
    player.live.server.stop()
    assert not player.thread.is_alive()


def test_status_tells_time_and_tolerance(player):
    status = player.live.controls["status"].content
    assert "ms a frame" in status
    assert "optimum" in status or "tolerance" in status


def test_wind_blows_and_a_fabric_falls_otherwise(player):
    controls = player.live.controls
    before = player.positions()[:, 2].mean()
    controls["wind"].value = 10.0
    player.wait(10)
    assert player.positions()[:, 2].mean() > before + 0.003
    controls["wind"].value = 0.0
    controls["fabric"].value = "silk"
    controls["density"].value = 0.3
    player.wait(3)


def test_pause_one_frame_and_restart(player):
    controls = player.live.controls
    controls["playing"].value = False
    time.sleep(0.5)
    stopped = player.frames
    time.sleep(0.5)
    assert player.frames == stopped
    player.live.asked.set()
    player.wait(1)
    time.sleep(0.5)
    assert player.frames == stopped + 1
    controls["playing"].value = True
    player.wait(2)


def test_a_vertex_is_dragged_and_let_go(player):
    from eslr_jax.viewer.live import _let_go, _take_hold

    _take_hold(player.live, (0.0, 1.1, 3.0), (0.0, 0.0, -1.0))
    vertex, handle = player.live.held, player.live.controls["hand"]
    before = player.positions()[vertex]
    handle.position = tuple(np.add(handle.position, [0.0, 0.0, 0.25]))
    player.wait(8)
    assert player.positions()[vertex][2] > before[2] + 0.03
    _let_go(player.live)
    assert player.live.held is None
    player.wait(2)


def test_a_recording_is_a_run(player):
    player.live.controls["record"].value = True
    player.wait(6)
    player.live.controls["record"].value = False
    player.wait(3)
    run = read_run(player.live.out)
    assert 6 <= run.trajectory.num_frames <= 8
    assert run.report["motion"] == "turn"
    assert trimesh.load(player.live.out / "animation.glb").geometry


def test_another_garment_takes_the_stage(player):
    player.live.controls["garment"].value = "tank"
    player.wait(4)
    assert player.live.cast.choice.garment == "tank"
    assert player.live.controls["meshes"][1].vertices.shape == player.positions().shape


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_the_page_in_headless_chromium_moves_without_an_error(player):
    with launch() as page:
        errors = []
        page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
        page.goto(player.live.url)
        page.get_by_text("ms a frame").wait_for(timeout=240_000)
        page.get_by_text("keep up with real time").wait_for(timeout=60_000)
        page.get_by_role("button", name="restart").click(timeout=60_000)
        player.wait(3)
        assert not [text for text in errors if "favicon" not in text]
