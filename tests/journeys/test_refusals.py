"""Bad input at the command line: exit code 2, one line that names the cause, and nothing left behind.

What a reader refuses in a file, `test_broken.py` and `test_fuzz.py` hold; here are a few files of every command.
"""

import json
import pickle
import shlex

import numpy as np
import pytest
from commands import eslr_here, refused
from example_runs import write_run
from garment_shapes import skirt, write_obj

pytestmark = pytest.mark.slow
TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
BVH = """HIERARCHY
ROOT Hips
{
OFFSET 0 0 0
CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
JOINT Spine
{
OFFSET 0 50 0
CHANNELS 3 Zrotation Xrotation Yrotation
End Site
{
OFFSET 0 20 0
}
}
}
MOTION
Frames: 2
Frame Time: 0.0333
0 90 0 0 0 0 0 0 0
0 90 0 0 0 0 0 0 0
"""
POSES = {"poses": np.zeros((4, 156)), "trans": np.zeros((4, 3)), "mocap_framerate": np.array(30.0)}
BODY = {"positions": np.zeros((4, 4, 3)), "faces": np.array([[0, 1, 2], [0, 2, 3]]), "fps": np.array(30.0)}
RECIPE = 'garments = ["tshirt"]\nsteps = 2\n[model]\nbase = "mgn-small"\n'


class Danger:
    """A pickle that would run a command."""

    def __reduce__(self):
        import os

        return os.system, ("touch danger",)


