"""The Blender add-on: its process with this Python alone, and all of it where BLENDER_PYTHON has `bpy`."""

import importlib
import json
import os
import subprocess
import sys
import time
import tomllib
import zipfile
from pathlib import Path
from types import ModuleType, SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
from foreign_files import write_walker
from scipy.spatial import cKDTree

from eslr_jax.mesh.closest import closest_points
from eslr_jax.mesh.topology import vertex_normals
from eslr_jax.pipeline.formats.gltf_rig import read_gltf_body
from eslr_jax.pipeline.formats.mesh import read_mesh_file

ROOT = Path(__file__).parents[2]
ADDON = ROOT / "integrations" / "blender"
BLENDER = os.environ.get("BLENDER_PYTHON")
needs_blender = pytest.mark.skipif(BLENDER is None, reason="BLENDER_PYTHON names no Python with bpy")

sys.path.insert(0, str(ADDON))
from build import build  # noqa: E402

sys.path.insert(0, str(ADDON / "eslr_garments"))
from job import Job, JobError, Step, simulation_steps  # noqa: E402


@pytest.fixture
def folder(tmp_path, body):
    """A job's folder: a character that walks, and its shirt."""
    write_walker(tmp_path / "body.glb", tmp_path / "garment.obj", body)
    return tmp_path


def steps(folder, python=sys.executable, fabric="cotton"):
    return simulation_steps(python, folder, fabric, "5%", False)


def scripted(folder, *scripts):
    """A job whose steps are lines of Python."""
    commands = [[sys.executable, "-c", script] for script in scripts]
    return Job([Step("working", command, f"{number}.txt") for number, command in enumerate(commands)], folder)


def run(job):
    """Poll until the job is done; return what it said and how far it was."""
    seen = []
    while not job.poll():
        seen.append((job.text, job.share))
        time.sleep(0.05)
    return seen


def test_the_zip_holds_an_extension_under_the_gpl_and_the_wheel_does_not_hold_it(tmp_path):
    path = build(tmp_path)
    with zipfile.ZipFile(path) as archive:
        manifest = tomllib.loads(archive.read("blender_manifest.toml").decode())
        assert manifest["license"] == ["SPDX:GPL-3.0-or-later"]
        assert path.name == f"{manifest['id']}-{manifest['version']}.zip"
        assert b"GNU GENERAL PUBLIC LICENSE" in archive.read("LICENSE")
        for name in archive.namelist():
            if name.endswith(".py"):
                assert archive.read(name).startswith(b"# SPDX-License-Identifier: GPL-3.0-or-later\n")
    again = build(tmp_path / ".")
    assert again.read_bytes() == path.read_bytes()
    wheel = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]["wheel"]
    assert wheel["packages"] == ["eslr_jax"]
    assert not any("integrations" in name for name in wheel["force-include"])


def test_a_python_without_the_simulator_is_told_in_one_line(tmp_path):
    with pytest.raises(JobError, match=r"can't be started .* preferences"):
        run(Job(steps(tmp_path, python=str(tmp_path / "python")), tmp_path))
    bare = tmp_path / "bare"
    bare.write_text(f'#!/bin/sh\nexec {sys.executable} -S -E "$@"\n')
    bare.chmod(0o755)
    with pytest.raises(JobError, match="this Python has no eslr_jax"):
        run(Job(steps(tmp_path, python=str(bare)), tmp_path))


def test_warnings_are_collected_and_a_refusal_names_no_folder_that_is_gone(tmp_path):
    job = scripted(
        tmp_path,
        """print('{"warnings": ["the place is doubtful"], "pinned": 0}')""",
        r"""print("good: stretched by 3 %\n\x1b[33mwarning:\x1b[0m skin shows\nframes 3")""",
        """import sys
print("compiling 3/9", file=sys.stderr)
sys.exit("eslr: frame 3 is not finite; the frames before are kept in a folder")""",
    )
    with pytest.raises(JobError, match=r"^frame 3 is not finite$"):
        run(job)
    assert job.warnings == ["the place is doubtful", "skin shows"]


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="no list of processes")
def test_a_cancelled_job_leaves_no_process(tmp_path):
    job = scripted(tmp_path, "import os, time; print(os.getpid(), flush=True); time.sleep(60)")
    deadline = time.monotonic() + 30
    while not job.poll() and not (process := (tmp_path / "0.txt").read_text()):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    job.cancel()
    while Path("/proc", process.strip()).exists():
        assert time.monotonic() < deadline
        time.sleep(0.05)


class _Modifiers(list):
    """A garment's modifiers, as far as `lay_cache` knows them."""

    def get(self, name):
        return next((modifier for modifier in self if modifier.name == name), None)

    def new(self, name, kind):
        self.append(SimpleNamespace(name=name, type=kind))
        return self[-1]

    def move(self, start, end):
        self.insert(end, self.pop(start))


def shirt(**more):
    return SimpleNamespace(name="shirt", matrix_world=np.eye(4), modifiers=_Modifiers(), **more)


