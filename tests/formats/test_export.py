"""A run in other programs' formats, read back by other people's code: frame by frame the same positions."""

import os
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pygltflib as gltf
import pytest
import trimesh
from commands import eslr, succeeded
from garment_files import stored
from test_gltf import Player, make_body

from eslr_jax import AssetError
from eslr_jax.pipeline.formats.animated import AnimatedMesh
from eslr_jax.pipeline.formats.export import export_trajectory
from eslr_jax.pipeline.formats.garment import in_vertex_order
from eslr_jax.pipeline.formats.mesh_sequence import read_mesh_sequence
from eslr_jax.pipeline.formats.palette import SKIN_COLOR
from eslr_jax.pipeline.formats.trajectory import TrajectoryFile, write_trajectory

FRAMES, STEP = 4, 1 / 30
SPHERE = trimesh.creation.icosphere(subdivisions=1)
VERTICES = len(SPHERE.vertices)


@pytest.fixture(scope="module")
def run():
    rng = np.random.default_rng(0)
    positions = (SPHERE.vertices + 0.1 * rng.normal(size=(FRAMES, VERTICES, 3))).astype(np.float32)
    return TrajectoryFile(
        positions=positions,
        velocities=rng.normal(size=positions.shape).astype(np.float32),
        faces=np.asarray(SPHERE.faces),
        body=AnimatedMesh(
            name="body",
            color=SKIN_COLOR,
            positions=positions[:, ::-1] + np.float32(2),
            faces=VERTICES - 1 - np.asarray(SPHERE.faces),
            rest_positions=positions[0],
        ),
        timestep=float(np.float32(STEP)),
        metadata={"garment": "/home/me/My shirt.obj"},
    )


@pytest.fixture(scope="module")
def garment():
    """A garment whose file had its vertices in another order, one of them twice, and a seam in its texture."""
    rng = np.random.default_rng(1)
    places = np.append(rng.permutation(VERTICES), 7)
    faces = np.asarray(SPHERE.faces)
    uvs = rng.random((VERTICES, 2))[faces].round(3)
    uvs[:20] += 0.5  # the other side of a seam
    return stored(np.asarray(SPHERE.vertices), faces, corner_uvs=uvs, vertex_map=places)


def corner_points(positions, faces):
    return np.asarray(positions)[np.asarray(faces)]


@pytest.mark.parametrize("suffix", ["usda", "usdc", "usd"])
def test_usd_holds_every_frame(tmp_path, run, garment, suffix):
    usd = pytest.importorskip("pxr.Usd")
    from pxr import UsdGeom

    path = export_trajectory(run, tmp_path / f"run.{suffix}", garment=garment)
    stage = usd.Stage.Open(str(path))
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert stage.GetTimeCodesPerSecond() == stage.GetFramesPerSecond() == 30.0  # exactly, from a float32 step
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0, FRAMES - 1)
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/World/My_shirt"))
    assert mesh.GetPrim().GetDisplayName() == "My shirt"
    assert set(mesh.GetFaceVertexCountsAttr().Get()) == {3}
    faces = np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
    body = UsdGeom.Mesh(stage.GetPrimAtPath("/World/body"))
    assert mesh.GetPointsAttr().GetTimeSamples() == list(range(FRAMES))
    for frame in range(FRAMES):
        points = np.array(mesh.GetPointsAttr().Get(frame))
        np.testing.assert_array_equal(points, run.positions[frame][garment.vertex_map])
        np.testing.assert_array_equal(
            corner_points(points, faces), corner_points(run.positions[frame], run.faces)
        )
        np.testing.assert_array_equal(np.array(body.GetPointsAttr().Get(frame)), run.body.positions[frame])
        velocities = np.array(mesh.GetVelocitiesAttr().Get(frame))
        np.testing.assert_array_equal(velocities, run.velocities[frame][garment.vertex_map])
        normals = trimesh.Trimesh(run.positions[frame], run.faces, process=False).vertex_normals
        written = np.array(mesh.GetNormalsAttr().Get(frame))
        cosines = np.einsum("va,va->v", written, normals[garment.vertex_map])
        assert cosines[:-1].min() > 0.85  # theirs are weighted by angle; the last vertex has no face
    st = UsdGeom.PrimvarsAPI(mesh.GetPrim()).GetPrimvar("st")
    assert st.GetInterpolation() == "faceVarying"
    np.testing.assert_allclose(np.array(st.Get()).reshape(-1, 3, 2), garment.corner_uvs, atol=1e-6)


