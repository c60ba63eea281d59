"""Bad input at the command line: exit code 2, one line that names the cause, and nothing left behind.

The commands run in this process, through the program's own entry, so that a hundred of them stay cheap.
"""

import json
import pickle
import sys
import warnings

import numpy as np
import pytest
from example_runs import write_run
from garment_shapes import skirt, write_obj

from eslr_jax.cli import main

NAN = float("nan")
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
ASF = """:units
angle deg
:root
order TX TY TZ RX RY RZ
axis XYZ
position 0 0 0
orientation 0 0 0
:bonedata
begin
name spine
direction 0 1 0
length 2
axis 0 0 20 XYZ
dof rx rz
end
:hierarchy
begin
root spine
end
"""
PLY = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
PLY_FACES = "element face 1\nproperty list uchar int vertex_indices\nend_header\n"


class Danger:
    """A pickle that would run a command."""

    def __reduce__(self):
        import os

        return os.system, ("touch danger",)


def text(name, content):
    """A file of text."""
    return {name: content.encode()}


def arrays(name, **values):
    """An npz file."""
    return {name: values}


def skirt_file(**changes):
    """A fitted garment's arrays, some of them changed."""
    positions, faces = skirt()
    return arrays("shirt.npz", **{"rest_positions": positions, "faces": faces} | changes)


