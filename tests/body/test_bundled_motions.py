import json
from pathlib import Path

import numpy as np
import pytest

from eslr_jax.body import retarget

DATA = Path(__file__).resolve().parents[2] / "data"
ARCHIVES = ("cmu", "deepmimic")


def clip_names(archive):
    return sorted(key.removesuffix("/fps") for key in archive.files if key.endswith("/fps"))


def posed_joints(rotations, translations, body):
    turned = retarget.global_rotations(rotations, body["parents"])
    rest = body["joint_rest_positions"].astype(float)
    posed = np.zeros((len(rotations), len(rest), 3))
    for joint, parent in enumerate(body["parents"]):
        bone = rest[joint] - rest[parent]
        posed[:, joint] = translations if parent < 0 else posed[:, parent] + turned[:, parent] @ bone
    return posed


@pytest.fixture(scope="module")
def body():
    with np.load(DATA / "body" / "anny_cmu.npz") as file:
        return dict(file)


@pytest.mark.parametrize("name", ARCHIVES)
def test_clips_fit_the_body_and_are_finite(name, body):
    with np.load(DATA / "motions" / f"{name}.npz") as archive:
        assert list(archive["joint_names"]) == list(body["joint_names"])
        for clip in clip_names(archive):
            rotations, translations = archive[f"{clip}/rotations"], archive[f"{clip}/translations"]
            assert rotations.shape == (len(translations), len(body["parents"]), 3)
            assert np.isfinite(rotations).all()
            assert np.isfinite(translations).all()
            assert 10 < archive[f"{clip}/fps"] < 130


@pytest.mark.parametrize("name", ARCHIVES)
def test_clips_start_at_the_origin_on_the_floor_facing_front(name, body):
    with np.load(DATA / "motions" / f"{name}.npz") as archive:
        for clip in clip_names(archive):
            rotations, translations = archive[f"{clip}/rotations"], archive[f"{clip}/translations"]
            front = retarget.global_rotations(rotations[:1], body["parents"])[0, 0, :, 2]
            assert front[2] > 0
            assert abs(front[0]) < 1e-3
            np.testing.assert_allclose(translations[0, [0, 2]], 0.0, atol=1e-4)
            lowest = posed_joints(rotations, translations, body)[:, :, 1].min(axis=1)
            assert (
                -0.1 < lowest.min() < 0.13
            )  # joints lie inside the body; a foot's are up to 0.1 m above the sole


def test_cmu_feet_stand_still_once_in_every_step(body):
    names = list(body["joint_names"])
    feet = [names.index(side + part) for side in ("Left", "Right") for part in ("Foot", "ToeBase")]
    with np.load(DATA / "motions" / "cmu.npz") as archive:
        for clip in clip_names(archive):
            joints = posed_joints(archive[f"{clip}/rotations"], archive[f"{clip}/translations"], body)
            speed = (
                np.linalg.norm(np.diff(joints[:, feet], axis=0)[..., [0, 2]], axis=-1)
                * archive[f"{clip}/fps"]
            )
            assert np.median(speed.min(axis=1)) < 0.15  # [m/s]; a walk's hips move at 0.7 to 1.7


def test_splits_name_every_clip_once():
    splits = json.loads((DATA / "splits.json").read_text())["motions"]
    listed = [clip for clips in splits.values() for clip in clips]
    bundled = []
    for name in ARCHIVES:
        with np.load(DATA / "motions" / f"{name}.npz") as archive:
            bundled += clip_names(archive)
    assert sorted(listed) == sorted(bundled)
