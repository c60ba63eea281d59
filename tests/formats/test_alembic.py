"""Alembic both ways: what is written comes back exactly, what others write as they mean it."""

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from broken import refuses
from garment_files import stored
from scipy.spatial.transform import Rotation

from eslr_jax import AssetError
from eslr_jax.errors import MissingExtraError
from eslr_jax.pipeline.cli.method import is_moving_mesh, load_actor
from eslr_jax.pipeline.cli.options import Options
from eslr_jax.pipeline.formats.animated import AnimatedMesh, vertex_normals
from eslr_jax.pipeline.formats.export import export_trajectory
from eslr_jax.pipeline.formats.garment import read_garment_source
from eslr_jax.pipeline.formats.mesh_sequence import read_mesh_sequence, read_mesh_sequences
from eslr_jax.pipeline.formats.trajectory import TrajectoryFile

alembic3d = pytest.importorskip("alembic3d")
import imath  # noqa: E402
from alembic3d import Abc, AbcCoreAbstract, AbcGeom  # noqa: E402

from eslr_jax.pipeline.formats.alembic import read_alembic_garment, write_alembic  # noqa: E402

FRAMES, STEP = 4, 1 / 30
SPHERE = trimesh.creation.icosphere(subdivisions=1)
FACES, VERTICES = np.asarray(SPHERE.faces), len(SPHERE.vertices)
RNG = np.random.default_rng(0)
MOVING = (SPHERE.vertices + 0.1 * RNG.normal(size=(FRAMES, VERTICES, 3))).astype(np.float32)
SHIRT = AnimatedMesh(
    "My shirt",
    MOVING,
    FACES,
    corner_uvs=RNG.random((len(FACES), 3, 2)).astype(np.float32),
    velocities=RNG.normal(size=MOVING.shape).astype(np.float32),
    parts={"left sleeve": np.arange(len(FACES)) < 20, "front": np.arange(len(FACES)) >= 20},
)
BODY = AnimatedMesh("body", MOVING[:, ::-1] + np.float32(2), VERTICES - 1 - FACES)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("abc") / "run.abc"
    write_alembic(path, [SHIRT, BODY], float(np.float32(STEP)))
    return path


def raw(values):
    return np.array(memoryview(values))


def properties(path, *names):
    """The properties of a mesh by the library's untyped calls, and its archive, which has to live as long."""
    entry = archive = Abc.IArchive(str(path))
    entry = archive.getTop()
    for name in names:
        entry = entry.getChild(name)
    return Abc.ICompoundProperty(entry.getProperties(), ".geom"), entry, archive


def test_what_is_written_is_there_bit_by_bit(scene):
    geometry, entry, archive = properties(scene, "My_shirt", "My_shirtShape")
    assert Abc.GetArchiveInfo(archive)["dccFPS"] == 30.0  # exactly, from a float32 step
    points = Abc.IP3fArrayProperty(geometry, "P")
    assert [points.getTimeSampling().getSampleTime(frame) for frame in range(FRAMES)] == pytest.approx(
        [frame / 30 for frame in range(FRAMES)], abs=1e-12
    )
    for name, kind, values in (
        ("P", Abc.IP3fArrayProperty, MOVING),
        (".velocities", Abc.IV3fArrayProperty, SHIRT.velocities),
        ("N", Abc.IN3fArrayProperty, [vertex_normals(points, FACES) for points in MOVING]),
    ):
        track = kind(geometry, name)
        np.testing.assert_array_equal([raw(track.getValue(frame)) for frame in range(FRAMES)], values)
    corners = Abc.IInt32ArrayProperty(geometry, ".faceIndices")
    assert corners.isConstant()
    np.testing.assert_array_equal(raw(corners.getValue(0)).reshape(-1, 3), FACES[:, ::-1])  # clockwise
    assert set(raw(Abc.IInt32ArrayProperty(geometry, ".faceCounts").getValue(0))) == {3}
    uv = AbcGeom.IV2fGeomParam(geometry, "uv")
    assert uv.getScope() == AbcGeom.GeometryScope.kFacevaryingScope
    values = raw(uv.getExpandedValue().getVals()).reshape(-1, 3, 2)
    np.testing.assert_array_equal(values, SHIRT.corner_uvs[:, ::-1])
    sets = {
        child.getName(): Abc.ICompoundProperty(child.getProperties(), ".faceset") for child in entry.children
    }
    found = {name: raw(Abc.IInt32ArrayProperty(entry, ".faces").getValue(0)) for name, entry in sets.items()}
    assert {name: len(faces) for name, faces in found.items()} == {
        "left_sleeve": 20,
        "front": len(FACES) - 20,
    }
    np.testing.assert_array_equal(found["left_sleeve"], np.arange(20))