POSES = {"poses": np.zeros((4, 156)), "trans": np.zeros((4, 3)), "mocap_framerate": np.array(30.0)}
BODY = {"positions": np.zeros((4, 4, 3)), "faces": np.array([[0, 1, 2], [0, 2, 3]]), "fps": np.array(30.0)}
GARMENTS = {
    "empty obj": (text("a.obj", ""), "empty"),
    "obj without faces": (text("a.obj", TRIANGLE), "face"),
    "obj face beyond the vertices": (text("a.obj", TRIANGLE + "f 1 2 9\n"), "outside 0..2"),
    "obj face zero": (text("a.obj", TRIANGLE + "f 0 1 2\n"), "0"),
    "obj with nan": (text("a.obj", "v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"), "finite"),
    "obj with a huge number": (text("a.obj", "v 1e300 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"), ""),
    "obj with words for numbers": (text("a.obj", "v a b c\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"), ""),
    "obj vertex of two numbers": (text("a.obj", "v 1 2\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"), ""),
    "obj of noise": ({"a.obj": bytes(range(256)) * 9}, ""),
    "obj of one point": (text("a.obj", "v 0 1 0\n" * 3 + "f 1 2 3\n"), ""),
    "obj face of two corners": (text("a.obj", TRIANGLE + "f 1 2\n"), "face"),
    "three faces at an edge": (
        text("a.obj", TRIANGLE + "v 0 0 1\nv 0 -1 0\nf 1 2 3\nf 1 2 4\nf 1 2 5\n"), "edge",
    ),
    "ply without an end": (text("a.ply", PLY), ""),
    "ply of fewer vertices": (text("a.ply", PLY + PLY_FACES + "0 0 0\n1 0 0\n"), ""),
    "ply without faces": (text("a.ply", PLY + "end_header\n0 0 0\n1 0 0\n0 1 0\n"), ""),
    "ply face beyond": (text("a.ply", PLY + PLY_FACES + "0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n"), ""),
    "cut stl": ({"a.stl": b"\0" * 80 + (9).to_bytes(4, "little") + b"\0" * 50}, ""),
    "glb of another magic": ({"a.glb": b"glXX" + b"\0" * 60}, ""),
    "cut glb": ({"a.glb": b"glTF" + (2).to_bytes(4, "little") + (999).to_bytes(4, "little")}, ""),
    "glb without a mesh": (
        {"a.glb": b"glTF\2\0\0\0\x20\0\0\0\x0c\0\0\0JSON{}          "},
        "",
    ),
    "npz without faces": (arrays("a.npz", rest_positions=np.zeros((3, 3))), ""),
    "npz of wrong shapes": (skirt_file(rest_positions=np.zeros((9, 2))), ""),
    "npz with nan": (skirt_file(rest_positions=np.full((1920, 3), NAN)), ""),
    "npz with faces beyond": (skirt_file(faces=np.full((9, 3), 99999)), ""),
    "npz of text": (text("a.npz", "hello"), ""),
    "npz of objects": (arrays("a.npz", rest_positions=np.array([{}, None], dtype=object)), ""),
    "a folder for a garment": ({"a.obj": None}, ""),
    "an unknown suffix": (text("a.fbx", "hello"), "obj"),
    "no suffix": (text("garment", "hello"), ""),
    "pkl of noise": ({"a.pkl": b"\x80\x04noise"}, ""),
    "pkl that would run a command": ({"a.pkl": pickle.dumps({"shirt": Danger()})}, ""),
    "pkl without that garment": ({"a.pkl#skirt": pickle.dumps({"shirt": 1})}, ""),
}  # fmt: skip
MOTIONS = {
    "empty bvh": (text("a.bvh", ""), ""),
    "bvh without motion": (text("a.bvh", BVH.partition("MOTION")[0]), ""),
    "bvh row too short": (text("a.bvh", BVH.replace("0 90 0 0 0 0 0 0 0\n", "0 90 0\n")), ""),
    "bvh with nan": (text("a.bvh", BVH.replace("90", "nan")), "finite"),
    "bvh of words": (text("a.bvh", BVH.replace("90", "ninety")), ""),
    "bvh frame time zero": (text("a.bvh", BVH.replace("0.0333", "0")), ""),
    "bvh of minus five frames": (text("a.bvh", BVH.replace("Frames: 2", "Frames: -5")), ""),
    "bvh cut in its hierarchy": (text("a.bvh", BVH[:120]), ""),
    "bvh of an unknown channel": (text("a.bvh", BVH.replace("Xposition", "Wposition")), ""),
    "bvh of a million channels": (text("a.bvh", BVH.replace("CHANNELS 6", "CHANNELS 1000000")), ""),
    "bvh of one joint": (
        text("a.bvh", "HIERARCHY\nROOT a\n{\nOFFSET 0 0 0\nCHANNELS 3 Zrotation Xrotation Yrotation\n}\nMOTION\n"
             "Frames: 2\nFrame Time: 0.03\n0 0 0\n0 0 0\n"), "",
    ),
    "amc without its asf": (text("a.amc", ":DEGREES\n1\nroot 0 1 0 0 20 0\n"), "asf"),
    "amc of an unknown bone": (
        text("a.asf", ASF) | text("a.amc", ":DEGREES\n1\nroot 0 1 0 0 20 0\nwing 1 2\n"), "wing",
    ),
    "amc without frames": (text("a.asf", ASF) | text("a.amc", ":DEGREES\n"), "frame"),
    "asf for a motion": (text("a.asf", ASF), ""),
    "npz without poses": (arrays("a.npz", trans=np.zeros((4, 3))), "no motion"),
    "amass of one frame": (arrays("a.npz", **POSES | {key: POSES[key][:1] for key in ("poses", "trans")}), ""),
    "amass of odd width": (arrays("a.npz", **POSES | {"poses": np.zeros((4, 17))}), ""),
    "amass with nan": (arrays("a.npz", **POSES | {"poses": np.full((4, 156), NAN)}), "finite"),
    "amass at no rate": (arrays("a.npz", **POSES | {"mocap_framerate": np.array(0.0)}), ""),
    "amass of two lengths": (arrays("a.npz", **POSES | {"trans": np.zeros((3, 3))}), ""),
    "motion pkl of noise": ({"a.pkl": b"noise"}, ""),
    "a folder for a motion": ({"a.bvh": None}, ""),
    "a motion of an unknown suffix": (text("a.abc", "hello"), ".bvh"),
    "glb without a clip of that name": ({"a.glb#run": b"glTF" + b"\0" * 20}, ""),
}  # fmt: skip
BODIES = {
    "npz that is no body": (arrays("a.npz", something=np.zeros(3)), ""),
    "a body of one frame": (arrays("a.npz", **BODY | {"positions": np.zeros((1, 4, 3))}), ""),
    "a body with nan": (arrays("a.npz", **BODY | {"positions": np.full((4, 4, 3), NAN)}), "finite"),
    "a body with faces beyond": (arrays("a.npz", **BODY | {"faces": np.array([[0, 1, 9]])}), ""),
    "a flat body": (arrays("a.npz", **BODY), ""),
    "a body of an unknown suffix": (text("a.fbx", "hello"), ""),
    "an empty folder": ({"bodies": None}, ""),
    "a folder of two topologies": (
        text("bodies/0.obj", TRIANGLE + "f 1 2 3\n") | text("bodies/1.obj", TRIANGLE + "v 0 0 1\nf 1 2 4\n"), "",
    ),
    "smpl of noise": ({"a.pkl": b"\x80\x04noise"}, ""),
    "a body that is an image": ({"a.glb": b"\x89PNG\r\n\x1a\n" + b"\0" * 40}, ""),
}  # fmt: skip
OPTIONS = {
    "gusts without wind": (("--gust", "0.3"), "wind"),
    "gusts that are negative": (("--wind", "3", "0", "0", "--gust", "-1"), "gusts"),
    "a wind of nan": (("--wind", "nan", "0", "0"), "wind"),
    "a hurricane": (("--wind", "0", "0", "500"), "wind"),
    "damping of two seconds": (("--damping", "2"), "damping"),
    "negative damping": (("--damping", "-0.1"), "damping"),
    "minus three frames": (("--frames", "-3"), "two frames"),
    "no frame": (("--frames", "0"), "two frames"),
    "a start behind the end": (("--start", "99s"), "start"),
    "a start before the beginning": (("--start", "-1"), ""),
    "a start of words": (("--start", "later"), "--start"),
    "a start at no number": (("--start", "nans"), "--start"),
    "a loop of nothing": (("--loop", "0s"), ""),
    "a loop of words": (("--loop", "ever"), "--loop"),
    "minus one frame of settling": (("--settle", "-1"), "--settle"),
    "a budget without unit": (("--budget", "20"), "--budget"),
    "a negative budget": (("--budget", "-5ms"), "--budget"),
    "a tolerance above one": (("--tolerance", "150%"), "--tolerance"),
    "a tolerance of words": (("--tolerance", "small"), "--tolerance"),
    "an unknown fabric": (("--fabric", "kevlra"), "kevlra"),
    "a fabric of negative density": (("--fabric", "density=-1"), "density"),
    "a fabric that is no number": (("--fabric", "density=nan"), "density"),
    "a fabric of an unknown value": (("--fabric", "colour=3"), "colour"),
    "a missing joint map": (("--joint-map", "map.json"), "map.json"),
    "arms at no angle": (("--arm-abduction", "nan"), ""),
    "arms around the clock": (("--arm-abduction", "1e9"), ""),
    "a rate for a rigged body": (("--body-fps", "30"), "--body-fps"),
    "betas for another body": (("--betas", *["1"] * 99), "betas"),
    "a unit for the bundled body": (("--body-units", "cm"), "metres"),
    "minus one iteration": (("--iterations", "-1"), "iterations"),
    "a missing model": (("--model", "missing.npz"), "missing.npz"),
    "an unknown model": (("--model", "eslr-huge"), "eslr-huge"),
    "a fabric for a part that the garment lacks": (("--garment", "tank", "--fabric", "front:denim"), "front"),
}  # fmt: skip
OTHERS = {
    "render of nothing": (("render", "missing", "--out", "a.png"), "missing"),
    "render of no picture": (("render", "run", "--out", "a.png", "--frames", "0"), "--frames"),
    "render into a gif": (("render", "run", "--out", "a.gif"), ".mp4"),
    "render without zoom": (("render", "run", "--out", "a.png", "--zoom", "0"), "zoom"),
    "render with a zoom of nan": (("render", "run", "--out", "a.png", "--zoom", "nan"), "zoom"),
    "render from nowhere": (("render", "run", "--out", "a.png", "--camera", "above"), "camera"),
    "render behind the end": (("render", "run", "--out", "a.png", "--at", "99s"), "--at"),
    "render at a word": (("render", "run", "--out", "a.png", "--at", "noon"), "--at"),
    "render of no width": (("render", "run", "--out", "a.png", "--width", "0"), "width"),
    "render of no ray": (("render", "run", "--out", "a.png", "--samples", "0"), "samples"),
    "export of nothing": (("export", "missing", "--out", "a.glb"), "missing"),
    "export to an unknown suffix": (("export", "run", "--out", "a.xyz"), "xyz"),
    "export of a damaged run": (("export", "damaged", "--out", "a.glb"), "damaged"),
    "training on words": (("train", "--config", "words.toml", "--out", "t"), "words.toml"),
    "training of an unknown key": (("train", "--config", "key.toml", "--out", "t"), "stepz"),
    "training of the wrong type": (("train", "--config", "type.toml", "--out", "t"), "steps"),
    "training of minus one step": (
        ("train", "--config", "good.toml", "--set", "steps=-1", "--out", "t"), "steps",
    ),
    "a change without a value": (("train", "--config", "good.toml", "--set", "steps", "--out", "t"), "key=value"),
    "a folder for a configuration": (("train", "--config", "run", "--out", "t"), "run"),
    "evaluation of an unknown network": (("evaluate", "--model", "eslr-huge"), "eslr-huge"),
    "evaluation on an unknown split": (("evaluate", "--model", "eslr-small", "--split", "tset"), "tset"),
    "evaluation of an unknown clip": (("evaluate", "--model", "eslr-small", "--clips", "x"), "x"),
    "evaluation with minus one iteration": (
        ("evaluate", "--model", "eslr-small", "--iterations", "-1"), "iterations",
    ),
    "a calibration into a file": (("calibrate", "--out", "key.toml/a.json"), "key.toml"),
    "a run whose configuration is a list": (("train", "--resume", "--out", "list"), "config.json"),
    "training with events of an unknown garment": (
        ("train", "--config", "good.toml", "--set", 'garments=["tshrit"]', "--tensorboard", "--out", "t"),
        "tshrit",
    ),
    "info of an unknown network": (("info", "--model", "eslr-huge"), "eslr-huge"),
    "info of a network and a scene": (("info", "--scene", "tshirt", "--model", "eslr-small"), "--model"),
    "processes that nothing joins": (
        ("train", "--config", "good.toml", "--num-processes", "2", "--process-id", "1", "--out", "t"),
        "--coordinator",
    ),
    "coordinates taken from a network without attention": (
        ("evaluate", "--model", "mgn-5-correction", "--control", "no_embedding"), "attention",
    ),
    "info of a missing scene": (("info", "--scene", "missing.obj"), "missing.obj"),
    "a body exported to stl": (("assets", "--export", "body.stl"), "obj"),
    "joints of nothing": (("joints", "--motion", "missing.bvh"), "missing.bvh"),
    "joints of an unknown suffix": (("joints", "--motion", "key.toml"), ""),
    "a fit without npz": (("fit", "skirt.obj", "--out", "a.obj"), "npz"),
    "a fit in minus units": (("fit", "skirt.obj", "--out", "a.npz", "--units", "-1"), "positive"),
    "a fit with an edge of nothing": (("fit", "skirt.obj", "--out", "a.npz", "--edge-length", "0"), "edge"),
    "a fit with a weld of nan": (("fit", "skirt.obj", "--out", "a.npz", "--weld", "nan"), "weld"),
    "a fit with a pin of no vertex": (("fit", "skirt.obj", "--out", "a.npz", "--pin", "vertices:99999"), "99999"),
    "a pin at no number": (("fit", "skirt.obj", "--out", "a.npz", "--pin", "region:y>1.2.3"), "y>1.2.3"),
    "a text format in a binary file": (
        ("export", "run", "--format", "usda", "--out", "a.usdc"), ".usda",
    ),
    "a size of a garment of no other body": (
        ("fit", "skirt.obj", "--out", "a.npz", "--scale", "girth", "--no-picture"), "--made-for",
    ),
    "a bundled garment of another body": (
        ("fit", "tank", "--out", "a.npz", "--made-for", "anny"), "made for the bundled body",
    ),
    "a fit into a folder that is a file": (("fit", "skirt.obj", "--out", "key.toml/a.npz"), "key.toml"),
    "a map that is no table": (
        ("simulate", "--joint-map", "list.json", "--motion", "good.bvh", "--out", "t"), "list.json",
    ),
    "a map of an unknown joint": (
        ("simulate", "--joint-map", "wing.json", "--motion", "good.bvh", "--out", "t"), "Wing",
    ),
    "a network of noise": (("simulate", "--model", "noise.npz", "--out", "t"), "noise.npz"),
    "a run to resume that is damaged": (("simulate", "--resume", "--out", "damaged"), "unfinished.npz"),
    "an output inside a file": (("simulate", "--frames", "2", "--out", "key.toml/out"), "key.toml"),
}  # fmt: skip