def without_blender(monkeypatch):
    """Return `exchange`; what is tested of it needs nothing of `bpy`."""
    monkeypatch.setitem(sys.modules, "bpy", ModuleType("bpy"))
    monkeypatch.delitem(sys.modules, "exchange", raising=False)
    return importlib.import_module("exchange")


@pytest.mark.parametrize(("first", "fps", "report"), [
    (0, 24, {}), (1, 24, {"motion_start_s": 0.0}), (1, 24, {"motion_start_s": 1 / 24}),
    (5, 60, {"motion_start_s": 0.5}),
])  # fmt: skip
def test_the_cache_begins_where_the_simulation_does(tmp_path, monkeypatch, first, fps, report):
    """Blender shows sample `frame_scale * frame - frame_start` (`MOD_meshcache.cc`)."""
    exchange = without_blender(monkeypatch)
    (tmp_path / "report.json").write_text(json.dumps(report))
    start = exchange.read_start(tmp_path / "report.json")
    scene = SimpleNamespace(frame_start=first, render=SimpleNamespace(fps=fps, fps_base=1.0))
    cache = exchange.lay_cache(shirt(), np.zeros((3, 4, 3)), tmp_path / "a.pc2", scene, start=start)
    frame = first + fps * report.get("motion_start_s", 0.0)  # that the first sample belongs to
    assert cache.frame_scale * frame - cache.frame_start == pytest.approx(0.0)
    assert cache.frame_scale * (frame + fps) - cache.frame_start == pytest.approx(30.0)


def test_a_cache_that_can_t_be_written_leaves_the_last_one(tmp_path, monkeypatch):
    exchange = without_blender(monkeypatch)
    garment = shirt()
    scene = SimpleNamespace(frame_start=0, render=SimpleNamespace(fps=24, fps_base=1.0))
    exchange.lay_cache(garment, np.zeros((3, 4, 3)), tmp_path / "a.pc2", scene, start=0.0)
    before = (tmp_path / "a.pc2").read_bytes()

    def fill(path, data):
        path.open("wb").close()  # as a full disk does
        raise OSError("no space left")

    monkeypatch.setattr(Path, "write_bytes", fill)
    with pytest.raises(OSError, match="no space left"):
        exchange.lay_cache(garment, np.ones((3, 4, 3)), tmp_path / "a.pc2", scene, start=0.0)
    assert (tmp_path / "a.pc2").read_bytes() == before


class _Values(list):
    """A collection of Blender that gives its values at once."""

    def foreach_get(self, name, target):
        target[:] = np.ravel(self)


@pytest.mark.parametrize("has_uvs", [True, False])
def test_a_garment_goes_to_the_simulator_with_its_texture(tmp_path, monkeypatch, has_uvs):
    exchange = without_blender(monkeypatch)
    uvs = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0.5, 0], [1, 0.5], [0, 0.25]])
    faces = [SimpleNamespace(vertices=[0, 1, 2, 3], loop_indices=range(4))]
    faces.append(SimpleNamespace(vertices=[2, 1, 4], loop_indices=range(4, 7)))
    layer = SimpleNamespace(data=_Values(uvs)) if has_uvs else None
    mesh = SimpleNamespace(
        vertices=_Values([[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1], [2, 0, 0]]),
        polygons=faces,
        loops=range(7),
        uv_layers=SimpleNamespace(active=layer),
        shape_keys=None,
    )
    garment = SimpleNamespace(name="shirt", data=mesh, matrix_world=np.eye(4), active_shape_key_index=0)
    scene = SimpleNamespace(frame_start=0, frame_end=3, frame_current=1, frame_set=lambda frame: None)
    exchange.export_garment(tmp_path / "garment.obj", garment, scene)
    read = read_mesh_file(tmp_path / "garment.obj")
    assert read.faces.tolist() == [[0, 1, 2], [0, 2, 3], [2, 1, 4]]
    if not has_uvs:
        assert read.corner_uvs is None
        return
    np.testing.assert_allclose(read.corner_uvs, uvs[[[0, 1, 2], [0, 2, 3], [4, 5, 6]]])


@pytest.mark.slow
@needs_blender
def test_body_and_garment_go_to_the_simulator_as_their_shape_keys_shape_them(folder):
    worker = Path(__file__).with_name("blender_shapes_worker.py")
    command = [BLENDER, worker, ADDON / "eslr_garments", folder / "body.glb", folder / "out"]
    (folder / "out").mkdir()
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, timeout=300, check=False)
    assert (folder / "out" / "shown.npz").exists(), done.stderr
    shown = np.load(folder / "out" / "shown.npz")
    for kind, found in (
        ("body", read_gltf_body(folder / "out" / "body.glb").positions),
        ("garment", read_mesh_file(folder / "out" / "garment.obj").positions),
    ):
        want, drawn = shown[kind], shown[f"{kind}_drawn"]
        assert np.abs(want - drawn).max() > 0.05
        order = cKDTree(want).query(found)  # the exporter of glTF splits and reorders vertices
        np.testing.assert_allclose(order[0], 0.0, atol=1e-5)
        assert len(np.unique(order[1])) == len(want)
    assert bool(shown["is_as_before"])