def test_it_comes_back_exactly(scene):
    shirt, body = read_mesh_sequences(scene)
    for found, mesh in ((shirt, SHIRT), (body, BODY)):
        np.testing.assert_array_equal(found.positions, mesh.positions)
        np.testing.assert_array_equal(found.faces, mesh.faces)
        assert found.fps == 30.0
    assert read_mesh_sequence(f"{scene}#body", fps=15.0).fps == 15.0
    garment = read_garment_source(f"{scene}#My_shirt")
    assert (garment.name, garment.is_metric) == ("My_shirt", False)
    np.testing.assert_array_equal(garment.positions, MOVING[0])
    np.testing.assert_array_equal(garment.corner_uvs, SHIRT.corner_uvs)
    assert garment.part_names == ("left_sleeve", "front")
    np.testing.assert_array_equal(garment.face_parts, ~SHIRT.parts["left sleeve"])
    both = read_alembic_garment(scene)  # as the pieces of one
    np.testing.assert_array_equal(both.positions, np.concatenate([MOVING[0], BODY.positions[0]]))
    np.testing.assert_array_equal(both.faces[-len(FACES) :], BODY.faces + VERTICES)
    assert both.corner_uvs is None


def test_a_run_is_exported_exactly_with_the_parts_of_its_garment(tmp_path):
    body = dataclasses.replace(BODY, rest_positions=MOVING[0])
    run = TrajectoryFile(MOVING, SHIRT.velocities, FACES, STEP, {"garment": "tank"}, body)
    garment = stored(MOVING[0], FACES, face_parts=np.arange(len(FACES)) % 2, part_names=("front", "back"))
    path = export_trajectory(run, tmp_path / "run.abc", garment=garment)
    for found, positions in zip(read_mesh_sequences(path), (MOVING, BODY.positions), strict=True):
        np.testing.assert_array_equal(found.positions, positions)
    assert read_garment_source(f"{path}#tank").part_names == ("front", "back")


def write_foreign(
    path, *, step=1 / 24, blur=False, corners=(0, 1, 2, 3), change=False, kind="poly", far=(1, 1)
):
    """A square of one polygon as others write it: clockwise, below a moving and a still transform."""
    archive = Abc.CreateArchiveWithInfo(str(path), "another", "")
    top = AbcGeom.OXform(archive.getTop(), "rig")
    top.getSchema().setTimeSampling(AbcCoreAbstract.TimeSampling(step, 0.0))
    if blur:
        times = AbcCoreAbstract.TimeVector()
        times.extend([0.0, 0.1, 0.11])
        kinds = AbcCoreAbstract.TimeSamplingType(AbcCoreAbstract.AcyclicFlag.kAcyclic)
        top.getSchema().setTimeSampling(AbcCoreAbstract.TimeSampling(kinds, times))
    for frame in range(3):
        sample = AbcGeom.XformSample()
        sample.setTranslation(imath.V3d(frame, 0, 0))
        top.getSchema().set(sample)
    hand = AbcGeom.OXform(top, "cloth")
    sample = AbcGeom.XformSample()
    sample.setYRotation(90.0)
    hand.getSchema().set(sample)
    points = np.array([[0, 0, 0], [1, 0, 0], [*far, 0], [0, 1, 0]], np.float32)
    uvs = imath.V2fArrayFromBuffer(np.ascontiguousarray(points[:, :2]))
    name, kinds, sample = (
        ("cloth", AbcGeom.OSubD, AbcGeom.OSubDSchemaSample())
        if kind == "subd"
        else ("clothShape", AbcGeom.OPolyMesh, AbcGeom.OPolyMeshSchemaSample())
    )
    schema = kinds(hand, name).getSchema()
    for frame in range(1 + change):
        clockwise = np.array(corners[::-1] if frame == 0 else corners, np.int32)
        sample.setPositions(imath.V3fArrayFromBuffer(points))
        sample.setFaceIndices(imath.IntArrayFromBuffer(clockwise))
        sample.setFaceCounts(imath.IntArrayFromBuffer(np.array([len(corners)], np.int32)))
        sample.setUVs(AbcGeom.OV2fGeomParamSample(uvs, AbcGeom.GeometryScope.kVertexScope))
        schema.set(sample)


