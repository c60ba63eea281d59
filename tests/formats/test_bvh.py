from pathlib import Path

import numpy as np
import pytest
from broken import read
from foreign_files import animate, write_bvh
from scipy.spatial.transform import Rotation

FIXTURES = Path(__file__).parents[1] / "fixtures"
SMALL = """HIERARCHY
ROOT Hips
{
  OFFSET 1 2 3
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT Spine
  {
    OFFSET 0 10 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    End Site
    {
      OFFSET 0 5 0
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.04
0 0 0 0 0 0 0 0 0
5 6 7 90 0 0 0 0 90
"""


def test_a_small_file_by_hand(tmp_path):
    path = tmp_path / "small.bvh"
    path.write_text(SMALL)
    motion = read("motion", path)
    assert motion.skeleton.joint_names == ("Hips", "Spine")
    assert motion.skeleton.parents == (-1, 0)
    assert motion.fps == pytest.approx(25.0)
    np.testing.assert_allclose(motion.skeleton.rest_positions, [[1, 2, 3], [1, 12, 3]])
    # A quarter turn about z takes the spine from +y to -x.
    np.testing.assert_allclose(motion.positions[1], [[5, 6, 7], [-5, 6, 7]], atol=1e-12)
    turn = Rotation.from_euler("z", 90, degrees=True) * Rotation.from_euler("y", 90, degrees=True)
    np.testing.assert_allclose(motion.rotations[1, 1], turn.as_matrix(), atol=1e-12)


def test_the_mark_that_windows_puts_first_is_no_word(tmp_path):
    (tmp_path / "marked.bvh").write_text(SMALL, encoding="utf-8-sig")
    assert read("motion", tmp_path / "marked.bvh").skeleton.joint_names == ("Hips", "Spine")


@pytest.mark.parametrize(("time", "fps"), [("0.0333333", 30), ("0.008333", 120), ("0.033367", 1 / 0.033367)])
def test_a_rounded_frame_time_loses_no_frame(tmp_path, time, fps):
    head, _ = SMALL.split("MOTION")
    rows = "0 0 0 0 0 0 0 0 0\n" * 300
    (tmp_path / "long.bvh").write_text(f"{head}MOTION\nFrames: 300\nFrame Time: {time}\n{rows}")
    motion = read("motion", tmp_path / "long.bvh")
    assert motion.fps == fps  # 29.97 is a rate of its own
    assert len(motion.positions) == 300


def test_cmu_clip_has_rigid_bones_and_a_person_of_plausible_size():
    motion = read("motion", FIXTURES / "cmu_01_01.bvh")
    assert motion.rotations.shape == (120, 31, 3, 3)
    bones = [j for j, parent in enumerate(motion.skeleton.parents) if parent >= 0]
    above = [motion.skeleton.parents[j] for j in bones]
    lengths = np.linalg.norm(motion.positions[:, bones] - motion.positions[:, above], axis=-1)
    rest = motion.skeleton.rest_positions
    np.testing.assert_allclose(lengths, np.tile(np.linalg.norm(rest[bones] - rest[above], axis=1), (120, 1)))
    height = np.ptp(motion.positions[0, :, 1]) * 0.06158  # metres per unit, by the length of the legs
    assert 1.4 < height < 1.9


@pytest.mark.parametrize("order", ["ZXY", "XYZ", "ZYX"])
def test_round_trip_is_exact(tmp_path, order):
    rng = np.random.default_rng(0)
    rest, turned = rng.normal(size=(4, 3)), Rotation.random(20, rng=rng).as_matrix().reshape(5, 4, 3, 3)
    motion = animate(("a", "b c", "d", "e"), (-1, 0, 1, 0), rest, turned, rng.normal(size=(5, 3)), 60.0)
    write_bvh(tmp_path / "a.bvh", motion, order=order)
    back = read("motion", tmp_path / "a.bvh")
    order_of = [back.skeleton.joint_names.index(name) for name in motion.skeleton.joint_names]
    np.testing.assert_allclose(back.rotations[:, order_of], turned, atol=1e-6)
    np.testing.assert_allclose(back.positions[:, order_of], motion.positions, atol=1e-6)
    assert back.fps == pytest.approx(60.0, rel=1e-6)


@pytest.mark.parametrize("claimed", [1, 3])
def test_a_frame_count_that_is_off_by_one_is_a_warning(tmp_path, claimed):
    path = tmp_path / "clip.bvh"
    path.write_text(SMALL.replace("Frames: 2", f"Frames: {claimed}"))
    with pytest.warns(UserWarning, match=rf"clip.bvh says {claimed} frames and has 2"):
        motion = read("motion", path)
    assert len(motion.positions) == 2