def write(folder, files):
    """Write files: bytes, arrays of an npz, or None for a folder; return the path of the last."""
    path = folder
    for name, content in files.items():
        path = folder / name.partition("#")[0]
        path.parent.mkdir(exist_ok=True)
        if content is None:
            path.mkdir()
        elif isinstance(content, dict):
            np.savez(path, **content)
        else:
            path.write_bytes(content)
    *_, last = files
    first = folder / last.partition("/")[0] if "/" in last else folder / last
    return str(first)


@pytest.fixture
def refused(monkeypatch, capsys, tmp_path):
    """A function that runs a command, and checks that it is refused in one line and leaves nothing."""

    def run(words, cause):
        monkeypatch.chdir(tmp_path)
        before = sorted(path.relative_to(tmp_path) for path in tmp_path.rglob("*"))
        monkeypatch.setattr(sys, "argv", ["eslr", *words])
        with warnings.catch_warnings(), pytest.raises(SystemExit) as end:
            main()
        shown = capsys.readouterr().err
        lines = [line for line in shown.splitlines() if line.startswith("eslr: ")]
        assert end.value.code == 2, shown
        assert len(lines) == 1, shown
        assert "Traceback" not in shown
        assert cause in lines[0]
        assert len(lines[0]) > 25  # more than a name: what to do
        assert sorted(path.relative_to(tmp_path) for path in tmp_path.rglob("*")) == before

    return run