@pytest.mark.parametrize("kind", ["poly", "subd"])
def test_others_polygons_transforms_and_times(tmp_path, kind):
    write_foreign(tmp_path / "a.abc", kind=kind)
    found = read_mesh_sequence(tmp_path / "a.abc")
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    turned = Rotation.from_euler("y", 90, degrees=True).apply(square)
    np.testing.assert_allclose(found.positions, turned + np.arange(3)[:, None, None] * [1, 0, 0], atol=1e-7)
    assert (found.fps, found.mesh) == (24.0, "cloth")
    normals = np.cross(
        *(found.positions[0][found.faces[:, k]] - found.positions[0][found.faces[:, 0]] for k in (1, 2))
    )
    np.testing.assert_allclose(normals, [[1, 0, 0]] * 2, atol=1e-7)  # the square's +z, turned
    garment = read_garment_source(tmp_path / "a.abc")
    np.testing.assert_array_equal(garment.corner_uvs, square[:, :2][garment.faces])


def test_what_cannot_be_read_is_named_in_one_line(tmp_path, scene):
    refuses(read_mesh_sequence, scene, "2 meshes move, not one; it has My_shirt, body; name one")
    refuses(read_garment_source, Path(f"{scene}#skirt"), "no mesh is named skirt; it has My_shirt, body")
    write_foreign(tmp_path / "blur.abc", blur=True)
    refuses(read_mesh_sequence, tmp_path / "blur.abc", "uneven times")
    assert read_mesh_sequence(tmp_path / "blur.abc", fps=30.0).positions.shape == (3, 4, 3)
    write_foreign(tmp_path / "faces.abc", change=True)
    refuses(read_mesh_sequence, tmp_path / "faces.abc", "clothShape change over time")
    write_foreign(tmp_path / "crossed.abc", corners=(0, 2, 1, 3), far=(3, 2))
    refuses(read_mesh_sequence, tmp_path / "crossed.abc", "crosses itself")
    write_foreign(tmp_path / "edge.abc", corners=(0, 1))
    refuses(read_mesh_sequence, tmp_path / "edge.abc", "polygons without corners")
    archive = Abc.CreateArchiveWithInfo(str(tmp_path / "rig.abc"), "another", "")
    AbcGeom.OXform(archive.getTop(), "rig")
    del archive
    refuses(read_mesh_sequence, tmp_path / "rig.abc", "no polygon meshes")
    (tmp_path / "text.abc").write_text("hello")
    refuses(read_mesh_sequence, tmp_path / "text.abc", "damaged or no alembic file")


def test_a_file_that_crashes_the_library_is_a_named_error(tmp_path, scene):
    """An entry that is empty comes to point at the header: some of them end the library's process."""
    good, empty = scene.read_bytes(), b"\0" * 7 + b"\x80"
    places = [at for at in range(len(good)) if good[at : at + 8] == empty]
    said = []
    for place in places[4:7]:
        (tmp_path / "a.abc").write_bytes(good[:place] + b"\x10" + good[place + 1 :])
        with pytest.raises(AssetError) as caught:
            read_alembic_garment(tmp_path / "a.abc")
        said.append(str(caught.value))
    assert any("its reader crashed" in text for text in said)
    (tmp_path / "a.abc").write_bytes(good[: len(good) // 2])
    refuses(read_alembic_garment, tmp_path / "a.abc", "damaged")


def test_the_body_of_a_file_is_a_body_in_motion(scene):
    assert is_moving_mesh(f"{scene}#body")
    actor = load_actor(Options(body=f"{scene}#body", body_units="m"))
    np.testing.assert_allclose(actor.poses.positions, BODY.positions, atol=1e-6)
    np.testing.assert_array_equal(actor.poses.faces, BODY.faces)


@pytest.mark.parametrize("use", [lambda path: write_alembic(path, [SHIRT], STEP), read_alembic_garment])
def test_without_the_extra_a_line_names_it(tmp_path, monkeypatch, use):
    monkeypatch.setitem(sys.modules, "alembic3d", None)
    (Path(tmp_path) / "a.abc").write_bytes(b"Ogawa")
    with pytest.raises(
        MissingExtraError, match=r'Alembic needs alembic3d.*pip install "eslr-jax\[alembic\]"'
    ):
        use(tmp_path / "a.abc")