def test_glb_holds_every_frame(tmp_path, run, garment):
    player = Player(export_trajectory(run, tmp_path / "run.glb", garment=garment))
    assert [mesh.name for mesh in player.document.meshes] == ["My shirt", "body"]
    primitive = player.document.meshes[0].primitives[0]
    faces = player.read(primitive.indices).reshape(-1, 3)
    for frame in range(FRAMES):
        points = player.positions("My shirt", frame * STEP)
        count = len(garment.vertex_map)
        np.testing.assert_allclose(points[:count], run.positions[frame][garment.vertex_map], atol=1e-6)
        expected = corner_points(run.positions[frame], run.faces)
        np.testing.assert_allclose(corner_points(points, faces), expected, atol=1e-6)
    uvs = player.read(primitive.attributes.TEXCOORD_0)
    np.testing.assert_allclose(corner_points(uvs, faces) * [1, -1] + [0, 1], garment.corner_uvs, atol=1e-6)


@pytest.mark.parametrize("kind", ["obj", "ply"])
def test_sequences_hold_every_frame_and_come_back_exactly(tmp_path, run, garment, kind):
    folder = export_trajectory(run, tmp_path / "frames", garment=garment, format=kind)
    files = sorted(folder.iterdir())
    assert [file.name for file in files] == [f"My shirt_{frame:04d}.{kind}" for frame in range(FRAMES)]
    assert sorted(os.listdir(tmp_path)) == ["frames"]
    for frame, file in enumerate(files):
        theirs = trimesh.load(file, process=False)
        expected = corner_points(run.positions[frame], run.faces)
        np.testing.assert_allclose(corner_points(theirs.vertices, theirs.faces), expected, atol=1e-6)
        uvs = corner_points(theirs.visual.uv, theirs.faces)
        np.testing.assert_allclose(uvs, garment.corner_uvs, atol=1e-6)
    back = read_mesh_sequence(folder)
    count = len(garment.vertex_map)
    np.testing.assert_array_equal(
        back.positions[:, :count].astype(np.float32), run.positions[:, garment.vertex_map]
    )


@pytest.mark.parametrize("kind", ["obj", "ply"])
@pytest.mark.parametrize("has_dropped", [False, True])
def test_a_sequence_lies_on_the_garment_though_its_seams_are_split(tmp_path, run, garment, kind, has_dropped):
    order = garment.vertex_map
    if has_dropped:
        garment = replace(garment, vertex_map=np.concatenate([[-1], order[:5], [-1], order[5:], [-1]]))
    export_trajectory(run, tmp_path / "frames", garment=garment, format=kind)
    sequence = read_mesh_sequence(tmp_path / "frames")
    assert (sequence.positions.shape[1] > len(garment.vertex_map)) == (kind == "ply")
    np.testing.assert_array_equal(in_vertex_order(sequence, garment).astype(np.float32), run.positions)


def test_point_caches_hold_every_frame(tmp_path, run, garment):
    expected = run.positions[:, garment.vertex_map]
    export_trajectory(run, tmp_path / "run.pc2", garment=garment)
    raw = (tmp_path / "run.pc2").read_bytes()  # the layout, by hand
    assert raw[:12] == b"POINTCACHE2\0"
    assert np.frombuffer(raw, "<i4", 2, 12).tolist() == [1, expected.shape[1]]
    assert np.frombuffer(raw, "<i4", 1, 28)[0] == FRAMES
    np.testing.assert_array_equal(np.frombuffer(raw, "<f4", offset=32).reshape(expected.shape), expected)
    export_trajectory(run, tmp_path / "run.mdd", garment=garment)
    raw = (tmp_path / "run.mdd").read_bytes()
    assert np.frombuffer(raw, ">i4", 2).tolist() == [FRAMES, expected.shape[1]]
    np.testing.assert_allclose(np.frombuffer(raw, ">f4", FRAMES, 8), np.arange(FRAMES) * STEP, atol=1e-7)
    np.testing.assert_array_equal(
        np.frombuffer(raw, ">f4", offset=8 + 4 * FRAMES).reshape(expected.shape), expected
    )