@pytest.mark.parametrize("kind", GARMENTS)
def test_bad_garments(tmp_path, refused, kind):
    files, cause = GARMENTS[kind]
    refused(("fit", write(tmp_path, files), "--out", "fitted.npz", "--no-picture"), cause)


@pytest.mark.parametrize("kind", MOTIONS)
def test_bad_motions(tmp_path, refused, kind):
    files, cause = MOTIONS[kind]
    refused(("simulate", "--motion", write(tmp_path, files), "--out", "out"), cause)


@pytest.mark.parametrize("kind", BODIES)
def test_bad_bodies(tmp_path, refused, kind):
    files, cause = BODIES[kind]
    refused(("simulate", "--body", write(tmp_path, files), "--out", "out"), cause)


@pytest.mark.parametrize("kind", OPTIONS)
def test_bad_options(refused, kind):
    words, cause = OPTIONS[kind]
    refused(("simulate", *words, "--out", "out"), cause)


@pytest.mark.parametrize("kind", OTHERS)
def test_bad_commands(tmp_path, body, refused, kind):
    words, cause = OTHERS[kind]
    if "run" in words:
        write_run(tmp_path, body, "run")
    if "skirt.obj" in words:
        write_obj(tmp_path / "skirt.obj", skirt())
    good = 'garments = ["tshirt"]\nsteps = 2\n[model]\nbase = "mgn-small"\n'
    named = {
        "words.toml": "these are words", "key.toml": good.replace("steps", "stepz"), "good.toml": good,
        "type.toml": good.replace("2", '"two"'), "list.json": "[1, 2]", "wing.json": json.dumps({"Wing": "Hips"}),
        "good.bvh": BVH, "noise.npz": "noise",
        "list/config.json": '{"format": 1, "train": []}',
        "damaged/trajectory.npz": "noise", "damaged/unfinished.npz": "noise",
    }  # fmt: skip
    write(tmp_path, {name: content.encode() for name, content in named.items()})
    refused(words, cause)
