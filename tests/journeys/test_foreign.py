"""Garments and motions that nobody here has seen: worn, pictured, and taken to other programs."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from commands import eslr, slip, succeeded, worn
from foreign_files import moving, smpl_parameters, write_amass, write_hood
from garment_shapes import cape, poncho, shorts, skirt, trousers, tube_dress, write_obj
from PIL import Image

from eslr_jax.pipeline.report.fields import run_field
from eslr_jax.pipeline.report.run import read_run

pytestmark = pytest.mark.slow
TWO_SECONDS = ("--iterations", 20, "--frames", 61, "--settle", 0)
FIXTURES = Path(__file__).parents[1] / "fixtures"


@pytest.fixture(scope="module")
def motions(tmp_path_factory, body):
    """Four motions: two BVH files of other programs, and a walk as AMASS and HOOD store one."""
    folder = tmp_path_factory.mktemp("motions")
    for name in ("cmu_01_01.bvh", "makehuman_walk1.bvh"):
        shutil.copy(FIXTURES / name, folder / name)
    rotations, pelvis = smpl_parameters(moving(body, "cmu_047_01"))
    write_amass(folder / "amass.npz", rotations, pelvis, 30.0)
    write_hood(folder / "hood.pkl", rotations, pelvis)
    return folder


# Bars of stretch and depth are 1.3 times what was measured; no vertex inside the body: a millimetre.
@pytest.mark.parametrize(
    ("shape", "motion", "most_stretch", "most_depth_mm"),
    [
        (skirt, "amass.npz", 1.5, 1.0),
        # The walk's end does not meet its beginning: the thighs jump by 16 cm a frame in between.
        (shorts, "makehuman_walk1.bvh", 2.35, 1.0),
        (trousers, "cmu_01_01.bvh", 1.5, 1.0),
        (tube_dress, "hood.pkl", 1.45, 1.0),
        (poncho, "cmu_01_01.bvh", 1.7, 1.3),
        (cape, "amass.npz", 1.7, 1.0),
    ],
)
def test_a_foreign_garment_is_worn_on_a_foreign_motion(
    tmp_path, motions, shape, motion, most_stretch, most_depth_mm
):
    path = write_obj(tmp_path / "garment.obj", shape())
    loop = ("--loop", 40) if motion.startswith("makehuman") else ()  # it has 17 frames
    words = ("--motion", motions / motion, *loop)
    report, run = worn(tmp_path / "run", "--garment", path, "--frames", 40, *words)
    cloth, wearer = run["positions"], run["body_positions"]
    above = cloth[..., 1].mean(axis=1) - wearer[..., 1].mean(axis=1)
    assert abs(above[-1] - above[0]) < 0.1, "it falls off"
    # A poncho lies on arms that move; the others have a top that stays where it is.
    assert shape is poncho or abs(slip(run)) < 0.05, "it slips"
    assert np.ptp(wearer[0, :, 1]) * 0.9 > cloth[0, :, 1].max() - wearer[0, :, 1].min(), "it is on the head"
    assert np.linalg.norm(np.diff(cloth, axis=0), axis=-1).max() < 0.3, "it jumps"
    assert report["p99_principal_stretch"] < most_stretch
    assert report["penetration_max_mm"] < most_depth_mm


@pytest.fixture(scope="module")
def fallen(tmp_path_factory):
    """A skirt that nothing holds, after two seconds: its folder and its trajectory."""
    folder = tmp_path_factory.mktemp("fallen")
    path = write_obj(folder / "skirt.obj", skirt())
    succeeded(eslr("fit", path, "--pin", "none", "--out", folder / "skirt.npz", "--no-picture"))
    words = ("--simulator", "physics", "--garment", folder / "skirt.npz", *TWO_SECONDS, "--no-pictures")
    done = succeeded(eslr("simulate", *words, "--out", folder / "run"))
    with np.load(folder / "run" / "trajectory.npz") as arrays:
        return folder / "run", dict(arrays), done.stdout


def test_a_skirt_that_nothing_holds_ends_on_the_ground_and_is_told(fallen):
    folder, run, text = fallen
    report = json.loads((folder / "report.json").read_text())
    ground = float(run["body_positions"][..., 1].min())
    assert report["ground_m"] == pytest.approx(ground, abs=1e-6)
    heights = run["positions"][..., 1]
    assert heights.min() > ground - 0.002, "it hits the ground at three metres a second"
    assert ground < heights[-1].min() < ground + 0.005
    assert "warning: the garment slid or fell: its centre is" in text
    assert "frame 6" in text


def test_a_moment_of_a_run_becomes_a_picture(fallen, tmp_path):
    folder, _, _ = fallen
    pictures = []
    for moment in ("0", "2s"):
        out = tmp_path / f"{moment}.png"
        succeeded(eslr("render", folder, "--out", out, "--at", moment, "--samples", 2, "--width", 120))
        pictures.append(np.asarray(Image.open(out).convert("RGB"), float))
    assert pictures[0].shape == (160, 120, 3)
    # The label stands above, in the first forty rows.
    blue = [(picture[..., 2] > 1.2 * picture[..., 0])[40:] for picture in pictures]
    rows = [np.flatnonzero(part.any(axis=1)).mean() for part in blue]
    assert rows[1] > rows[0] + 15, "the skirt has fallen"


def test_a_skirt_flies_in_the_wind_and_its_gap_is_that_of_the_windy_frames(tmp_path):
    """Gap, as a picture, is measured on the frames' own problems: with their wind, gusts and damping."""
    garment = write_obj(tmp_path / "skirt.obj", skirt())
    words = ("--garment", garment, "--iterations", 40, "--motion", "turn", "--frames", 20)
    _, still = worn(tmp_path / "still", *words)
    air = ("--wind", 0, 0, 8, "--gust", 0.2, "--damping", 0.002)
    report, windy = worn(tmp_path / "windy", *words, *air)
    assert (windy["positions"][-1] - still["positions"][-1])[:, 2].mean() > 0.02
    assert (report["wind_m_s"], report["gust"], report["damping_s"]) == ([0.0, 0.0, 8.0], 0.2, 0.002)
    gap = run_field(read_run(tmp_path / "windy"), "gap").values.sum(axis=1)
    assert gap.min() > -1e-3, "above the optimum of another problem"


def test_a_run_without_ground_falls_below_the_feet(fallen, tmp_path):
    folder, _, _ = fallen
    garment = ("--garment", folder.parent / "skirt.npz", "--ground", "off")
    report, run = worn(tmp_path, *garment, *TWO_SECONDS)
    assert report["ground_m"] is None
    assert run["positions"][-1, :, 1].min() < run["body_positions"][-1, :, 1].min() - 0.02