SIMULATOR = """#!{python}
import json, sys
from pathlib import Path
import numpy as np

command, *words = sys.argv[3:]
if command == "fit":
    print(json.dumps({{"placement": {{"moved_m": [0.0, 0.0, 0.0]}}}}))
elif command == "simulate":
    Path("run").mkdir()
    Path("run/report.json").write_text("{{}}")
else:
    np.savez("motion.npz", positions=np.ones((2, 4, 3)))
"""


def test_a_garment_that_an_undo_made_anew_takes_the_simulation(tmp_path, monkeypatch):
    """Blender's objects don't outlive an undo; their names do."""
    python = tmp_path / "python"
    python.write_text(SIMULATOR.format(python=sys.executable))
    python.chmod(0o755)
    kinds = ("AddonPreferences", "Object", "Operator", "Panel", "PropertyGroup")
    bpy = MagicMock(types=SimpleNamespace(**{kind: type(kind, (), {}) for kind in kinds}))
    bpy.path.abspath = bpy.path.clean_name = lambda text: text
    monkeypatch.setitem(sys.modules, "bpy", bpy)
    for name in ("eslr_garments", "eslr_garments.exchange"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    addon = importlib.import_module("eslr_garments")
    for name in ("export_body", "export_garment"):  # what Blender writes
        monkeypatch.setattr(addon.exchange, name, lambda *rest: None)
    context, operator, said = MagicMock(), addon.ESLR_OT_simulate(), []
    operator.report = lambda kind, text: said.append(text)
    context.scene.frame_start, context.scene.render = 0, SimpleNamespace(fps=24, fps_base=1.0)
    settings = context.scene.eslr
    settings.garment, settings.folder, settings.fabric = shirt(), str(tmp_path / "cache"), "cotton"
    settings.tolerance, settings.self_contact = "1%", False
    context.preferences.addons.__getitem__.return_value.preferences.python = str(python)
    anew = shirt(data=SimpleNamespace(vertices=range(4)))
    for objects, result in (({"shirt": anew}, "FINISHED"), ({}, "CANCELLED")):
        bpy.data.objects = objects
        assert operator.execute(context) == {result}, said
    assert [modifier.name for modifier in anew.modifiers] == ["ESLR Garments"]
    assert (tmp_path / "cache" / "shirt.pc2").exists()
    assert said[-1].startswith("shirt is gone")


@pytest.mark.slow
def test_the_job_shows_how_far_it_is(folder):
    seen = run(Job(steps(folder), folder))
    texts, shares = zip(*seen, strict=True)
    assert "fitting the garment" in texts
    assert any(text.startswith("simulating, ") for text in texts)
    assert list(shares) == sorted(shares)
    with np.load(folder / "motion.npz") as motion:
        assert motion["positions"].shape[1:] == (1000, 3)


@pytest.mark.slow
def test_a_refusal_of_the_simulator_is_the_job_s(folder):
    with pytest.raises(JobError, match="did you mean denim"):
        run(Job(steps(folder, fabric="denin"), folder))


@pytest.mark.slow
@needs_blender
def test_from_install_to_a_garment_that_moves_with_the_body_and_stays_out_of_it(folder):
    character = folder / "body.glb"
    worker = Path(__file__).with_name("blender_addon_worker.py")
    user = folder / "blender"
    user.mkdir()
    arguments = [build(folder), character, folder / "garment.obj"]

    def blender(out, python, *fabric):
        environment = os.environ | {"BLENDER_USER_RESOURCES": str(user)}
        command = [BLENDER, worker, *arguments, python, out, *fabric]
        done = subprocess.run(
            list(map(str, command)), capture_output=True, text=True, env=environment, timeout=900, check=False
        )
        assert out.exists(), done.stderr
        return np.load(out)

    # Blender's Python is another one than the simulator's, whose packages it must not see.
    shown = blender(folder / "out.npz", sys.executable)
    assert list(shown["result"]) == ["FINISHED"], str(shown["error"])
    cloth, body, faces = shown["cloth"], shown["body"], shown["faces"]
    moved, way = (np.linalg.norm(np.diff(track, axis=0), axis=2).mean(axis=1) for track in (cloth, body))
    assert (moved > 0.2 * way).all()
    assert (moved < 5 * way).all()
    for points, skin in zip(cloth, body, strict=True):
        nearest, weights = closest_points(points, skin, faces)
        away = points - np.einsum("pk,pkx->px", weights, skin[faces[nearest]])
        outward = np.einsum("pk,pkx->px", weights, vertex_normals(skin, faces)[faces[nearest]])
        depth = -np.sign(np.sum(away * outward, axis=1)) * np.linalg.norm(away, axis=1)
        assert np.quantile(depth, 0.99) < 0
        assert depth.max() < 5e-3  # an armpit pinches the sleeve by 2 mm; the report warns from 5 mm on
    assert list(shown["modifiers"]) == ["ESLR Garments"]
    refused = blender(folder / "refused.npz", sys.executable, "denin")
    assert "did you mean denim" in str(refused["error"])
    np.testing.assert_array_equal(refused["cloth"][-1], refused["before"])
