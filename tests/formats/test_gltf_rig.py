"""Skinned characters: posed by the reader's numbers they are where the file's own nodes put them."""

import json
from pathlib import Path

import numpy as np
import pygltflib as gltf
import pytest
from broken import pack, read, reader_of, refuses
from foreign_files import GlbWriter, animate, write_character
from scipy.spatial.transform import Rotation

from eslr_jax import load_body, load_motion, pose_body
from eslr_jax.pipeline.formats.gltf_document import GltfDocument, sample_keys
from eslr_jax.pipeline.formats.mesh import read_mesh_file

FIXTURES = Path(__file__).parents[1] / "fixtures"
NAMES = ("mixamorig:Hips", "mixamorig:Spine", "mixamorig:Head", "mixamorig:LeftUpLeg", "mixamorig:RightUpLeg")
PARENTS = (-1, 0, 1, 0, 0)
REST = np.array([[0, 1, 0], [0, 1.2, 0], [0, 1.6, 0], [0.1, 0.9, 0], [-0.1, 0.9, 0.0]])


def make_mesh(rng, count=40):
    """Random triangles around a skeleton, with four influences each."""
    positions = rng.uniform([-0.4, 0.0, -0.2], [0.4, 1.8, 0.2], (count, 3)).astype(np.float32).astype(float)
    faces = rng.permutation(count)[: count // 3 * 3].reshape(-1, 3)
    indices = np.stack([rng.permutation(5)[:4] for _ in range(count)])
    weights = rng.dirichlet(np.ones(4), count)
    return positions, faces, weights, indices


def make_clip(rng, frames=6):
    turned = Rotation.from_rotvec(0.5 * rng.normal(size=(frames * 5, 3))).as_matrix().reshape(frames, 5, 3, 3)
    return animate(NAMES, PARENTS, REST, turned, REST[0] + 0.2 * rng.normal(size=(frames, 3)))


def write(path, rng, **options):
    mesh, clip = make_mesh(rng), make_clip(rng)
    write_character(path, clip.skeleton, *mesh, motion=(clip.rotations, clip.positions), **options)
    return mesh, clip


def skinned(mesh, clip, frame):
    positions, _, weights, indices = mesh
    turned = clip.rotations[frame][indices]
    moved = np.einsum("vkab,vkb->vka", turned, positions[:, None] - REST[indices])
    return np.einsum("vk,vka->va", weights, moved + clip.positions[frame][indices])


@pytest.mark.parametrize("is_turned", [False, True])
@pytest.mark.parametrize("unit", [1.0, 0.01])
def test_a_character_moves_as_it_was_animated(tmp_path, unit, is_turned):
    rng = np.random.default_rng(0)
    frames = Rotation.from_rotvec(rng.normal(size=(5, 3))).as_matrix() if is_turned else None
    mesh, clip = write(tmp_path / "avatar.glb", rng, unit=unit, frames=frames)
    body = load_body(tmp_path / "avatar.glb")
    assert body.joint_names == NAMES
    np.testing.assert_allclose(body.rest_positions, mesh[0], atol=1e-6)
    np.testing.assert_allclose(body.joint_rest_positions, REST, atol=1e-6)
    motion = load_motion(tmp_path / "avatar.glb", body=body)
    assert motion.arm_abduction == 0.0  # its own motion is played as it is
    poses = pose_body(body, motion)
    assert poses.positions.shape[0] == 6
    for frame in range(6):
        np.testing.assert_allclose(poses.positions[frame], skinned(mesh, clip, frame), atol=3e-6)


def test_the_bind_pose_is_the_rest_pose_though_the_nodes_are_posed(tmp_path):
    """Exporters leave the nodes in the first frame of the animation."""
    rng = np.random.default_rng(1)
    path = tmp_path / "avatar.glb"
    mesh, _ = write(path, rng)
    document = gltf.GLTF2().load(str(path))
    for node in document.nodes[:5]:
        node.rotation = (
            (Rotation.from_quat(node.rotation) * Rotation.from_rotvec([0.3, 0.1, -0.2])).as_quat().tolist()
        )
    document.save(str(path))
    body = read("body", path)
    np.testing.assert_allclose(body.positions, mesh[0], atol=1e-6)
    np.testing.assert_allclose(body.skeleton.rest_positions, REST, atol=1e-6)


def test_a_skinned_garment_is_where_its_joints_hold_it(tmp_path):
    """Its own node may be anywhere, as glTF says: exporters leave a scale of 0.01 there."""
    path = tmp_path / "shirt.glb"
    mesh, _ = write(path, np.random.default_rng(1))
    document = gltf.GLTF2().load(str(path))
    document.nodes[document.nodes[-1].children[-1]].scale = [0.01] * 3
    document.save(str(path))
    found = read_mesh_file(path)
    np.testing.assert_allclose(found.positions, mesh[0], atol=1e-6)


def test_a_mesh_that_hangs_on_a_joint_is_a_part_of_the_body(tmp_path):
    """As a robot's parts: bound to that joint alone, and where it is in the bind pose."""
    path = tmp_path / "robot.glb"
    mesh, _ = write(path, np.random.default_rng(1))
    document = gltf.GLTF2().load(str(path))
    document.nodes.append(gltf.Node(name="Knee", mesh=0, translation=[0.0, 0.0, 30.0]))  # [cm]
    document.nodes[3].children.append(len(document.nodes) - 1)
    document.nodes[3].rotation = Rotation.from_rotvec([0.3, 0.1, -0.2]).as_quat().tolist()  # a pose
    document.save(str(path))
    found = read("body", path)
    knee = mesh[0][:, [0, 2, 1]] * [1, -1, 1] + REST[3] + [0.0, 0.0, 0.3]
    np.testing.assert_allclose(found.positions, np.concatenate([mesh[0], knee]), atol=1e-6)
    np.testing.assert_array_equal(found.skin_weights[40:], np.tile([1.0, 0, 0, 0], (40, 1)))
    np.testing.assert_array_equal(found.skin_indices[40:, 0], 3)
    assert len(read("body", path, "Knee").positions) == 40


def test_split_vertices_become_one_and_hips_come_first(tmp_path):
    positions = np.array([[0, 0, 0], [0, 1, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0], [1, 1, 0.0]])
    names, parents = ("root", "pelvis", "thigh_l", "thigh_r", "spine_01"), (-1, 0, 1, 1, 1)
    rest = np.array([[0, 0, 0], [0, 1, 0], [0.1, 0.9, 0], [-0.1, 0.9, 0], [0, 1.2, 0.0]])
    skeleton = animate(names, parents, rest, np.tile(np.eye(3), (1, 5, 1, 1)), rest[:1]).skeleton
    weights, indices = np.tile([1.0, 0, 0, 0], (6, 1)), np.tile([2, 0, 0, 0], (6, 1))
    faces = np.array([[0, 2, 1], [3, 4, 5]])
    write_character(tmp_path / "a.glb", skeleton, positions, faces, weights, indices)
    body = load_body(tmp_path / "a.glb")
    assert len(body.rest_positions) == 4
    np.testing.assert_array_equal(body.faces, [[0, 2, 1], [1, 2, 3]])
    assert body.joint_names[0] == "pelvis"
    assert body.parents[0] == -1
    assert np.all(np.asarray(body.joint_names)[np.asarray(body.skin_indices)[:, 0]] == "thigh_l")


def test_the_simple_skin_of_the_gltf_samples():
    body, motion = (read(kind, FIXTURES / "simple_skin.gltf") for kind in ("body", "motion"))
    assert body.positions.shape == (10, 3)
    assert motion.name == "clip0"
    assert motion.fps == pytest.approx(2.0)
    # Its only track turns the second joint about z, a quarter turn there and back.
    angles = Rotation.from_matrix(motion.rotations[:, 1]).as_rotvec()[:, 2]
    assert np.degrees(angles.max()) == pytest.approx(90.0, abs=1e-3)
    np.testing.assert_allclose(motion.positions[:, 0], np.tile([0, 1, 0], (12, 1)), atol=1e-6)


@pytest.mark.parametrize(
    ("keys", "fps", "count"),
    [
        ([np.arange(10) / 24, np.array([0.0, 3.0, 9.0]) / 24], 24.0, 10),  # a track without what is redundant
        ([np.array([0.0, 0.5, 1.0, 1.1, 1.2, 2.3])], 30.0, 70),  # by hand
        ([np.array([0.0, 0.5, 0.51, 2.0])], 100.0, 201),
        ([np.array([0.0, 0.5, 0.501, 2.0])], 120.0, 241),
        ([np.array([1.0])], 30.0, 1),
        ([np.round(np.arange(300) / 30, 4)], 30.0, 300),  # rounded times
        ([0.033333 * np.arange(300)], 30.0, 300),
        ([(np.arange(3000) / 29.97).astype(np.float32)], 29.97, 3000),
    ],
)
def test_animations_are_sampled_by_their_keys(keys, fps, count):
    times, rate = GltfDocument(FIXTURES / "simple_skin.gltf").sample_times(keys)
    assert (rate, len(times)) == (pytest.approx(fps), count)
    assert times[0] == keys[0][0]
    assert times[-1] > keys[0][-1] - 1 / rate


def test_key_frames_between_keys():
    times = np.array([0.0, 1.0, 3.0])
    at = np.array([-1.0, 0.5, 2.0, 9.0])
    values = np.array([[0.0], [2.0], [6.0]]) * np.ones(3)
    np.testing.assert_allclose(sample_keys("translation", "LINEAR", times, values, at)[:, 0], [0, 1, 4, 6])
    np.testing.assert_allclose(sample_keys("translation", "STEP", times, values, at)[:, 0], [0, 0, 2, 6])
    # A cubic spline with the slopes of a parabola is that parabola.
    spline = np.stack([2 * times, times**2, 2 * times], axis=1).reshape(-1, 1) * np.ones(3)
    found = sample_keys("translation", "CUBICSPLINE", times, spline, np.array([0.5, 2.0]))
    np.testing.assert_allclose(found[:, 0], [0.25, 4.0])
    turns = Rotation.from_euler("z", [[0], [90], [180]], degrees=True).as_quat()
    half = Rotation.from_quat(sample_keys("rotation", "LINEAR", times, turns, np.array([0.5])))
    assert np.degrees(half.magnitude()[0]) == pytest.approx(45.0)


@pytest.mark.parametrize(("of_node", "of_mesh", "amounts"), [
    ([], [0.5, 2.0], (0.5, 2.0)), ([1.0, 0.0], [0.5, 2.0], (1.0, 0.0)), ([0.0, 0.0], [0.5, 2.0], (0.0, 0.0)),
    ([], [], (0.0, 0.0)),
])  # fmt: skip
def test_a_character_and_a_garment_have_the_shape_that_weights_of_targets_give(
    tmp_path, of_node, of_mesh, amounts
):
    rng = np.random.default_rng(0)
    points, faces, weights, indices = make_mesh(rng)
    path, bare = tmp_path / "avatar.glb", tmp_path / "bare.glb"
    write_character(bare, make_clip(rng).skeleton, points, faces, weights, indices, unit=1.0)
    offsets = rng.normal(size=(2, *points.shape)).astype(np.float32)
    path.write_bytes(with_targets(gltf.GLTF2().load(str(bare)), offsets, of_node, of_mesh))
    moved = np.tensordot(np.array(amounts), offsets, axes=1)[:, [0, 2, 1]] * [1, 1, -1]  # Z up to Y up
    for read_as in (reader_of("body"), read_mesh_file):
        found, before = read_as(path), read_as(bare)
        np.testing.assert_allclose(found.positions, before.positions + moved, atol=1e-6)
        np.testing.assert_array_equal(found.faces, before.faces)
    path.write_bytes(with_targets(gltf.GLTF2().load(str(bare)), offsets, [1.0], of_mesh))
    refuses(reader_of("body"), path, "impossible weights of the 2 shapes")


def with_targets(document, offsets, of_node, of_mesh):
    """Return a GLB whose only primitive has morph targets."""
    blob = document.binary_blob()
    for values in offsets:
        document.bufferViews.append(gltf.BufferView(buffer=0, byteOffset=len(blob), byteLength=values.nbytes))
        blob += values.tobytes()
        view = len(document.bufferViews) - 1
        document.accessors.append(
            gltf.Accessor(bufferView=view, componentType=gltf.FLOAT, count=len(values), type="VEC3")
        )
        document.meshes[0].primitives[0].targets.append({"POSITION": len(document.accessors) - 1})
    document.buffers[0].byteLength = len(blob)
    document.meshes[0].weights = of_mesh
    tables = json.loads(document.gltf_to_json())
    next(node for node in tables["nodes"] if "mesh" in node)["weights"] = of_node
    return pack(tables, blob)


def test_clips_and_meshes_are_picked_by_name(tmp_path):
    path = tmp_path / "avatar.glb"
    write(path, np.random.default_rng(0), clip="dance", mesh_name="Skin")
    assert read("motion", path, "dance").name == "dance"
    refuses(lambda file: read("motion", file, "walk"), path, "dance")
    assert len(read("body", path, "Skin").positions) == 40
    refuses(lambda file: read("body", file, "Hat"), path, "Skin")


def test_a_sparse_accessor_overwrites_its_base(tmp_path):
    writer = GlbWriter()
    base = writer.accessor(np.zeros((4, 3), np.float32), "VEC3")
    rows = writer.accessor(np.array([1, 3], np.uint8), "SCALAR")
    values = writer.accessor(np.ones((2, 3), np.float32), "VEC3")
    views = [writer.document.accessors[index].bufferView for index in (rows, values)]
    writer.document.accessors[base].sparse = gltf.Sparse(
        count=2,
        indices=gltf.AccessorSparseIndices(bufferView=views[0], componentType=5121),
        values=gltf.AccessorSparseValues(bufferView=views[1]),
    )
    (tmp_path / "a.glb").write_bytes(writer.bytes())
    np.testing.assert_array_equal(GltfDocument(tmp_path / "a.glb").array(base)[:, 0], [0, 1, 0, 1])