def test_point_caches_keep_the_order_of_a_file_with_dropped_vertices(tmp_path, run, garment):
    order = garment.vertex_map
    dropped = replace(garment, vertex_map=np.concatenate([[-1], order[:5], [-1, -1], order[5:], [-1]]))
    with pytest.warns(UserWarning, match=f"4 of the {VERTICES + 5} vertices .* were dropped"):
        export_trajectory(run, tmp_path / "run.pc2", garment=dropped)
    raw = (tmp_path / "run.pc2").read_bytes()
    points = np.frombuffer(raw, "<f4", offset=32).reshape(FRAMES, VERTICES + 5, 3)
    is_kept = dropped.vertex_map >= 0
    np.testing.assert_array_equal(points[:, is_kept], run.positions[:, garment.vertex_map])
    np.testing.assert_array_equal(points[:, ~is_kept], points[:, [1, 8, 8, -2]])


def test_npz_comes_back_as_a_mesh_sequence(tmp_path, run):
    export_trajectory(run, tmp_path / "body.npz", content="body")
    back = read_mesh_sequence(tmp_path / "body.npz")
    np.testing.assert_array_equal(back.positions.astype(np.float32), run.body.positions)
    np.testing.assert_array_equal(back.faces, run.body.faces)
    assert back.fps == pytest.approx(30.0)


BLENDER = os.environ.get("BLENDER_PYTHON")  # of an environment with `bpy`, see CONTRIBUTING.md
needs_blender = pytest.mark.skipif(BLENDER is None, reason="BLENDER_PYTHON names no Python with bpy")
Z_UP = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])  # Blender's axes


def shown_in_blender(path, frames, vertices=0):
    """Return the positions and faces of every mesh that Blender shows."""
    out = path.with_suffix(".seen.npz")
    worker = Path(__file__).with_name("blender_worker.py")
    command = [str(BLENDER), str(worker), str(path), str(out), str(frames), str(vertices)]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    with np.load(out) as seen:
        return dict(seen)


@needs_blender
@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["pc2", "mdd"])
def test_blender_lays_point_caches_on_the_mesh(tmp_path, run, garment, suffix):
    path = export_trajectory(run, tmp_path / f"run.{suffix}", garment=garment)
    seen = shown_in_blender(path, FRAMES, len(garment.vertex_map))
    np.testing.assert_allclose(seen["cache/positions"], run.positions[:, garment.vertex_map], atol=1e-6)


@pytest.fixture(scope="module")
def skinned(run):
    """A run on a body that joints move."""
    return replace(run, body=make_body(FRAMES))


@needs_blender
@pytest.mark.slow
@pytest.mark.parametrize("bends", [False, True])
@pytest.mark.parametrize(("suffix", "name"), [("usdc", "My_shirt"), ("glb", "My shirt"), ("abc", "My_shirt")])
def test_blender_shows_every_frame(tmp_path, run, skinned, garment, suffix, name, bends):
    run = skinned if bends else run
    seen = shown_in_blender(export_trajectory(run, tmp_path / f"run.{suffix}", garment=garment), FRAMES)
    for mesh, track, most in ((name, run, 1e-5), ("body", run.body, 1e-4 if bends else 1e-5)):
        points, corners = seen[f"{mesh}/positions"], seen[f"{mesh}/faces"]
        for frame in range(FRAMES):
            expected = corner_points(track.positions[frame], track.faces) @ Z_UP
            np.testing.assert_allclose(corner_points(points[frame], corners), expected, atol=most)


def test_glb_of_a_run_moves_the_body_by_its_joints(tmp_path, skinned):
    document = gltf.GLTF2().load(str(export_trajectory(skinned, tmp_path / "run.glb")))
    body = next(node for node in document.nodes if node.name == "body")
    assert [document.nodes[joint].name for joint in document.skins[body.skin].joints] == list(
        skinned.body.skin.joint_names
    )
    assert not document.meshes[body.mesh].primitives[0].targets


def test_usd_of_a_run_moves_the_body_by_its_joints(tmp_path, skinned):
    usd = pytest.importorskip("pxr.Usd")
    from pxr import Gf, UsdGeom, UsdSkel

    stage = usd.Stage.Open(str(export_trajectory(skinned, tmp_path / "run.usdc")))
    root = UsdSkel.Root(stage.GetPrimAtPath("/World/body"))
    UsdSkel.BakeSkinning(root, Gf.Interval(0, FRAMES - 1))  # the library's own skinning
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/World/body/mesh"))
    for frame in range(FRAMES):
        points = np.array(mesh.GetPointsAttr().Get(frame))
        np.testing.assert_allclose(points, skinned.body.positions[frame], atol=1e-4)