# Text, bytes, arrays of an npz, or None for a folder.
FILES = {
    "empty.obj": "",
    "large.obj": "v 2e4 0 0\nv -2e4 0 0\nv 0 2e4 0\nv 0 0 2e4\nf 1 2 3\nf 1 4 2\nf 2 4 3\n",
    "point.obj": "v 0 1 0\n" * 3 + "f 1 2 3\n",
    "fan.obj": TRIANGLE + "v 0 0 1\nv 0 -1 0\nf 1 2 3\nf 1 2 4\nf 1 2 5\n",
    "folder.obj": None,
    "noise.npz": "noise",
    "garment.fbx": "hello",
    "noise.pkl": b"\x80\x04noise",
    "danger.pkl": pickle.dumps({"shirt": Danger()}),
    "good.bvh": BVH,
    "motion.abc": "hello",
    "empty.bvh": "",
    "lone.amc": ":DEGREES\n1\nroot 0 1 0 0 20 0\n",
    "one-pose.npz": POSES | {key: POSES[key][:1] for key in ("poses", "trans")},
    "clip.glb": b"glTF" + b"\0" * 20,
    "one-frame.npz": BODY | {"positions": np.zeros((1, 4, 3))},
    "flat-body.npz": BODY,
    "nothing": None,
    "key.toml": RECIPE.replace("steps", "stepz"),
    "good.toml": RECIPE,
    "list.json": "[1, 2]",
    "wing.json": json.dumps({"Wing": "Hips"}),
    "list/config.json": '{"format": 1, "train": []}',
    "damaged/trajectory.npz": "noise",
    "damaged/unfinished.npz": "noise",
}
# Each row: the rest of the command line, and what the line must name.
FIT = {
    "empty.obj": "empty", "large.obj": "m, cm, mm, in", "point.obj": "", "fan.obj": "edge", "folder.obj": "",
    "garment.fbx": "obj", "danger.pkl": "",
    "skirt.obj --units -1": "positive", "skirt.obj --edge-length 0": "edge", "skirt.obj --weld nan": "weld",
    "skirt.obj --pin vertices:99999": "99999", "skirt.obj --pin region:y>1.2.3": "y>1.2.3",
    "skirt.obj --pin part:collar": "no such part", "skirt.obj --fabric denin": "did you mean denim",
    "skirt.obj --scale girth --no-picture": "--made-for", "tank --made-for anny": "made for the bundled body",
    "skirt.obj --out a.obj": "npz", "skirt.obj --out key.toml/a.npz": "key.toml",
    "run/garment.npz --out b.npz": "fitted already",
    "mesh.npz --out ./mesh.npz": "a file that is read", "tank --body-units cm": "leave out its unit",
    "pants --pin none --edge-length 0.01": "leave out --edge-length, --pin",
}  # fmt: skip
SIMULATE = {
    **{f"--motion {file}": cause for file, cause in {
        "empty.bvh": "", "lone.amc": "asf", "one-pose.npz": "", "noise.pkl": "", "garment.fbx": "glTF",
        "motion.abc": ".bvh", "clip.glb#run": "", "moonwalk": "cmu_016_32",
        "turn --motion jump": "--motion is given twice",
    }.items()},
    **{f"--body {file}": cause for file, cause in {
        "flat-body.npz --motion turn": "follows no other", "one-frame.npz": "",
        "garment.fbx": "", "nothing": "", "noise.pkl": "", "robot": "anny",
    }.items()},
    "--garment tshrit": "tshirt", "--garment missing.obj": "missing.obj", "--garment empty.obj": "empty",
    "--garment tshirt --garment tshirt": "worn once only",
    "--gust 0.3": "wind", "--wind 3 0 0 --gust -1": "gusts", "--wind nan 0 0": "wind",
    "--wind 0 0 500": "wind", "--damping 2": "damping", "--damping -0.1": "damping",
    "--frames -3": "two frames", "--frames 1": "two frames", "--frames 100000": "fewer than",
    "--start 99s": "start", "--start -1": "", "--start later": "--start", "--start nans": "--start",
    "--loop 0s": "", "--loop ever": "--loop", "--settle -1": "--settle",
    "--budget 20": "--budget", "--budget -5ms": "--budget", "--budget fast": "20ms", "--budget nanms": "20ms",
    "--budget 0.001ms": "the fastest frame here takes",
    "--tolerance 150%": "--tolerance", "--tolerance small": "1%", "--tolerance 0": "1%",
    "--budget 20ms --tolerance 1%": "either", "--tolerance 1% --iterations 5": "leave out --iterations",
    "--iterations -1": "iterations", "--simulator physics --iterations 0": "needs a network",
    "--simulator physics --model eslr-small": "leave out --model", "--model missing.npz": "missing.npz",
    "--model eslr-huge": "eslr-huge", "--model noise.npz": "noise.npz",
    "--fabric kevlra": "kevlra", "--fabric density=-1": "density", "--fabric density=nan": "density",
    "--fabric colour=3": "colour", "--garment tank --fabric front:denim": "front",
    "--joint-map map.json": "map.json", "--joint-map list.json --motion good.bvh": "list.json",
    "--joint-map wing.json --motion good.bvh": "Wing", "--arm-abduction nan": "", "--arm-abduction 1e9": "",
    "--body-fps 30": "--body-fps", "--betas " + "1 " * 99: "betas", "--body-units cm": "metres",
    "--resume": "no interrupted simulation", "--resume --out damaged": "unfinished.npz",
    "--frames 2 --settle 0 --iterations 1 --contact fast --out key.toml": "is a file",
}  # fmt: skip
TRAIN = {
    "": "--out", "--out t": "--config", "--config missing.toml --out t": "missing.toml",
    "--config key.toml --out t": "stepz", "--config run --out t": "run",
    "--config good.toml --set steps=-1 --out t": "steps", "--config good.toml --set steps --out t": "key=value",
    "--config good.toml --set 'garments=[\"tshrit\"]' --tensorboard --out t": "tshrit",
    "--config good.toml --num-processes 2 --process-id 1 --out t": "--coordinator",
    "--resume --out list": "config.json", "--resume --out t": "t", "--resume --set iterations=3 --out t": "--set",
}  # fmt: skip
OTHERS = {
    "render missing --out a.png": "missing", "render nothing --out a.png": "is no run",
    "render run --out a.gif": ".mp4",
    **{f"render run --out a.png {options}": cause for options, cause in {
        "--frames 0": "--frames 0", "--zoom 0": "zoom", "--zoom nan": "zoom", "--camera above": "camera",
        "--at 9s": "ends at frame 5, 0.17 s", "--at noon": "a frame, such as 375", "--at 1.5": "--at",
        "--at 1 --frames 2": "no --frames", "--width 0": "width", "--samples 0": "samples",
    }.items()},
    "view nothing": "is no run",
    "export missing --out a.glb": "missing", "export run --out a.xyz": "xyz",
    "export damaged --out a.glb": "damaged", "export run --format usda --out a.usdc": ".usda",
    "export run --out run/garment.npz": "a file of the run itself",
    "evaluate --model eslr-huge": "eslr-huge", "evaluate --model eslr-small --split tset": "tset",
    "evaluate --model eslr-small --clips x": "x", "evaluate --model eslr-small --iterations -1": "iterations",
    "evaluate --model eslr-small --gap-frames 2": "gap_frames", "evaluate --model eslr-small --every 0": "every",
    "evaluate --model eslr-small --rollout-frames 0": "rollout_frames",
    "evaluate --model mgn-5-correction --control no_embedding": "attention",
    "calibrate --out key.toml/a.json": "key.toml",
    "info --model eslr-huge": "eslr-huge", "info --model eslr-smal": "did you mean eslr-small",
    "info --scene tshirt --model eslr-small": "--model", "info --scene missing.obj": "missing.obj",
    "info --motion turn --contact fast": "leave out --motion, --contact",
    "assets --export body.stl": "obj", "assets --body anny": "leave out --body",
    "assets --kind fabric --verify": "leave out --verify",
    "assets --export a.obj --kind body --json": "lists nothing; leave out --kind, --json",
    "joints --motion missing.bvh": "missing.bvh", "joints --motion key.toml": "",
    "joints --motion turn": "needs no",
    "score missing.npz": "doesn't exist", "score flat-body.npz --run run --garment tank": "leave out --garment",
    "score run --run run": "leave out --run",
    "convert noise.npz --out hood.pth": "npz file",
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory, body):
    """A folder with bad files, and a run that is good."""
    folder = tmp_path_factory.mktemp("bad")
    write_run(folder, body, "run")
    write_obj(folder / "skirt.obj", skirt())
    np.savez(folder / "mesh.npz", positions=np.eye(3), faces=np.arange(3)[None])
    for name, content in FILES.items():
        path = folder / name
        path.parent.mkdir(exist_ok=True)
        if content is None:
            path.mkdir()
        elif isinstance(content, dict):
            np.savez(path, **content)
        else:
            path.write_bytes(content.encode() if isinstance(content, str) else content)
    return folder


def check(folder, monkeypatch, words, cause):
    monkeypatch.chdir(folder)
    before = sorted(path.relative_to(folder) for path in folder.rglob("*"))
    refused(eslr_here(*shlex.split(words)), cause)
    assert sorted(path.relative_to(folder) for path in folder.rglob("*")) == before


@pytest.mark.parametrize("words", FIT)
def test_fit(folder, monkeypatch, words):
    out = "" if "--out" in words else " --out fitted.npz"
    check(folder, monkeypatch, f"fit {words}{out}", FIT[words])


@pytest.mark.parametrize("words", SIMULATE)
def test_simulate(folder, monkeypatch, words):
    out = "" if "--out" in words else " --out out"
    check(folder, monkeypatch, f"simulate {words}{out}", SIMULATE[words])


@pytest.mark.parametrize("words", TRAIN)
def test_train(folder, monkeypatch, words):
    check(folder, monkeypatch, f"train {words}", TRAIN[words])


@pytest.mark.parametrize("words", OTHERS)
def test_others(folder, monkeypatch, words):
    check(folder, monkeypatch, words, OTHERS[words])