def test_usd_tells_why_a_body_is_points(tmp_path, skinned):
    usd = pytest.importorskip("pxr.Usd")
    moved = skinned.body.positions + np.linspace(0, 0.01, FRAMES)[:, None, None]
    run = replace(skinned, body=replace(skinned.body, positions=moved.astype(np.float32)))
    stage = usd.Stage.Open(str(export_trajectory(run, tmp_path / "run.usda")))
    prim = stage.GetPrimAtPath("/World/body")
    assert prim.GetTypeName() == "Mesh"
    assert "joints alone don't" in prim.GetDocumentation()
    np.testing.assert_array_equal(np.array(prim.GetAttribute("points").Get(3)), run.body.positions[3])


def test_usd_materials_are_bound(tmp_path, run):
    usd = pytest.importorskip("pxr.Usd")
    from pxr import UsdShade

    stage = usd.Stage.Open(str(export_trajectory(run, tmp_path / "run.usdc")))
    colors = []
    for name in ("My_shirt", "body"):
        prim = stage.GetPrimAtPath(f"/World/{name}")
        material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
        shader, _, _ = material.ComputeSurfaceSource()
        assert shader.GetIdAttr().Get() == "UsdPreviewSurface"
        colors.append(tuple(shader.GetInput("diffuseColor").Get()))
    np.testing.assert_allclose(colors[0], [0.0732, 0.2140, 0.4480], atol=1e-3)  # sRGB .30 .50 .70, linear
    assert colors[0] != colors[1]


def test_garments_of_an_outfit_are_meshes_of_their_own_colours(tmp_path, run):
    usd = pytest.importorskip("pxr.Usd")
    from pxr import UsdGeom

    both = np.concatenate([run.positions, run.positions + np.float32(1)], axis=1)
    faces = np.concatenate([run.faces, run.faces + VERTICES])
    worn = replace(run, positions=both, velocities=np.zeros_like(both), faces=faces, body=None)
    outfit = stored(both[0], faces, metadata={"outfit": {"pants": VERTICES, "tshirt": VERTICES}})
    document = gltf.GLTF2().load(str(export_trajectory(worn, tmp_path / "a.glb", garment=outfit)))
    assert [node.mesh for node in document.nodes if node.name in ("pants", "tshirt")] == [0, 1]
    colors = [material.pbrMetallicRoughness.baseColorFactor for material in document.materials]
    assert colors[0] != colors[1]
    stage = usd.Stage.Open(str(export_trajectory(worn, tmp_path / "a.usda", garment=outfit)))
    for name, moved in (("pants", 0), ("tshirt", 1)):
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath(f"/World/{name}"))
        np.testing.assert_allclose(np.array(mesh.GetPointsAttr().Get(2)), run.positions[2] + moved, atol=1e-6)
    with np.load(export_trajectory(worn, tmp_path / "a.npz", garment=outfit)) as arrays:
        assert len(arrays["positions"]) == FRAMES
    with pytest.warns(UserWarning, match="holds pants, tshirt one after another"):
        export_trajectory(worn, tmp_path / "a.pc2", garment=outfit)
    uvs = np.zeros((len(faces), 3, 2))
    uvs[len(run.faces) :] = 0.5  # of the shirt alone
    textured = replace(outfit, corner_uvs=uvs)
    document = gltf.GLTF2().load(str(export_trajectory(worn, tmp_path / "b.glb", garment=textured)))
    parts = [mesh.primitives[0].attributes.TEXCOORD_0 is not None for mesh in document.meshes]
    assert parts == [False, True]


def test_formats_that_are_unknown_and_garments_that_don_t_fit_are_refused(tmp_path, run, garment):
    for path, options, word in (
        (tmp_path / "run.fbx", {}, "--format"),
        (tmp_path / "run.pc2", {"content": "both"}, "one mesh"),
        (tmp_path / "nowhere" / "run.glb", {}, "folder"),
        (
            tmp_path / "a.glb",
            {"garment": replace(garment, faces=garment.faces[::-1])},
            "not the one of this run",
        ),
    ):
        with pytest.raises(AssetError, match=word):
            export_trajectory(run, path, **options)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").write_text("")
    with pytest.raises(AssetError, match="exists already"):
        export_trajectory(run, tmp_path / "full", format="obj")
    assert sorted(os.listdir(tmp_path)) == ["full"]


@pytest.mark.slow
def test_the_command_exports_a_run(tmp_path, run):
    write_trajectory(tmp_path / "trajectory.npz", run)
    result = succeeded(eslr("export", tmp_path, "--out", tmp_path / "a.mdd"))
    assert Path(result.stdout.strip()) == tmp_path / "a.mdd"
    assert (tmp_path / "a.mdd").stat().st_size == 8 + 4 * FRAMES + run.positions.nbytes
